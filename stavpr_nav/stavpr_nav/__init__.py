# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Teach a route and repeat it, with one uncalibrated camera."""
