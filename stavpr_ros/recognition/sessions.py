# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Places in the columns of a window's rows: no sequence continues from one session into another.

Between two sessions lies a gap of columns whose distances are +inf. A place of one session and the
place of an earlier session with the same view (:attr:`stavpr_ros.mapping.PlaceMap.same_as`) are
one position: their probabilities add up, and neither is the second best of the other.
"""

from dataclasses import replace

import numpy as np
from stavpr_ros.filter.model import FilterSettings
from stavpr_ros.filter.paths import Belief
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition.match import Candidate, ranked_candidates, WindowMatch, WindowSequences
from stavpr_ros.recognition.window import ColumnLayout


class SessionLayout(ColumnLayout):
    """
    Places of several sessions in columns with gaps between them.

    :param firsts: first place of every run of places of one session, ascending, (m,), m > 1; the
        first one is 0.
    :param same_as: for each place, itself, or the place of an earlier session that shows the
        same, (n,).
    :param nms_radius: see :class:`stavpr_ros.recognition.RecognizerSettings`.
    """

    def __init__(self, firsts: np.ndarray, same_as: np.ndarray, nms_radius: int) -> None:
        n = len(same_as)
        farthest = int(np.ceil(max(FilterSettings().speeds))) + 1  # places from image to image
        self._gap, self._radius = max(farthest, nms_radius) + 1, nms_radius
        self.firsts = firsts
        self.runs = [slice(*pair) for pair in zip(firsts, [*firsts[1:], n], strict=True)]
        run = np.repeat(np.arange(len(firsts)), np.diff(firsts, append=n))
        self.columns = np.arange(n) + run * self._gap
        self._width = n + (len(firsts) - 1) * self._gap
        self._positions = np.repeat(np.arange(n), np.diff(self.columns, append=self._width))
        self._places = self._positions  # of each column, as matches name them
        self._same_as = same_as
        self._shared = np.arange(self._width)  # column where the position's probability is summed
        self._shared[self.columns] = self.columns[same_as]
        is_gap = np.ones(self._width, bool)
        is_gap[self.columns] = False
        self.gaps = np.flatnonzero(is_gap)

    def width(self, places: int) -> int:
        """See :meth:`ColumnLayout.width`."""
        return self._width

    def spread(self, row: np.ndarray) -> np.ndarray:
        """See :meth:`ColumnLayout.spread`."""
        out: np.ndarray = np.full(self._width, np.inf, row.dtype)
        out[self.columns] = row
        return out

    def gathered(self, values: np.ndarray) -> np.ndarray:
        """See :meth:`ColumnLayout.gathered`."""
        return values[self.columns]

    def columns_of(self, places: np.ndarray) -> np.ndarray:
        """See :meth:`ColumnLayout.columns_of`."""
        return self.columns[places]

    def positions_of(self, columns: np.ndarray) -> np.ndarray:
        """See :meth:`ColumnLayout.positions_of`."""
        return self._positions[columns]

    def positions_from(self, columns: np.ndarray) -> np.ndarray:
        """See :meth:`ColumnLayout.positions_from`."""
        return self.columns.searchsorted(columns)

    def first_column(self, column: int) -> int:
        """See :meth:`ColumnLayout.first_column`."""
        firsts = self.columns[self.firsts]
        return int(firsts[np.searchsorted(firsts, column, 'right') - 1])

    def session_of(self, place: int) -> tuple[int, int]:
        """See :meth:`ColumnLayout.session_of`."""
        run = self.runs[int(np.searchsorted(self.firsts, place, 'right')) - 1]
        return int(run.start), int(run.stop)

    def summed(self, weights: np.ndarray, close: int) -> np.ndarray:
        """
        Add up probabilities of the same position in several sessions.

        :param weights: of each column alone, (width,).
        :param close: columns to either side that count for a position, too.
        :returns: probability of each column's position, (width,).
        """
        of_position = np.bincount(self._shared, weights, self._width)
        sums = np.concatenate([np.zeros(close + 1), np.cumsum(of_position)])
        sums = np.concatenate([sums, np.full(close, sums[-1])])
        return np.minimum(sums[2 * close + 1 :] - sums[: -2 * close - 1], 1)[self._shared]

    def shared(self, belief: Belief, n: int, close: int) -> tuple[np.ndarray, np.ndarray, int]:
        """See :meth:`ColumnLayout.shared`."""
        weights, own = np.zeros(self._width), np.zeros(self._width)
        weights[belief.places] = belief.weights
        near, probabilities_near = belief.probabilities(self._width)
        own[near] = probabilities_near
        probabilities = self.summed(weights, close)
        best = int(np.argmax(probabilities))
        at_position = np.abs(self._shared - self._shared[best]) <= close
        column = int(np.argmax(np.where(at_position, own, 0)))
        probabilities[column] = probabilities[best]
        columns = np.flatnonzero(probabilities)
        return columns, probabilities[columns], int(np.searchsorted(columns, column))

    def positions(self, places: np.ndarray | int) -> np.ndarray:
        """See :meth:`ColumnLayout.positions`."""
        return self.columns[self._same_as[places]]

    def in_places(self, found: WindowMatch) -> WindowMatch:
        """See :meth:`ColumnLayout.in_places`."""

        def sequences() -> WindowSequences:
            return in_columns._replace(places=self._places[in_columns.places])

        if found.nearest is None:
            return found
        in_columns = found.sequences()
        first, last, middle = (
            int(self._places[column])
            for column in (found.nearest.first, found.nearest.last, found.nearest.middle)
        )
        best = Candidate(middle, found.nearest.distance)
        second = ranked_candidates(best, sequences(), 2, self._radius, self.positions)[1:]
        nearest = replace(
            found.nearest,
            first=first,
            last=last,
            middle=middle,
            second_best_index=second[0].place if second else -1,
            second_best_distance=second[0].distance if second else float('nan'),
        )
        path = found.path.copy()
        path[:, 1] = self._places[path[:, 1]]
        return replace(found, nearest=nearest, path=path, sequences=sequences)


def layout_of(place_map: PlaceMap, nms_radius: int) -> ColumnLayout:
    """Return the layout of a map."""
    if place_map.session_index is None or not len(place_map):
        return ColumnLayout()
    firsts = np.flatnonzero(np.diff(place_map.session_index, prepend=-1))
    if len(firsts) == 1:
        return ColumnLayout()
    same_as = place_map.same_as
    if same_as is None:
        same_as = np.arange(len(place_map))
    return SessionLayout(firsts, same_as.astype(np.int64), nms_radius)
