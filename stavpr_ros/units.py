# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Units of time."""

SECOND = 1_000_000_000  # nanoseconds
WRAP = 2**32  # seconds: stamps of 32 bits, unsigned in ROS 1, negative in ROS 2 from 2038 to 2106
DATED = 250_000_000 * SECOND  # stamps below count from the start of a video or a simulation
