# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node; each image takes 20 ms longer, and a map as long as ``.slow`` is beside its file."""

from pathlib import Path
import sys
import time

from stavpr_ros.commands.node import main
from stavpr_ros.ros import runtime

read_map, process = runtime.read_map, runtime.Runtime._process


def slow(path, settings):
    while Path(f'{path}.slow').exists():
        time.sleep(0.05)
    return read_map(path, settings)


def process_slowly(self, item):
    process(self, item)
    time.sleep(0.02)


if __name__ == '__main__':
    runtime.read_map, runtime.Runtime._process = slow, process_slowly
    sys.exit(main())
