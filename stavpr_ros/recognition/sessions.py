# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Maps of several sessions in matching: no sequence runs from one session into another.

The searches see a row of columns instead of places: between two sessions lies a gap of columns
whose distances are +inf. Where a place of one session shows what one of an earlier session shows
(:attr:`stavpr_ros.mapping.PlaceMap.same_as`), the two are one position: their probabilities add
up, and neither is the second best of the other.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition.match import ranked_candidates
from stavpr_ros.recognition.place_filter import Belief
from stavpr_ros.recognition.robust import FilterSettings
import torch

Sequences = tuple[np.ndarray, np.ndarray]


class SessionLayout:
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
        self.width = n + (len(firsts) - 1) * self._gap
        self._places = np.repeat(np.arange(n), np.diff(self.columns, append=self.width))
        self._same_as = same_as
        self._shared = np.arange(self.width)  # column where the position's probability is summed
        self._shared[self.columns] = self.columns[same_as]
        is_gap = np.ones(self.width, bool)
        is_gap[self.columns] = False
        self.gaps = np.flatnonzero(is_gap)

    def spread(self, row: torch.Tensor) -> torch.Tensor:
        """Return distances to places (n,) as those to columns, (width,)."""
        out = torch.full((self.width,), torch.inf, dtype=row.dtype, device=row.device)
        out[torch.from_numpy(self.columns).to(row.device)] = row
        return out

    def positions_of(self, columns: np.ndarray) -> np.ndarray:
        """Return the positions of columns among those of places; in a gap, the one before."""
        return self.columns.searchsorted(columns, 'right') - 1

    def first_column(self, column: int) -> int:
        """Return the first column of a column's session."""
        firsts = self.columns[self.firsts]
        return int(firsts[np.searchsorted(firsts, column, 'right') - 1])

    def session_of(self, place: int) -> tuple[int, int]:
        """Return the first place of a place's session, and the first one behind it."""
        run = self.runs[int(np.searchsorted(self.firsts, place, 'right')) - 1]
        return int(run.start), int(run.stop)

    def summed(self, weights: np.ndarray, close: int) -> np.ndarray:
        """
        Add up probabilities of the same position in several sessions.

        :param weights: of each column alone, (width,).
        :param close: columns to either side that count for a position, too.
        :returns: probability of each column's position, (width,).
        """
        of_position = np.bincount(self._shared, weights, self.width)
        sums = np.concatenate([np.zeros(close + 1), np.cumsum(of_position)])
        sums = np.concatenate([sums, np.full(close, sums[-1])])
        return np.minimum(sums[2 * close + 1 :] - sums[: -2 * close - 1], 1)[self._shared]

    def shared(self, belief: Belief, close: int) -> tuple[np.ndarray, np.ndarray, int]:
        """
        Let places of one position share their probability.

        :param close: places to either side that count for a place, too.
        :returns: columns whose probability is not 0, ascending, and their probabilities; among
            them the most probable one: of the session that is most probable at the most probable
            position.
        """
        weights, own = np.zeros(self.width), np.zeros(self.width)
        weights[belief.places] = belief.weights
        near, probabilities_near = belief.probabilities(self.width)
        own[near] = probabilities_near
        probabilities = self.summed(weights, close)
        best = int(np.argmax(probabilities))
        at_position = np.abs(self._shared - self._shared[best]) <= close
        column = int(np.argmax(np.where(at_position, own, 0)))
        probabilities[column] = probabilities[best]
        columns = np.flatnonzero(probabilities)
        return columns, probabilities[columns], int(np.searchsorted(columns, column))

    def positions(self, places: np.ndarray | int) -> np.ndarray:
        """Return positions: those at most nms_radius apart are neighbors in one session."""
        return self.columns[self._same_as[places]]

    def in_places(
        self, nearest: SequenceMatch, path: np.ndarray, in_columns: Callable[[], Sequences]
    ) -> tuple[SequenceMatch, np.ndarray, Callable[[], Sequences]]:
        """Return the fields of a match whose columns have become places, with its second best."""

        def sequences() -> Sequences:
            costs, columns = in_columns()
            return costs, self._places[columns]

        path = path.copy()
        path[:, 1] = self._places[path[:, 1]]
        nearest = replace(
            nearest,
            first=int(self._places[nearest.first]),
            last=int(self._places[nearest.last]),
            middle=int(self._places[nearest.middle]),
        )
        second = ranked_candidates(nearest, sequences(), 2, self._radius, self.positions)[1:]
        nearest = replace(
            nearest,
            second_best_index=second[0].place if second else -1,
            second_best_distance=second[0].distance if second else float('nan'),
        )
        return nearest, path, sequences


def layout_of(place_map: PlaceMap, nms_radius: int) -> SessionLayout | None:
    """Return the layout of a map of several sessions, None of one session."""
    if place_map.session_index is None or not len(place_map):
        return None
    firsts = np.flatnonzero(np.diff(place_map.session_index, prepend=-1))
    if len(firsts) == 1:
        return None
    same_as = place_map.same_as
    if same_as is None:
        same_as = np.arange(len(place_map))
    return SessionLayout(firsts, same_as.astype(np.int64), nms_radius)
