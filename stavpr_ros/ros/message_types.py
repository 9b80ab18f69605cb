# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Classes of messages by the names of their types."""

import importlib.util
from pathlib import Path
import re

from stavpr_ros.errors import UnavailableError


def message_class(name: str) -> type:
    """
    Return the class of a message type.

    :param name: such as ``nav_msgs/msg/Odometry``; it may come from a foreign file, so only
        packages with messages are imported.
    :raises UnavailableError: its package is not installed.
    """
    if words := re.fullmatch(r'([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)', name):
        package, kind = words.groups()
        spec = importlib.util.find_spec(package)  # does not import it
        folders = (spec.submodule_search_locations if spec else None) or []
        if any(Path(folder, 'msg').is_dir() for folder in folders):
            kind_class = getattr(importlib.import_module(f'{package}.msg'), kind, None)
            if isinstance(kind_class, type):
                return kind_class
    raise UnavailableError(
        f'the message type {name} is not installed: install its package and source its '
        'environment, or leave the topic out'
    )
