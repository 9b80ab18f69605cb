# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The fixtures that the tests of all packages share: test/shared/fixtures.py."""

from fixtures import *  # noqa: F403
