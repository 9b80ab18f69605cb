"""The rolling buffer: one row of image distances for each of the last l query images."""

import numpy as np

from stavpr_ros.alignment.lm_dtw import padded_width


class DistanceWindow:
    """
    A ring of the last l rows that always lies contiguous in memory, oldest row first.

    Every row is written twice, l rows apart, so that the last l rows are one slice of the buffer.

    :param length: rows l.
    :param places: map images n.
    :param k: map images a start sees, for the padding that the kernel wants.
    """

    def __init__(self, length: int, places: int, k: int) -> None:
        self._length, self._places, self._k = length, places, k
        self._rows = np.full((2 * length, padded_width(places, k)), np.inf, np.float32)
        self._count = 0

    def __len__(self) -> int:
        return min(self._count, self._length)

    @property
    def full(self) -> bool:
        """As many rows as the window is long have been pushed."""
        return self._count >= self._length

    def push(self, row: np.ndarray) -> None:
        """
        Add the distances of the newest image and drop the oldest.

        :param row: shape (m,), of the first m <= n places; +inf for the others.
        """
        for slot in (self._count % self._length, self._count % self._length + self._length):
            self._rows[slot, : len(row)] = row
            self._rows[slot, len(row) : self._places] = np.inf
        self._count += 1

    def rows(self) -> np.ndarray:
        """Return the window, shape (l, n + padding), float32, a view; +inf in the padding."""
        first = self._count % self._length
        return self._rows[first : first + self._length]

    def forget(self, count: int) -> None:
        """Take the first places out; the others move up, and there is room for as many new ones behind."""
        kept = self._places - count
        self._rows[:, :kept] = self._rows[:, count : self._places]
        self._rows[:, kept : self._places] = np.inf

    def widened(self, places: int) -> 'DistanceWindow':
        """Return a window with the same rows for more places, +inf for those that are new."""
        wider = DistanceWindow(self._length, places, self._k)
        wider._rows[:, : self._places] = self._rows[:, : self._places]
        wider._count = self._count
        return wider
