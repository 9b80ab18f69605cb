# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node; reading a map does not end while there is a file of its name with ``.slow``."""

from pathlib import Path
import sys
import time

from stavpr_ros.commands.node import main
from stavpr_ros.ros import runtime

read_map = runtime.read_map


def slow(path, settings):
    while Path(f'{path}.slow').exists():
        time.sleep(0.05)
    return read_map(path, settings)


if __name__ == '__main__':
    runtime.read_map = slow
    sys.exit(main())
