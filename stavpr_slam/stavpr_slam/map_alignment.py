# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr map merge --align``: a map in the frame of another."""

from dataclasses import replace

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_slam.pose_graph import align_maps


def align(place_map: Map, reference: Map) -> Map:
    """
    Return a map in the frame of another, by the places that are recognized on it.

    :raises StavprError: a map has no poses, or too few places are recognized.
    """
    if place_map.poses is None or reference.poses is None:
        raise InputError('--align: a map has no poses; expected maps recorded with odometry')
    recognizer = PlaceRecognizer(reference, RecognizerSettings())
    pairs = []
    for i in range(len(place_map)):
        match = recognizer.update(place_map.features[i : i + 1])
        if match.accepted and len(path := match.path.pairs):
            position, place = path[len(path) // 2].tolist()
            pairs.append((i - int(path[-1, 0]) + position, place))
    places = np.array(pairs, np.int64).reshape(-1, 2)
    print(f'{len(places)} of {len(place_map)} places are recognized on the first map')
    transform = align_maps(reference.poses, place_map.poses, places)
    return replace(place_map, poses=to_poses(transform @ matrices(place_map.poses)), map_id='')
