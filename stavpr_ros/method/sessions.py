# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map's sessions as columns of a window, and what they cost."""

import numpy as np
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.model import Model
from stavpr_ros.prepare.blocks import MAX_LAG
from stavpr_ros.prepare.normalization import ONE_SESSION


def layout_of(
    place_map: PlaceMap,
    nms_radius: int,
    model: Model,
    against: bool = False,
    length: int = 0,
) -> ColumnLayout:
    """
    Return the layout of a map, for a window of the same model.

    :param against: the camera may move against the map.
    :param length: l, of a window that goes on over the seam of a closed route.
    """
    index, n = place_map.session_index, len(place_map)
    same_as = place_map.same_as
    if same_as is None:
        same_as = np.arange(n)
    firsts = ONE_SESSION if index is None else np.flatnonzero(np.diff(index, prepend=-1))
    repeated, seam = 0, place_map.seam
    if length and seam is not None:
        repeated = min(n - 1 - 2 * seam, int(length * max(model.speeds)))
        repeated = repeated if repeated > MAX_LAG else 0
    if (index is None and not against and not repeated) or not n:
        return ColumnLayout()
    gap = session_gap(nms_radius, model)
    return ColumnLayout(firsts, same_as.astype(np.int64), gap, against, repeated)


def session_gap(nms_radius: int, model: Model) -> int:
    """Return the number of columns between two sessions: no place is near to another session."""
    farthest = int(np.ceil(max(model.speeds))) + 1  # places from image to image
    return max(farthest, nms_radius) + 1


def time_note(place_map: PlaceMap) -> str:
    """Return what several sessions cost, for the log of a start, '' of a map of one."""
    n = len(place_map.sessions)
    return f'{n} sessions: an image takes up to {n} times the time of one' if n > 1 else ''
