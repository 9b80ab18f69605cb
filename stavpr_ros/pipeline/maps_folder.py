# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The folder of maps: the only place whose files the ROS graph may name."""

import os
from pathlib import Path

from stavpr_ros.checks import require_plain
from stavpr_ros.errors import SettingsError
from stavpr_ros.regular_file import home_folder


def maps_folder(parameter: str) -> Path:
    """
    Return the folder of maps.

    :param parameter: maps_folder, '' = ``stavpr/maps`` in the user's data folder.
    """
    if parameter:
        return Path(os.path.expanduser(parameter)).absolute()
    data = os.environ.get('XDG_DATA_HOME', '')
    # the XDG Base Directory Specification: a relative one is ignored
    home = Path(data) if os.path.isabs(data) else home_folder() / '.local' / 'share'
    return home / 'stavpr' / 'maps'


def inside(folder: Path, name: str) -> str:
    """
    Return the absolute path of a file in a folder, without symbolic links.

    :param name: relative to the folder; an absolute path, or one with ``~``, must lead into it.
    :raises SettingsError: it leads outside, also by ``..`` or a symbolic link, or has control
        characters.
    """
    require_plain('a name in the maps folder', name)
    root = Path(os.path.realpath(folder))
    expanded = os.path.expanduser(name)
    path = Path(os.path.realpath(root / expanded))
    if root not in path.parents:
        raise SettingsError(
            f'{name!r} is no file in the maps folder {folder}: from the ROS graph, name one in '
            'it; for others start the node with parameter maps_folder, map_path or save_path'
        )
    return str(path)
