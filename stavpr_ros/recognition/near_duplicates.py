# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Removes the places of a map at which the camera was at rest."""

from dataclasses import replace

import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.mapping import PlaceMap, select_places
from stavpr_ros.recognition.blocks import blocks
from stavpr_ros.recognition.robust import FilterSettings, MeanCentering
from tqdm import tqdm

MIN_MOTION = 0.1  # share of the median step; a camera that moved farther was not at rest


def without_duplicates(place_map: PlaceMap, progress: bool = False) -> PlaceMap:
    """
    Return a map with the first place of each stop of the camera only.

    The camera was at rest where a place hardly differs from the last kept one of its session, in
    relation to the mean change of neighbors, as the place filter decides it; and, where both have
    poses, hardly moved. Without poses, a drive through the dark is not distinguished from a stop.

    :param progress: show it on standard error.
    """
    n = len(place_map)
    least = FilterSettings().standstill * _mean_change(place_map, progress)
    step = _median_step(place_map)
    keeper, last = np.arange(n), np.empty((0, 0))
    for place, strips in _centered(place_map, 'drop duplicates', progress):
        kept = keeper[place - 1] if place else 0
        if (
            _is_first(place_map, place)
            or change_between(strips, last) >= least
            or _distance(place_map, kept, place) > MIN_MOTION * step
        ):
            last = strips
        else:
            keeper[place] = kept
    if place_map.same_as is not None:
        place_map = replace(place_map, same_as=_related(place_map.same_as, keeper))
    return select_places(place_map, np.flatnonzero(keeper == np.arange(n)))


def _centered(place_map, text, progress):  # type: ignore[no-untyped-def]
    """Yield number and features (W, d) of each place, centered."""
    centering = MeanCentering(place_map.features)
    bar = tqdm(total=len(place_map), desc=text, unit='place', disable=None if progress else True)
    with bar:
        for places, block in blocks(place_map.features):
            strips = centering.places(block).strips
            yield from zip(range(places.start, places.stop), strips.swapaxes(0, 1), strict=True)
            bar.update(places.stop - places.start)


def _is_first(place_map: PlaceMap, place: int) -> bool:
    """Whether a place is the first one of a session."""
    index = place_map.session_index
    return place == 0 or (index is not None and index[place] != index[place - 1])


def _mean_change(place_map: PlaceMap, progress: bool) -> float:
    """Return the mean change of neighbors in one session."""
    changes, before = [], np.empty((0, 0))
    for place, strips in _centered(place_map, 'compare neighbors', progress):
        if not _is_first(place_map, place):
            changes.append(change_between(strips, before))
        before = strips
    return float(np.mean(changes)) if changes else 1.0


def _distance(place_map: PlaceMap, one: int, other: int) -> float:
    """Return the distance between two places in meters, 0 where it is unknown."""
    first, second = place_map.pose(one), place_map.pose(other)
    if first is None or second is None:
        return 0.0
    return float(np.linalg.norm(second[:3] - first[:3]))


def _median_step(place_map: PlaceMap) -> float:
    """Return the median distance of neighbors in meters, 0 if unknown."""
    if place_map.poses is None:
        return 0.0
    steps = np.linalg.norm(np.diff(place_map.poses[:, :3], axis=0), axis=1)
    steps = steps[steps > 0]  # NaN is not
    return float(np.median(steps)) if len(steps) else 0.0


def _related(same_as: np.ndarray, keeper: np.ndarray) -> np.ndarray:
    """Return the relations of places between those that are kept."""
    step = same_as[keeper].astype(np.int32)
    while not np.array_equal(step[step], step):
        step = step[step]
    return step
