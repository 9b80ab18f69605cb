# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS domain of this process of the tests, and of all that it starts."""

import os

# pytest-xdist: its processes have numbers, so that none shares a domain with another
_RUN = os.getppid() if 'PYTEST_XDIST_WORKER' in os.environ else os.getpid()
_PROCESS = int(os.environ.get('PYTEST_XDIST_WORKER', 'gw0').removeprefix('gw'))
DOMAIN = 1 + (4 * _RUN + _PROCESS) % 100
