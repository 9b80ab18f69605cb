# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demonstration: a synthetic street, traversed twice, and its plots."""

FEATURES = 'gradient'  # default of the demonstrations, and of the maps that they build
