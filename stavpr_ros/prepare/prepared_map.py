# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Maps prepared for recognition: features of the matcher, and statistics learned from them.

Learning takes several passes over the features; the statistics of a large map are in its file.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.map_container import errors_of
from stavpr_ros.mapping.stored_features import MapStatistics, StoredFeatures
from stavpr_ros.prepare.blocks import (
    convert_blocks,
    convert_features,
    Int8Features,
    MAX_LAG,
    PlaceChanges,
)
from stavpr_ros.prepare.centering import MeanCentering, RANK, SAMPLE, STRENGTH

METHOD = f'mean, whitening {RANK} of {SAMPLE} by {STRENGTH}, changes {MAX_LAG}, 2'
CODES_AT_ONCE = 4096  # places; a multiple of all LANES
MIN_PLACES = 1000  # of a map whose statistics are kept: as large as 70 places


@dataclass(frozen=True, eq=False)
class PreparedMap:
    """
    A map, prepared for a recognizer.

    :param features: for the matcher, in memory once.
    :param centering: learned from them; None without.
    :param changes: see :attr:`stavpr_ros.mapping.stored_features.MapStatistics.changes`.
    :param note: why statistics in the map's file are not used, for the log; empty = they are, or
        there are none.
    """

    features: LocalFeatures
    centering: MeanCentering | None
    changes: np.ndarray
    note: str = ''


def prepare_map(
    features: LocalFeatures,
    precision: str,
    centers: bool = True,
    whitens: bool = True,
    learns_changes: bool = True,
) -> PreparedMap:
    """
    Read and convert the features of a map.

    :param centers, whitens: see :class:`stavpr_ros.prepare.centering.MeanCentering`.
    :param learns_changes: from place to place, which the place filter needs.
    :param precision: see :func:`stavpr_ros.prepare.matcher.make_matcher`.
    """
    statistics, note, centering = None, '', None
    if isinstance(features, StoredFeatures) and centers and whitens:
        statistics, note = _usable(features)
    if centers or whitens:
        centering = MeanCentering(features, centers, whitens, statistics)
    learns = learns_changes and statistics is None
    changes = PlaceChanges(len(features) if learns else 0, MAX_LAG)
    rounds = precision == 'int8'
    if rounds and statistics and isinstance(features, StoredFeatures) and features.has_codes:
        prepared = _of_codes(features)
    elif centering is not None:
        prepared = centering.places(features, changes.add, rounds)
    elif rounds:
        prepared = convert_features(features, visit=changes.add, rounds=True)
    else:  # those of a map in memory are not copied
        prepared = whole = features[:]
        changes.add(whole.strips)
    learned = statistics.changes if statistics else changes.changes
    return PreparedMap(prepared, centering, learned, note)


def _usable(features: StoredFeatures) -> tuple[MapStatistics | None, str]:
    statistics = features.statistics
    if features.has_stale_statistics:
        why = 'are of other features'
    elif statistics is not None and statistics.method != METHOD:
        why = f'were learned by another version ({statistics.method!a})'
    else:
        return statistics, ''
    path = features.file.path
    return None, f'the statistics in {path} {why}: learned again; map compact renews them'


def _of_codes(features: StoredFeatures) -> LocalFeatures:
    """Return the features that are kept as codes in the map's file."""
    W, n = features.weights.shape
    strips: Any = Int8Strips(W, n, features.dimension)
    with errors_of(features.file.path):
        for j in range(W):
            for first in range(0, n, CODES_AT_ONCE):
                count = min(CODES_AT_ONCE, n - first)
                strips.copy(j, first, features.codes(j, first, count))
    return Int8Features(strips, features.weights, features.settings, features.cells)


def with_codes(statistics: MapStatistics, place_map: Map, storage: str) -> MapStatistics:
    """Add the features, rounded for precision int8; see :func:`statistics_of_map`."""
    features = _AsStored(place_map.features, storage)
    rounded = MeanCentering(features, statistics=statistics).places(features, rounds=True)
    assert isinstance(rounded, Int8Features)
    return replace(statistics, codes=rounded.strips.codes())


def statistics_of_map(place_map: Map, storage: str = '') -> MapStatistics | None:
    """
    Learn the statistics of a map that :func:`stavpr_ros.mapping.save_map` writes.

    :param storage: of the features in the file; '' = as :func:`stavpr_ros.mapping.save_map` does.
    :returns: None for a small map, whose file they would lengthen much.
    """
    if len(place_map) < MIN_PLACES:
        return None
    features = place_map.features
    stored = features.storage if isinstance(features, StoredFeatures) else 'float32'
    if (storage or stored) == stored and getattr(features, 'statistics', None) is not None:
        statistics, note = _usable(features)  # type: ignore[arg-type]
        if not note:
            return statistics
    features = _AsStored(features, storage or stored)
    centering, changes = MeanCentering(features), PlaceChanges(len(features), MAX_LAG)
    for _, strips in convert_blocks(features, lambda block: centering.places(block).strips):
        changes.add(strips)
    assert centering.whitening is not None
    whitening = centering.whitening
    return MapStatistics(
        METHOD,
        centering.mean,
        whitening.directions,
        whitening.gains,
        changes.changes,
    )


class _AsStored(LocalFeatures):
    """Features, read a block at a time, as they will be in a file of a storage."""

    def __init__(self, features: LocalFeatures, storage: str) -> None:
        for name in ('weights', 'settings', 'cells'):
            object.__setattr__(self, name, getattr(features, name))
        object.__setattr__(self, 'whole', features)
        object.__setattr__(self, 'dtype', np.dtype(storage))

    whole: LocalFeatures
    dtype: np.dtype[Any]

    def __len__(self) -> int:
        return len(self.whole)

    def __getitem__(self, images: slice | np.ndarray) -> LocalFeatures:
        block = self.whole[images]
        return replace(block, strips=block.strips.astype(self.dtype).astype(np.float32))

    @property
    def dimension(self) -> int:
        return self.whole.dimension
