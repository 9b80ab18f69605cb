# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels for CUDA devices, compiled by numba: the twins of those for the CPU."""
