# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window whose nearest sequence is found by LM-DTW (section 4 of the paper)."""

import numpy as np
from stavpr_ros.alignment.lm_dtw import (
    best_match,
    match_padded,
    padded_width,
    trace_sequence,
)
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.checks import no_nan
from stavpr_ros.memory import aligned_empty
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import Path, WindowMatch, WindowSequences
from stavpr_ros.method.window import QueryWindow
from stavpr_ros.prepare.centering import z_normalized


class LmDtwWindow(QueryWindow):
    """
    LM-DTW on the CPU; its twin is in :mod:`stavpr_ros.method.device`.

    The distances are one row behind the other, as the images, so that those of the window are one
    slice, oldest image first, as LM-DTW takes them.

    :param sequence: l and k.
    :param places: number of places n.
    :param layout: of the places.
    :param normalizes: z-normalize the distances of each image.
    :param around: see :func:`stavpr_ros.prepare.centering.z_normalized`.
    """

    def __init__(
        self,
        sequence: SequenceSettings,
        places: int,
        layout: ColumnLayout,
        normalizes: bool = False,
        around: int = 0,
    ) -> None:
        super().__init__(sequence.length, layout)
        self._normalizes, self._around = normalizes, around
        self._k, self._width = sequence.k, 0  # columns
        self._rows: np.ndarray = np.empty((2 * self.length, 0), np.float32)
        self.grow(self.layout.width(places))

    def push(self, row: np.ndarray, strips: np.ndarray, stamp: int) -> None:
        """
        See :meth:`QueryWindow.push`.

        :raises InputError: NaN or -inf in the row; the window is unchanged.
        """
        if self._normalizes:
            row = z_normalized(row, self._around, firsts=self.layout.starts)
        row = self.layout.to_columns(row)
        if not row.sum() > -np.inf:
            no_nan(row, 'image distances')
        if self._end == len(self._rows):
            self._rows[: self.length - 1] = self._rows[1 - self.length :]
        self._append(stamp)
        newest, m = self._rows[self._end - 1], len(row)
        newest[:m], newest[m : self._width] = row, np.inf
        self.size = max(self.size, m)

    def newest_row(self) -> np.ndarray:
        """See :meth:`QueryWindow.newest_row`."""
        return self._rows[self._end - 1, : self._width]

    def at(self, columns: np.ndarray) -> np.ndarray:
        """See :meth:`QueryWindow.at`."""
        return self._rows[self._end - len(self.images) : self._end, columns]

    def reset(self) -> None:
        """Drop all images."""
        super().reset()
        self._rows[:], self.size = np.inf, 0

    def grow(self, places: int) -> None:
        """Make room for more places; in the rows of the window they are +inf."""
        rows, before = self._rows, self._width
        self._width = places
        # with the padding that the kernel needs behind the places
        self._rows = aligned_empty((2 * self.length, padded_width(places, self._k)))
        self._rows[:] = np.inf
        self._rows[:, :before] = rows[:, :before]

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        super().evict(count)
        remaining = self._width - count
        self._rows[:, :remaining] = self._rows[:, count : self._width].copy()
        self._rows[:, remaining : self._width] = np.inf
        self.size = max(0, self.size - count)

    def match(self) -> WindowMatch:
        """See :meth:`QueryWindow.match`."""
        n, k, first = self.size, self._k, self.first
        # columns behind the known ones are +inf, as the padding that the kernel needs
        rows = self._rows[self._end - self.length : self._end, : padded_width(n, k)]
        window = np.ascontiguousarray(rows)
        matches = match_padded(window, n, k)
        nearest = best_match(matches, self.layout.nms_radius)
        if nearest is None:
            return WindowMatch()
        pairs = trace_sequence(window[:, :n], nearest.first, k)
        pairs[:, 1] += first  # counted from the first place ever, evicted ones included
        second = nearest.second_best_index
        path = Path(
            pairs,
            nearest.middle + first,
            nearest.distance,
            second_best=second + first if second >= 0 else -1,
            second_best_distance=nearest.second_best_distance,
        )
        match = WindowMatch(
            path, lambda: WindowSequences(matches.distances, matches.middles + first)
        )
        return self.layout.in_places(match, True)
