# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A synthetic street and traverses of it, for the demonstration and for tests."""
