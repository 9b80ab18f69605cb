# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is made once per map: centered features, statistics, matchers."""
