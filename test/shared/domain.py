# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS domain of this process of the tests, and of all that it starts: no other run has it."""

import fcntl
import tempfile
from typing import TextIO


def claim() -> tuple[int, TextIO]:
    """Return a domain that no process of any tests on this machine has, and its lock."""
    for domain in range(1, 101):
        try:
            path = f'{tempfile.gettempdir()}/stavpr_test_domain_{domain}'
            lock = open(path, 'w')  # noqa: SIM115
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            continue
        return domain, lock
    raise RuntimeError('all ROS domains from 1 to 100 are in use by other tests')


DOMAIN, _LOCK = claim()
