# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check of an output file before the work starts."""

import os

from stavpr_ros.errors import SourceError


def require_room(path: str) -> None:
    """
    Reject a file that cannot be written.

    :raises SourceError: it is a folder, or its folder is missing or write-protected.
    """
    if os.path.isdir(path):
        raise SourceError(f'{path} is a folder: name a file in it')
    folder = os.path.dirname(os.path.abspath(path))
    if not os.path.isdir(folder):
        raise SourceError(f'the folder of {path} does not exist: make it first')
    if not os.access(folder, os.W_OK):
        raise SourceError(f'the folder of {path} is write-protected: name another')
