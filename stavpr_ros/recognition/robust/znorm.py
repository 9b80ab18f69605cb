"""
Distances on a scale that all images and all places share.

A row, the distances of one image to all places, is brought to mean 0 and deviation 1 over the places. For
every place the mean and the deviation of its entry in the latest rows are kept, started from the map's
distances to itself, so that a window can be brought to mean 0 and deviation 1 over the images as well.
Causal: only rows that have come count.
"""

from collections.abc import Callable

import numpy as np

PRIOR = 20  # rows that the start counts for
MEMORY = 150  # rows after which old ones fade
FLAT = 1e-3  # deviation of a row below which it tells nothing


class Calibration:
    """
    Running statistics of the distances to each place.

    :param places: number of places n.
    :param rows: normalize rows.
    :param columns: calibrate places.
    """

    def __init__(self, places: int, rows: bool = True, columns: bool = True) -> None:
        self._rows, self._columns = rows, columns
        self._start = np.zeros(places, np.float32), np.ones(places, np.float32)
        self.reset()

    def start_from(self, rows: np.ndarray) -> None:
        """
        Start from the map's distances to itself.

        :param rows: some places' distances to all, shape (m, n); NaN where they are near each other.
        """
        known = np.isfinite(rows)
        rows = np.stack([self.normalized(row) for row in rows]) if len(rows) else rows
        count = known.sum(axis=0)
        usable = count > 1
        if not usable.any():
            return
        total = np.where(known, rows, 0).sum(axis=0)
        mean = np.where(usable, total / np.maximum(count, 1), rows[known].mean())
        squares = np.where(known, (rows - mean) ** 2, 0).sum(axis=0)
        variance = np.where(usable, squares / np.maximum(count, 1), rows[known].var())
        variance = np.where(variance > 0, variance, 1)
        self._start = mean.astype(np.float32), variance.astype(np.float32)
        self.reset()

    def reset(self) -> None:
        """Forget the rows that came."""
        self._mean, self._variance = (values.copy() for values in self._start)
        self._count = np.full(len(self._mean), PRIOR, np.float32)

    def grow(self, places: int) -> None:
        """Make room for more places, which start with mean 0 and deviation 1."""
        more = places - len(self._mean)
        self._change_each(lambda values, start: np.append(values, np.full(more, start, np.float32)))

    def forget(self, count: int) -> None:
        """Forget the first places; the others move up, and there is room for as many new ones behind them."""
        self._change_each(lambda values, start: np.append(values[count:], np.full(count, start, np.float32)))

    def _change_each(self, change: Callable[[np.ndarray, float], np.ndarray]) -> None:
        """Change all that is kept of every place; each comes with what a new place starts with."""
        self._start = change(self._start[0], 0), change(self._start[1], 1)
        self._mean, self._variance = change(self._mean, 0), change(self._variance, 1)
        self._count = change(self._count, PRIOR)

    def normalized(self, row: np.ndarray) -> np.ndarray:
        """Bring the known entries of a row to mean 0 and deviation 1, shape (n,), float32."""
        known = row[np.isfinite(row)]
        if not self._rows or not known.size:
            return row
        return (row - known.mean()) / np.float32(max(known.std(), FLAT))

    def observe(self, row: np.ndarray) -> None:
        """Take a normalized row into the statistics of the first places."""
        if not self._columns:
            return
        n = len(row)
        mean, variance, count = self._mean[:n], self._variance[:n], self._count[:n]
        np.minimum(count + 1, MEMORY, out=count)
        off = row - mean
        mean += off / count
        variance += (off * (row - mean) - variance) / count

    def shift_and_scale(self, places: int) -> tuple[np.ndarray, np.ndarray]:
        """Return what is taken off the first places' entries, and what they are multiplied with then."""
        if not self._columns:
            return np.zeros(places, np.float32), np.ones(places, np.float32)
        return self._mean[:places], 1 / np.sqrt(np.maximum(self._variance[:places], 1e-6))
