# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kernels for the CPU, compiled by numba: arithmetic only, arrays are trusted."""
