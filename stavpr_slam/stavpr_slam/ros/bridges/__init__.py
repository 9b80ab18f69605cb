# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bridges: loop closures become the messages of other SLAM systems and filters."""
