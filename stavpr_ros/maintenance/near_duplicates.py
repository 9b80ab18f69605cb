# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Removes the places of a map at which the camera was at rest."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.mapping import Map, select_places
from stavpr_ros.method.model import STANDSTILL
from stavpr_ros.prepare.blocks import convert_blocks, PlaceChanges
from stavpr_ros.prepare.centering import MeanCentering
from stavpr_ros.progress import Progress

MIN_MOTION = 0.1  # share of the median step; a camera that moved farther was not at rest


def without_duplicates(place_map: Map) -> Map:
    """
    Return a map with the first place of each stop of the camera only.

    The camera was at rest where a place hardly differs from the last kept one of its session, in
    relation to the mean change of neighbors, as the place filter decides it; and, where both have
    poses, hardly moved. Without poses, a drive through the dark is not distinguished from a stop.
    """
    n, index = len(place_map), place_map.session_index
    centering, changes = MeanCentering(place_map.features), PlaceChanges(n, 1)
    for _, strips in _center(place_map, centering, 'compare neighbors'):
        changes.add(strips)
    is_first = np.diff(np.zeros(n) if index is None else index, prepend=-1) != 0
    neighbors = changes.changes[0, ~is_first]
    min_change = STANDSTILL * (neighbors.mean(dtype=float) if len(neighbors) else 1)
    positions = np.full((n, 3), np.nan) if place_map.poses is None else place_map.poses[:, :3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    moved = MIN_MOTION * float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    keeper, reference, last = np.arange(n), 0, np.empty((0, 0))
    for places, block in _center(place_map, centering, 'drop duplicates'):
        for place, strips in zip(range(n)[places], block.swapaxes(0, 1), strict=True):
            distance = np.linalg.norm(positions[place] - positions[reference])  # NaN = unknown
            if is_first[place] or change_between(strips, last) >= min_change or distance > moved:
                reference, last = place, strips
            keeper[place] = reference
    if place_map.same_as is not None:
        place_map = replace(place_map, same_as=_relate(place_map.same_as, keeper))
    return select_places(place_map, np.flatnonzero(keeper == np.arange(n)))


def _center(
    place_map: Map, centering: MeanCentering, text: str
) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield the centered features of each block, (W, m, d); a terminal shows the progress."""
    with Progress(total=len(place_map), desc=text, unit='place') as bar:
        for places, block in convert_blocks(place_map.features, centering.places):
            yield places, block.strips
            bar.update(places.stop - places.start)


def _relate(same_as: np.ndarray, keeper: np.ndarray) -> np.ndarray:
    """Return the relations of places between the remaining places."""
    step = same_as[keeper].astype(np.int32)
    while not np.array_equal(step[step], step):
        step = step[step]
    return step
