# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Progress of work that takes long: a bar on a terminal, elsewhere a line every few seconds."""

from functools import partial
import sys
from typing import Any

from tqdm import tqdm

LINE: dict[str, Any] = {
    **{'mininterval': 5.0, 'delay': 5.0, 'leave': False},  # shorter work has no line
    'bar_format': '{desc}: {n_fmt} of {total_fmt}\n',
}
Progress = tqdm if sys.stderr.isatty() else partial(tqdm, **LINE)
