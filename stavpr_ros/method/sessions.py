# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions in columns of a window: the gap between them, and what they cost."""

import numpy as np
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.method.model import MODEL


def session_gap(nms_radius: int) -> int:
    """Return the number of columns between two sessions: no place is near to another session."""
    farthest = int(np.ceil(max(MODEL.speeds))) + 1  # places from image to image
    return max(farthest, nms_radius) + 1


def time_note(place_map: PlaceMap) -> str:
    """Return what several sessions cost, for the log of a start, '' of a map of one."""
    n = len(place_map.sessions)
    return f'{n} sessions: an image takes up to {n} times the time of one' if n > 1 else ''
