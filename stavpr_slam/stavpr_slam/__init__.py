# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SLAM with the loop closures of stavpr_ros: a pose graph, its node, bridges to other systems."""
