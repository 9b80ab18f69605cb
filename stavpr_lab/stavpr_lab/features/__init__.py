# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Kinds of features beyond those of stavpr_ros, and the export of networks to ONNX."""
