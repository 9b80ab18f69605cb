# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Columns of the filter's states: places, with a gap between two sessions.

Columns of a gap have infinite distances, and a state that enters one leaves the map, so that no
path continues from one session into another. A place and the place of an earlier session with the
same view (:attr:`stavpr_ros.mapping.Map.same_as`) are one position: their probabilities add
up, and neither is the second best of the other. A position is numbered by the column of its first
place.

Where the camera may move against the map, its places follow once more, from the last one to the
first, so that it always moves on to the next column. The two columns of a place are one position
with one distance::

    place      0 1 2 ... n-1     |  gap  |  n-1 ... 2 1 0

On a closed route, whose last c places show the same as its first c, the first places follow the
last one again, so that a path goes on over the seam. Once all of a window's path is there, the
states of these columns are moved one lap back (:meth:`ColumnLayout.seam_columns`)::

    place      0 1 ... c-1 ... n-c ... n-1 c c+1 ...
                               |<- shows 0 ... c-1
"""

from dataclasses import replace
import math
import sys

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.errors import InputError
from stavpr_ros.method.filter import NO_PLACES
from stavpr_ros.method.match import Candidate, WindowMatch, WindowSequences
from stavpr_ros.method.model import CLOSE, MODEL
from stavpr_ros.prepare.centering import ONE_SESSION


class ColumnLayout:
    """
    Columns of the places of a map.

    :param firsts: first place of every run of places of one session, ascending, (m,); the first
        one is 0. One session: each place is the column of its number.
    :param same_as: of each place, itself or the one of an earlier session that shows it, (n,).
    :param nms_radius: places that are at most so many positions apart are neighbors. A gap has
        more columns, and more than a camera moves from image to image.
    :param against: the camera may move against the map, too; not without places.
    :param repeated: first places of a closed route of one session that follow its last one.

    ``starts`` are the first places of the sessions, ``columns`` the columns of the places along
    the map and, behind these, of the others, None where each place is the column of its number,
    and ``gaps`` the columns between. ``lap``: places of a closed route's lap, 0 of another route.
    """

    names_places = False  # with one session, too, matches number places otherwise than columns

    def __init__(
        self,
        firsts: np.ndarray = ONE_SESSION,
        same_as: np.ndarray = NO_PLACES,
        nms_radius: int = 0,
        against: bool = False,
        repeated: int = 0,
    ) -> None:
        self.starts, self.nms_radius, self.lap, self.gaps = firsts, nms_radius, 0, NO_PLACES
        self.columns: np.ndarray | None = None
        if len(firsts) == 1 and not (against or repeated or self.names_places):
            return
        n = self._n = len(same_as)
        self.lap = n - int(same_as[-1]) - 1 if repeated else 0
        places = np.append(np.arange(n), np.arange(n, n + repeated) - self.lap)
        self._along = len(places)
        if against:
            places = np.append(places, n - 1 - places)
            ends = np.append(firsts[1:], n)[::-1]
            firsts = np.append(firsts, self._along + n - ends)
        gap = max(math.ceil(max(MODEL.speeds)) + 1, nms_radius) + 1
        runs = np.repeat(np.arange(len(firsts)), np.diff(firsts, append=len(places)))
        self.columns = np.arange(len(places)) + gap * runs
        self._firsts, self._width = self.columns[firsts], int(self.columns[-1]) + 1
        self.gaps = np.setdiff1d(np.arange(self._width), self.columns)
        # of each column; in a gap, the place before it, and a position far from all
        before = self.columns.searchsorted(np.arange(self._width), 'right') - 1
        self._places = places[before]
        self._direction = np.where(before < self._along, 1, -1)
        self._positions = np.full(self._width, -2 * self._width)
        self._positions[self.columns] = self.columns[same_as[places]]
        self._same_as = same_as

    def changes_from_before(self, changes: np.ndarray) -> np.ndarray:
        """
        Return the change of each column from the one before, (width,); 1 where nothing is.

        :param changes: of each place from the place before, (n,).
        """
        if self.columns is None:
            return changes
        later = np.minimum(self._places + 1, self._n - 1)
        out: np.ndarray = changes[np.where(self._direction > 0, self._places, later)]
        for first in self._firsts if self.lap else ():  # over the seam: as behind it
            out[first + self._n] = out[first + self._n + 1]
        out[self._firsts], out[self.gaps] = 1, 1
        return out

    def width(self, places: int) -> int:
        """Return the number of columns of so many places."""
        return places if self.columns is None else self._width

    def to_columns(self, row: np.ndarray) -> np.ndarray:
        """Return distances to places (n,) as distances to columns, +inf in gaps."""
        if self.columns is None:
            return row
        out: np.ndarray = row[self._places]
        out[self.gaps] = np.inf
        return out

    def to_places(self, values: np.ndarray) -> np.ndarray:
        """Return the values of the columns of the places along the map, (n,)."""
        return values if self.columns is None else values[self.along(self._n)]

    def along(self, places: int) -> 'slice | np.ndarray':
        """Return the columns of all places, passed along the map, as an index."""
        return slice(places) if self.columns is None else self.columns[:places]

    def sums_of_places(self, values: np.ndarray) -> np.ndarray:
        """Return the sums of the values of each place's columns, (n,)."""
        return values if self.columns is None else np.bincount(self._places, values, self._n)

    def columns_of(self, places: np.ndarray) -> np.ndarray:
        """Return the columns of places, passed along the map."""
        return places if self.columns is None else self.columns[places]

    def names_of(self, columns: np.ndarray) -> np.ndarray:
        """Return the places of columns as matches number them; in a gap, the place before it."""
        return columns if self.columns is None else self._places[columns]

    def direction_of(self, column: int) -> int:
        """Return 1 of a column passed along the map, -1 of one against it."""
        return 1 if self.columns is None else int(self._direction[column])

    def seam_columns(self, path: np.ndarray) -> slice:
        """
        Return the columns that repeat those a lap before them, where all of a path is there.

        :param path: columns, ascending, (l,).
        :returns: an empty slice where it is not.
        """
        if self.columns is None or not self.lap:
            return slice(0, 0)
        run = np.searchsorted(self._firsts, path[0], 'right') - 1  # of its direction
        first, n = int(self._firsts[run]), self._n
        return slice(first + n, first + self._along) if path[0] >= first + n else slice(0, 0)

    def session_of(self, place: int) -> tuple[int, int]:
        """Return the first place of a place's session, and the first one behind it."""
        if self.columns is None:
            return 0, sys.maxsize
        session = int(np.searchsorted(self.starts, place, 'right'))
        ends = [*self.starts.tolist(), self._n]
        return ends[session - 1], ends[session]

    def positions(self, places: np.ndarray | int) -> np.ndarray:
        """Return positions: those at most ``nms_radius`` apart are neighbors in one session."""
        return np.asarray(places) if self.columns is None else self.columns[self._same_as[places]]

    def around(self, column: int, radius: int, beside: bool = False) -> np.ndarray:
        """
        Return the columns of positions near a column's, as first ones and ends, (m, 2).

        :param beside: with the columns within the radius beside each column of the same position:
            another session has fewer places, or more.
        """
        if self.columns is None:
            return np.array([[column - radius, column + radius + 1]])
        apart = self._apart(self._positions, self._positions[column])
        is_near = apart <= radius
        for same in np.flatnonzero(apart <= CLOSE).tolist() if beside else ():
            is_near[max(same - radius, 0) : same + radius + 1] = True
        near = np.flatnonzero(is_near)
        ends = np.flatnonzero(np.diff(near) > 1)
        return np.stack([near[np.append(0, ends + 1)], near[np.append(ends, -1)] + 1], axis=1)

    def _apart(self, positions: np.ndarray, position: int) -> np.ndarray:
        """Return how far positions are from one, also over the seam of a closed route."""
        apart = np.abs(positions - position)
        return np.minimum(apart, np.abs(self.lap - apart)) if self.lap else apart

    def merge(self, columns: np.ndarray, probabilities: np.ndarray) -> tuple[np.ndarray, int]:
        """
        Let columns of positions within ``CLOSE`` of each other add up.

        :param columns: ascending, (m,); probabilities: of each alone, (m,).
        :returns: probabilities of the columns with the close ones, (m,), and the most probable
            column of the most probable position.
        """
        own = sums_near(columns, probabilities)
        if self.columns is None:
            return own, int(columns[np.argmax(own)])
        positions = self._positions[columns]
        shifts = (-self.lap, 0, self.lap) if self.lap else (0,)
        around = np.concatenate([positions + shift for shift in shifts])
        order = np.argsort(around, kind='stable')
        sums = np.empty(len(around))
        sums[order] = sums_near(around[order], np.tile(probabilities, len(shifts))[order])
        sums = sums[len(columns) * (len(shifts) // 2) :][: len(columns)]
        apart = self._apart(positions, positions[np.argmax(sums)])
        best = int(np.argmax(np.where(apart <= CLOSE, own, -1)))
        return np.minimum(sums, 1), int(columns[best])

    def in_places(self, match: WindowMatch, seeks_second: bool = False) -> WindowMatch:
        """
        Return a match whose columns have become places.

        :param seeks_second: for the second best; the one of the match is at another position else.
        """
        path = match.path
        if self.columns is None or path.place < 0:
            return match

        def sequences() -> WindowSequences:
            costs, columns, probabilities = match.sequences()
            possible = np.isfinite(costs)
            if probabilities is not None:
                probabilities = probabilities[possible]
            places = self.names_of(columns[possible])
            return WindowSequences(costs[possible], places, probabilities)

        place, second = self.names_of(np.array([path.place, path.second_best])).tolist()
        second, distance = second if path.second_best >= 0 else -1, path.second_best_distance
        if seeks_second:
            others = self.ranked(Candidate(place, path.distance), sequences(), 2)[1:]
            second = others[0].place if others else -1
            distance = others[0].distance if others else math.nan
        pairs = path.pairs.copy()
        pairs[:, 1] = self.names_of(pairs[:, 1])
        in_places = replace(
            path,
            pairs=pairs,
            place=place,
            second_best=second,
            second_best_distance=distance,
            direction=self.direction_of(path.place),
        )
        return WindowMatch(in_places, sequences)

    def ranked(
        self, nearest: Candidate | None, sequences: WindowSequences, count: int
    ) -> list[Candidate]:
        """
        Rank places by non-maximum suppression: no candidate is close to one ranked before it.

        The first is the nearest sequence, the second its second best. O(count x n).

        :param nearest: the nearest sequence; None if there is none.
        :param sequences: all sequences, in any order; the most probable first; else of equal costs
            the first one.
        :param count: most candidates, at least 0.
        :raises InputError: count below 0.
        """
        if count < 0:
            raise InputError(f'count = {count} candidates: expected at least 0')
        if nearest is None or not count:
            return []
        costs, places, probabilities = sequences
        # the costs of improbable places are equal: 1 up to the last digit
        keys = costs.copy() if probabilities is None else -probabilities
        keys[~np.isfinite(costs)], positions = np.inf, self.positions(places)
        ranked = [nearest]
        while len(ranked) < count and len(costs):
            apart = self._apart(positions, int(self.positions(ranked[-1].place)))
            keys[apart <= self.nms_radius] = np.inf
            best = int(np.argmin(keys))
            if math.isinf(keys[best]):
                break
            probability = math.nan if probabilities is None else float(probabilities[best])
            ranked.append(Candidate(int(places[best]), float(costs[best]), probability))
        return ranked


# ------------------------------------------------ kernels


@kernel
def sums_near(positions: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
    """Return the sums of probabilities within ``CLOSE`` of ascending positions, (m,)."""
    sums, low = np.zeros(len(positions)), 0
    for i in range(len(positions)):
        while positions[low] < positions[i] - CLOSE:
            low += 1
        j = low
        while j < len(positions) and positions[j] <= positions[i] + CLOSE:
            sums[i] += probabilities[j]
            j += 1
    return sums
