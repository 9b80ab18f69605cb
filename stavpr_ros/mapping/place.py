# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One place of a fixed or growing map."""

from dataclasses import dataclass

import cv2
import numpy as np
from stavpr_ros.mapping.growing_map import GrowingMap
from stavpr_ros.mapping.place_map import PlaceMap


@dataclass(frozen=True)
class Place:
    """
    Stamp, identifier and pose of a place.

    :param stamp: ns, 0 = unknown.
    :param identifier: external identifier, '' = none.
    :param pose: x y z (meters) and quaternion x y z w, shape (7,), or None.
    """

    stamp: int = 0
    identifier: str = ''
    pose: np.ndarray | None = None


def place_at(places: PlaceMap | GrowingMap, index: int) -> Place:
    """
    Return stamp, identifier and pose of a place.

    :param index: 0-based; in a growing map counted from its start, evicted places included.
    """
    if isinstance(places, GrowingMap):
        index -= places.first
        pose = places.poses[index]
        known = pose.copy() if np.isfinite(pose).all() else None
        return Place(int(places.stamps[index]), places.ids[index], known)
    return Place(int(places.stamps[index]), places.ids[index], places.pose(index))


def place_thumbnail(places: PlaceMap | GrowingMap, index: int) -> np.ndarray | None:
    """Return the thumbnail of a place, RGB (h, w, 3) uint8, or None; indices as above."""
    if isinstance(places, PlaceMap):
        return places.thumbnail(index)
    content = places.thumbnails[index - places.first]
    if not content:
        return None
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
