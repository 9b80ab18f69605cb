# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The reference map: build, grow, save and load it; keyframes and trajectories.

The names below are imported on first use: the submodule ``transforms`` loads without numba.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from stavpr_ros.mapping.builder import build_map, extract_features
    from stavpr_ros.mapping.growing_map import GrowingMap
    from stavpr_ros.mapping.keyframes import (
        image_change,
        KeyframeSelector,
        KeyframeSettings,
        small_gray,
    )
    from stavpr_ros.mapping.map_file import is_map, load_map, open_map, save_map, verify_map
    from stavpr_ros.mapping.merging import merge_maps, select_places, select_session
    from stavpr_ros.mapping.place_map import (
        descriptor_map,
        encode_thumbnail,
        Place,
        PlaceMap,
        Session,
        thumbnail_of,
    )
    from stavpr_ros.mapping.trajectory import distance, rotation, Trajectory

__all__ = [
    'GrowingMap',
    'KeyframeSelector',
    'KeyframeSettings',
    'Place',
    'PlaceMap',
    'Session',
    'Trajectory',
    'build_map',
    'descriptor_map',
    'distance',
    'encode_thumbnail',
    'extract_features',
    'image_change',
    'is_map',
    'load_map',
    'merge_maps',
    'open_map',
    'rotation',
    'save_map',
    'select_places',
    'select_session',
    'small_gray',
    'thumbnail_of',
    'verify_map',
]
# light ones first; none imports one behind it
_MODULES = 'trajectory', 'keyframes', 'place_map', 'merging', 'growing_map', 'map_file', 'builder'


def __getattr__(name: str) -> Any:
    for module in _MODULES if name in __all__ else ():
        owner = import_module(f'{__name__}.{module}')
        if hasattr(owner, name):
            return getattr(owner, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
