# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The reference map: build, grow, save and load it; keyframes and trajectories."""

from typing import TYPE_CHECKING

from stavpr_ros import former
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
    Map,
    Place,
    Session,
    thumbnail_of,
)
from stavpr_ros.mapping.trajectory import distance, rotation, Trajectory

__all__ = [
    'GrowingMap',
    'KeyframeSelector',
    'KeyframeSettings',
    'Map',
    'Place',
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

if not TYPE_CHECKING:
    __getattr__ = former.classes(__name__)
