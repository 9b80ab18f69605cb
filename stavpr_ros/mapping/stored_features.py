# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Features and thumbnails of a map that stay in its file, and are read by position on use.

What recognition learns from the features is kept beside them; docs/map_format.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.mapping.map_container import DTYPES, errors_of, MapFile
from stavpr_ros.mapping.map_schema import record, SHA256, text
from stavpr_ros.mapping.map_version2 import features_key
from stavpr_ros.memory import aligned_empty

STATISTICS = 'statistics'  # name of the section
DATA = record({'method': text(128), 'features': text(64, SHA256)})
CHANGES = 5  # places apart, at most, whose changes are kept
LIMITS = {  # range of the values in each part; norms may be 1.01, see MAX_NORM
    'mean': (-1.01, 1.01),
    'directions': (-1.01, 1.01),
    'gains': (0.01, 1.01),
    'changes': (-0.05, 2.05),
}
MAX_NORM = 1.01  # norm of a strip; float16 rounds it
CODES = f'{STATISTICS}/codes'
PLACES_AT_ONCE = 512  # places of one strip: they stay in the cache while they are checked


@dataclass(frozen=True, eq=False)
class MapStatistics:
    """
    Statistics of the features of a map, strips (W, n, d), as they are in its file.

    :param method: names how they were computed.
    :param mean: shape (W, d), float32.
    :param directions: directions of the whitening, unit norm or zero, shape (W, r, d), float32.
    :param gains: gains of the directions, over 0, at most 1, shape (W, r), float64.
    :param changes: change of each place from the ones 1 to ``CHANGES`` places before, shape
        (``CHANGES``, n), float32.
    :param codes: the features, centered, whitened and rounded to int8, shape (W, n, d); None =
        not kept, or not read.
    """

    method: str
    mean: np.ndarray
    directions: np.ndarray
    gains: np.ndarray
    changes: np.ndarray
    codes: np.ndarray | None = None

    def parts(self) -> dict[str, np.ndarray]:
        """Return the arrays by the names of their parts in the file."""
        arrays = {name: getattr(self, name) for name in (*LIMITS, 'codes')}
        return {
            f'{STATISTICS}/{name}': array for name, array in arrays.items() if array is not None
        }


def statistics_of(file: MapFile, arrays: dict[str, np.ndarray]) -> MapStatistics | None:
    """
    Return the statistics in an opened map; None if they are of other features.

    :param arrays: parts by name, of the right types and shapes.
    :raises ValueError: names what is wrong with them.
    """
    data = file.manifest['sections'][STATISTICS]['data']
    DATA(data, f'section {STATISTICS}')
    values = []
    for name, (low, high) in LIMITS.items():
        part = f'{STATISTICS}/{name}'
        if part not in arrays:
            raise ValueError(f'part {part} is missing')
        array = arrays[part]
        if array.size and not (array.min() >= low and array.max() <= high):  # NaN included
            raise ValueError(f'part {part} is not between {low} and {high}')
        values.append(array)
    is_present = data['features'] == features_key(file.parts['strips'].hashes)
    return MapStatistics(data['method'], *values) if is_present else None


class StoredThumbnails(Sequence[bytes]):
    """Thumbnails that stay in the map's file; thread-safe."""

    def __init__(self, file: MapFile, ends: np.ndarray) -> None:
        self._file, self._ends = file, ends

    def __len__(self) -> int:
        return len(self._ends)

    @overload
    def __getitem__(self, place: int) -> bytes: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[bytes, ...]: ...

    def __getitem__(self, place: int | slice) -> bytes | tuple[bytes, ...]:
        if isinstance(place, slice):
            return tuple(self[i] for i in range(len(self))[place])
        i = range(len(self))[place]
        start = int(self._ends[i - 1]) if i else 0
        with errors_of(self._file.path):
            return self._file.bytes_at(
                self._file.parts['thumbnails'].start + start, int(self._ends[i]) - start
            )


class StoredFeatures(LocalFeatures):
    """
    Features of a map that stay in its file, without a copy in memory.

    Every access to ``strips`` reads them all, ``features[places]`` a part. The file stays open, so
    that it may be replaced or deleted. Thread-safe.

    :param weights: see :class:`LocalFeatures`; in memory.

    ``statistics`` is what recognition has learned from them, None = unknown;
    ``has_stale_statistics`` whether the statistics in the file are of other features.
    """

    statistics: MapStatistics | None = None
    has_stale_statistics = False

    def __init__(
        self,
        file: MapFile,
        weights: np.ndarray,
        settings: FeatureSettings,
        cells: tuple[int, int] | None,
    ) -> None:
        self.file, self._part = file, file.parts['strips']
        for name, value in (('weights', weights), ('settings', settings), ('cells', cells)):
            object.__setattr__(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return self._part.shape[1]

    def __repr__(self) -> str:
        return f'StoredFeatures({str(self.file.path)!r}, {self._part.shape}, {self.settings})'

    def __getitem__(self, images: slice | np.ndarray) -> LocalFeatures:
        strips = self._read(np.arange(len(self))[images])
        return LocalFeatures(strips, self.weights[:, images], self.settings, self.cells)

    @property
    def dimension(self) -> int:
        """Return the number d of dimensions of a strip."""
        return self._part.shape[2]

    @property
    def storage(self) -> str:
        """Return the type in the file, ``float32`` or ``float16``."""
        return np.dtype(DTYPES[self._part.dtype]).name

    @property
    def strips(self) -> np.ndarray:
        """Return the features, read from the file; shape (W, n, d), float32."""
        return self._read(np.arange(len(self)))

    def strip(self, j: int) -> np.ndarray:
        """Return the features of one strip, shape (n, d), float32."""
        strip: np.ndarray = np.empty(self._part.shape[1:], np.float32)
        self._fill(strip, j, np.arange(len(self)))
        return strip

    @property
    def has_codes(self) -> bool:
        """Return whether the file has the codes, too, of the features of its statistics."""
        return self.statistics is not None and CODES in self.file.parts

    def codes(self, j: int, first: int, count: int) -> np.ndarray:
        """Return the codes of one strip of places, shape (count, d), int8."""
        _, n, d = self._part.shape
        codes: np.ndarray = np.empty((count, d), np.int8)
        self.file.fill(codes, self.file.parts[CODES].start + (j * n + first) * d)
        return codes

    def _read(self, places: np.ndarray) -> np.ndarray:
        """Return the features of places, shape (W, len(places), d), float32."""
        W, _, d = self._part.shape
        out = aligned_empty((W, len(places), d))
        for j in range(W):
            self._fill(out[j], j, places)
        return out

    def _fill(self, out: np.ndarray, j: int, places: np.ndarray) -> None:
        """Read strip j of places."""
        part, dtype = self._part, np.dtype(DTYPES[self._part.dtype])
        runs = np.split(np.arange(len(places)), np.flatnonzero(np.diff(places) != 1) + 1)
        starts = [(run, at) for run in runs for at in range(0, len(run), PLACES_AT_ONCE)]
        with errors_of(self.file.path):
            for run, at in starts:  # neighbors are read at once
                rows = run[at : at + PLACES_AT_ONCE]
                target, place = out[rows[0] : rows[-1] + 1], int(places[rows[0]])
                block = target if dtype == np.float32 else np.empty(target.shape, dtype)
                row = j * part.shape[1] + place
                self.file.fill(block, part.start + row * block[0].nbytes)
                if dtype != np.float32:
                    target[:] = block
                require_normalized(target, f'strips, strip {j}', place)


def require_normalized(rows: np.ndarray, name: str, place: int) -> None:
    """
    Reject features that are not finite, or longer than 1.

    :param rows: shape (places, d).
    :param name: name of the part, for the error; ``place`` is the number of the first one.
    :raises ValueError: names part and place.
    """
    for low in range(0, len(rows), PLACES_AT_ONCE):
        block = rows[low : low + PLACES_AT_ONCE].astype(np.float32, copy=False)
        if not (np.einsum('ij,ij->i', block, block) <= MAX_NORM**2).all():  # NaN included
            raise ValueError(
                f'part {name}, from place {place + low} on: features are not finite, or longer '
                'than 1'
            )
