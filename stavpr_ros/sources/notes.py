# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Warnings of sources, in one line and once: a source is opened several times."""

from functools import cache
import logging

from stavpr_ros.errors import printable

_log = logging.getLogger(__name__)


@cache
def note_once(text: str) -> None:
    """Log a warning, unless the process has logged it before."""
    _log.warning('%s', printable(text))
