# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Units of time."""

SECOND = 1_000_000_000  # nanoseconds
DATED = 250_000_000 * SECOND  # stamps below count from the start of a video or a simulation
