# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Z-normalization of image distances, over the map (query) and over time (reference).

Query z-normalization brings a row, the distances of one image to all places, to mean 0 and
standard deviation 1. Reference z-normalization does the same for each place over the latest rows,
against hubness: places that are near to every image. Its running mean and variance start from the
distances of the map to itself. Causal: only rows that have arrived count.
"""

from collections.abc import Callable

import numpy as np

PRIOR = 20  # rows that the start counts for
MEMORY = 150  # rows after which old ones fade
MIN_DEVIATION = 1e-3  # standard deviation of a row below which it carries no information


class ZNormalization:
    """
    Query z-normalization, and the running statistics of each place for reference z-normalization.

    :param places: number of places n.
    :param query: normalize rows.
    :param reference: normalize places.
    """

    def __init__(self, places: int, query: bool = True, reference: bool = True) -> None:
        self.query, self.reference = query, reference
        self._start = np.zeros(places, np.float32), np.ones(places, np.float32)
        self.reset()

    def start_from(self, rows: np.ndarray) -> None:
        """
        Start from the distances of the map to itself.

        :param rows: distances of some places to all, shape (m, n), float32; NaN where they are
            neighbors. Written over: copies of all of them would stay in the heap of the process.
        """
        n = len(self._mean)
        count, total, squares = np.zeros(n, np.int64), np.zeros(n, np.float32), np.zeros(n)
        for row in rows:
            row[:] = self.normalized(row)
            count += np.isfinite(row)
            total += np.nan_to_num(row, posinf=0, neginf=0)
        usable = count > 1
        if not usable.any():
            return
        mean = total / np.maximum(count, 1)
        if not usable.all():
            known = rows[np.isfinite(rows)]
            mean[~usable] = known.mean()
        for row in rows:
            squares += np.where(np.isfinite(row), (row - mean) ** 2, 0)
        variance = squares / np.maximum(count, 1)
        if not usable.all():
            variance[~usable] = known.var()
        variance[variance <= 0] = 1
        self._start = mean.astype(np.float32), variance.astype(np.float32)
        self.reset()

    def reset(self) -> None:
        """Drop the rows observed so far; the start stays."""
        self._mean, self._variance = (values.copy() for values in self._start)
        self._count = np.full(len(self._mean), PRIOR, np.float32)

    def grow(self, places: int) -> None:
        """Make room for more places, which start with mean 0 and deviation 1."""
        more = places - len(self._mean)
        self._change_each(
            lambda values, start: np.append(values, np.full(more, start, np.float32))
        )

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up, and as many new ones have room behind them."""
        self._change_each(
            lambda values, start: np.append(values[count:], np.full(count, start, np.float32))
        )

    def _change_each(self, change: Callable[[np.ndarray, float], np.ndarray]) -> None:
        """Change every array of one value a place; the second argument is the value of a new place."""
        self._start = change(self._start[0], 0), change(self._start[1], 1)
        self._mean, self._variance = change(self._mean, 0), change(self._variance, 1)
        self._count = change(self._count, PRIOR)

    def normalized(self, row: np.ndarray) -> np.ndarray:
        """Return a row with mean 0 and deviation 1 of its finite entries, shape (n,), float32."""
        known = row[np.isfinite(row)] if self.query else row[:0]
        if not known.size:
            return row
        return (row - known.mean()) / np.float32(max(known.std(), MIN_DEVIATION))

    def observe(self, row: np.ndarray) -> None:
        """Add a row, normalized if rows are, to the statistics of the first m <= n places."""
        if not self.reference:
            return
        n = len(row)
        mean, variance, count = self._mean[:n], self._variance[:n], self._count[:n]
        np.minimum(count + 1, MEMORY, out=count)
        off = row - mean
        mean += off / count
        variance += (off * (row - mean) - variance) / count

    def shift_and_scale(self, places: int) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and reciprocal deviation of the first places, shape (places,) each; a view of the mean."""
        if not self.reference:
            return np.zeros(places, np.float32), np.ones(places, np.float32)
        return self._mean[:places], 1 / np.sqrt(np.maximum(self._variance[:places], 1e-6))

    def scaled(self, rows: np.ndarray) -> np.ndarray:
        """Return rows of the first m places, shape (..., m), with reference z-normalization, if any."""
        if not self.reference:
            return rows
        shift, scale = self.shift_and_scale(rows.shape[-1])
        return (rows - shift) * scale
