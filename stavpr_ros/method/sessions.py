# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map's sessions as columns of a window, and matches in columns as matches of places."""

from dataclasses import replace

import numpy as np
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import Candidate, ranked_candidates, WindowMatch, WindowSequences
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


def in_places(
    match: WindowMatch, layout: ColumnLayout, nms_radius: int | None = None
) -> WindowMatch:
    """
    Return a match whose columns have become places.

    :param nms_radius: of the second best; None = the one of the match is at another position.
    """
    path = match.path
    if layout.columns is None or path.place < 0:
        return match

    def sequences() -> WindowSequences:
        costs, columns, probabilities = match.sequences()
        possible = np.isfinite(costs)
        if probabilities is not None:
            probabilities = probabilities[possible]
        return WindowSequences(costs[possible], layout.names_of(columns[possible]), probabilities)

    place, second = layout.names_of(np.array([path.place, path.second_best])).tolist()
    second, distance = second if path.second_best >= 0 else -1, path.second_best_distance
    if nms_radius is not None:
        best = Candidate(place, path.distance)
        others = ranked_candidates(best, sequences(), 2, nms_radius, layout.positions)[1:]
        second = others[0].place if others else -1
        distance = others[0].distance if others else float('nan')
    pairs = path.pairs.copy()
    pairs[:, 1] = layout.names_of(pairs[:, 1])
    in_places = replace(
        path,
        pairs=pairs,
        place=place,
        second_best=second,
        second_best_distance=distance,
        direction=layout.direction_of(path.place),
    )
    return WindowMatch(in_places, sequences)


def time_note(place_map: PlaceMap) -> str:
    """Return what several sessions cost, for the log of a start, '' of a map of one."""
    n = len(place_map.sessions)
    return f'{n} sessions: an image takes up to {n} times the time of one' if n > 1 else ''
