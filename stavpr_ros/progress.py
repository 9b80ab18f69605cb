# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Progress of work that takes long: a bar on a terminal, elsewhere a line every few seconds."""

from functools import partial
import os
import sys
from typing import Any

from tqdm import tqdm


class _Lines:
    """Standard error without the blanks and carriage returns that move a bar on a terminal."""

    def write(self, text: str) -> None:
        """Write a line, or nothing."""
        if sys.stderr is not None and (line := text.strip(': \r\n')):
            sys.stderr.write(f'{line}\n')


def shows_bars() -> bool:
    """Return whether standard error is a terminal on which a bar can move."""
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    return is_terminal and os.environ.get('TERM') != 'dumb'


LINE: dict[str, Any] = {
    **{'mininterval': 5.0, 'delay': 5.0, 'leave': False},  # shorter work has no line
    'bar_format': '{desc}: {n_fmt} of {total_fmt}',
    'file': _Lines(),
}
Progress = tqdm if shows_bars() else partial(tqdm, **LINE)
