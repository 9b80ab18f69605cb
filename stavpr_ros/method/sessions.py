# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions in columns of a window: the gap between them, and matches as matches of places."""

from dataclasses import replace

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import Candidate, ranked_candidates, WindowMatch, WindowSequences
from stavpr_ros.method.model import MODEL


def session_gap(nms_radius: int) -> int:
    """Return the number of columns between two sessions: no place is near to another session."""
    farthest = int(np.ceil(max(MODEL.speeds))) + 1  # places from image to image
    return max(farthest, nms_radius) + 1


def in_places(
    match: WindowMatch, layout: ColumnLayout, nms_radius: int | None = None
) -> WindowMatch:
    """
    Return a match whose columns have become places.

    :param nms_radius: of the second best; None = the one of the match is at another position.
    """
    if layout.columns is None or match.nearest is None:
        return match

    def sequences() -> WindowSequences:
        costs, columns, probabilities = match.sequences()
        possible = np.isfinite(costs)
        if probabilities is not None:
            probabilities = probabilities[possible]
        return WindowSequences(costs[possible], layout.names_of(columns[possible]), probabilities)

    nearest = match.nearest
    columns = np.array([nearest.first, nearest.last, nearest.middle, nearest.second_best_index])
    first, last, middle, second = layout.names_of(columns).tolist()
    second = second if nearest.second_best_index >= 0 else -1
    distance = nearest.second_best_distance
    if nms_radius is not None:
        best = Candidate(middle, nearest.distance)
        others = ranked_candidates(best, sequences(), 2, nms_radius, layout.positions)[1:]
        second = others[0].place if others else -1
        distance = others[0].distance if others else float('nan')
    nearest = SequenceMatch(first, last, middle, nearest.distance, second, distance)
    path = match.path.copy()
    path[:, 1] = layout.names_of(path[:, 1])
    direction = layout.direction_of(match.nearest.middle)
    return replace(match, nearest=nearest, path=path, sequences=sequences, direction=direction)


def time_note(place_map: PlaceMap) -> str:
    """Return what several sessions cost, for the log of a start, '' of a map of one."""
    n = len(place_map.sessions)
    return f'{n} sessions: an image takes up to {n} times the time of one' if n > 1 else ''
