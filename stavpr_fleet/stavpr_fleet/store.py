# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The protocol of stores, and the index that a robot downloads.

The vector of a place is made of its centered and whitened strips: the means of three groups of
neighboring strips, joined, unit norm.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from stavpr_ros.errors import FleetError
from stavpr_ros.mapping import Map, select_places, Session
from stavpr_ros.prepare.blocks import convert_blocks
from stavpr_ros.prepare.centering import evenly, MeanCentering, normalize

RUNS, RUN = 256, 8  # the sample of a map: so many runs of so many neighboring places
GROUPS = 3  # groups of strips in a place's vector
MAX_PLACES = 2**31 - 1


@dataclass(frozen=True, eq=False)
class MapIndex:
    """
    The part of a map that a robot downloads before any place.

    :param places: number n of places.
    :param firsts: first place of every run of one session's places, ascending, int64; the first
        one is 0.
    :param sessions: session of each run; empty = the map has none.
    :param sample: the places :func:`sample_places` of the map, with its settings and projection.
    :param map_id: identifier of the map.
    """

    places: int
    firsts: np.ndarray
    sessions: tuple[Session, ...]
    sample: Map
    map_id: str = ''

    def __post_init__(self) -> None:
        if not 0 < self.places <= MAX_PLACES:
            raise FleetError(f'a map of {self.places} places: expected 1 to {MAX_PLACES}')
        if len(self.sample) != len(sample_places(self.places)):
            raise FleetError(
                f'the sample of the map has {len(self.sample)} places: expected '
                f'{len(sample_places(self.places))} of {self.places}; upload the map again'
            )
        firsts = self.firsts
        if firsts[:1] != [0] or (np.diff(firsts) <= 0).any() or firsts[-1] >= self.places:
            raise FleetError(f'sessions begin at {firsts[:8].tolist()}: upload the map again')
        if len(self.sessions) not in (0, len(firsts)):
            raise FleetError(f'{len(self.sessions)} sessions for {len(firsts)} runs of places')

    @classmethod
    def of(cls, place_map: Map) -> 'MapIndex':
        """Return the index of a map."""
        numbers = place_map.session_index
        firsts, sessions = np.zeros(1, np.int64), ()
        if numbers is not None:
            firsts = np.flatnonzero(np.diff(numbers, prepend=-1))
            sessions = tuple(place_map.sessions[number] for number in numbers[firsts])
        sample = select_places(place_map, sample_places(len(place_map)))
        return cls(len(place_map), firsts, sessions, sample, place_map.map_id)

    def runs(self, places: np.ndarray) -> np.ndarray:
        """Return the run of each place, (m,)."""
        return np.searchsorted(self.firsts, places, 'right') - 1

    @cached_property
    def dimension(self) -> int:
        """Return the number of dimensions of a place's vector."""
        return place_vectors(self.sample.features[:1].strips).shape[1]

    def centering(self) -> MeanCentering:
        """Return the centering and whitening that the sample gives: the same for all robots."""
        return MeanCentering(self.sample.features)


class PlaceStore(Protocol):
    """A store of a map. Its calls may come from another thread, one at a time."""

    @property
    def index(self) -> MapIndex:
        """Return what is known of the map as a whole."""

    def nearest(self, vectors: np.ndarray, count: int) -> np.ndarray:
        """
        Return the places whose vectors are nearest, nearest first.

        :param vectors: vectors of images, (Q, D), float32, unit norm.
        :returns: shape (Q, count), int64; -1 behind the last.
        :raises FleetError: the store cannot be reached, or its data is damaged.
        """

    def fetch(self, places: np.ndarray) -> tuple[Map, np.ndarray]:
        """
        Return places as a map, and of each itself or the place that shows the same, int64.

        :param places: ascending, int64.
        :raises FleetError: as for :meth:`nearest`.
        """


def sample_places(n: int) -> np.ndarray:
    """Return the places that every robot knows: runs of neighbors, evenly spaced, int64."""
    runs = evenly(max(n - RUN + 1, 1), RUNS)
    return np.unique(np.minimum(runs[:, None] + np.arange(RUN), n - 1))


def place_vectors(strips: np.ndarray) -> np.ndarray:
    """
    Return the vectors of places or images.

    :param strips: centered, unit norm, (W, n, d).
    :returns: shape (n, D), float32, unit norm; D = 3 d, or d of a single strip.
    """
    W = len(strips)
    size = -(-W // GROUPS)
    firsts = np.unique(np.rint(np.linspace(0, W - size, GROUPS)).astype(int))
    groups = [normalize(strips[first : first + size].mean(axis=0)) for first in firsts]
    return normalize(np.concatenate(groups, axis=1))


def map_vectors(place_map: Map, index: MapIndex) -> np.ndarray:
    """Return the vectors of all places, (n, D), float32; features are read block by block."""
    centering = index.centering()
    vectors = np.empty((len(place_map), index.dimension), np.float32)
    for places, block in convert_blocks(place_map.features, centering.places):
        vectors[places] = place_vectors(block.strips)
    return vectors
