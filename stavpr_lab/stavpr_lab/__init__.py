# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluation, baselines, the tables of the paper, and the demonstration of stavpr_ros."""
