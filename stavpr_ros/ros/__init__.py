# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Everything that imports ROS: node, services, messages, diagnostics, replay, launch."""

REPORT_PERIOD = 10.0  # seconds between repetitions of a warning in the log
