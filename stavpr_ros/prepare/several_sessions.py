# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A matcher for many sessions of one route, at the cost of about one.

While the camera is certainly on the map, an image is compared with all places of the most probable
session, and with places around the probable ones in a few others: in the sessions whose places
there are nearest to the images, as they are in their light, and in each other one in turn, to
compare it with these. Other places have infinite distances, and no states of the place filter.
Where the camera is not certainly on the map, all places are compared.
"""

from collections.abc import Callable

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.prepare.cpu_matcher import CpuMatcher

CERTAIN = 0.99  # probability of the map, above which places are left out
# Half and double change nothing on ten sessions of a synthetic street.
PROBABLE = 1e-3  # probability of a place, above which the places around it are compared
CHUNK = 32  # places compared together; a multiple of all LANES
REACH = 2  # chunks around a probable place
NEAREST = 3  # sessions of which a part is compared, besides another one in turn


class SeveralSessions:
    """
    A matcher that leaves places out.

    :param matcher: of all places, strategies that align strips.
    :param runs: places of each session.
    :param same_as: for each place, itself, or the place of an earlier session that shows the same.
    :param probabilities: returns the probability of each place now, (n,).
    """

    def __init__(
        self,
        matcher: CpuMatcher,
        runs: list[slice],
        same_as: np.ndarray,
        probabilities: Callable[[], np.ndarray],
    ) -> None:
        self._matcher, self._probabilities = matcher, probabilities
        numbers = np.arange(len(same_as))
        related = np.where(same_as < numbers, numbers, -1)
        for run in runs:  # a place without a relation is where the one before it is
            related[run] = np.maximum.accumulate(related[run])
        self._chunks = np.where(related < 0, numbers, same_as[related]) // CHUNK  # of positions
        self._ends = np.array([runs[0].start, *(run.stop for run in runs)])
        self._farther = np.zeros(len(runs))  # how much farther the nearest place of each is
        self.reset()

    def reset(self) -> None:
        """Forget the query: no session is farther than another."""
        self._farther[:] = self._turn = 0

    @property
    def places(self) -> int:
        """Return the number of places n."""
        return self._matcher.places

    def strips_of(self, places: np.ndarray) -> np.ndarray:
        """Return the strips of places, (W, m, d)."""
        return self._matcher.strips_of(places)

    def distances(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of one image to every place, (n,); +inf where it is left out."""
        arguments = self._chunks, self._ends, self._farther
        best, is_part, is_near, compared = _choose(self._probabilities(), *arguments, self._turn)
        if not len(compared):
            return self._matcher.distances(strips, weights)
        self._turn = (self._turn + 1) % len(is_part)
        out = np.full((-(-self.places // CHUNK), CHUNK), np.inf, np.float32)
        out[compared] = self._matcher.distances_at(strips, compared * CHUNK, CHUNK)
        row: np.ndarray = out.ravel()[: self.places]
        _note_farther(row, *arguments, best, is_part, is_near)
        return row

    def distance_matrix(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of Q images to every place, (Q, n)."""
        return self._matcher.distance_matrix(strips, weights)


# ------------------------------------------------ kernels


@kernel
def _choose(
    by_place: np.ndarray, chunks: np.ndarray, ends: np.ndarray, farther: np.ndarray, turn: int
) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """
    Choose what an image is compared with.

    :param by_place: probability of each place, (n,), and chunks: of their positions.
    :param ends: first place of each session, and the end of the last, (S + 1,).
    :param farther: of :class:`SeveralSessions`, (S,); turn: session that has its turn.
    :returns: the most probable session, sessions of which places are compared, (S,), bool, chunks
        of positions near the probable ones, bool, and the chunks of places that are compared,
        ascending; none = all.
    """
    sums, is_part = np.zeros(len(farther)), np.zeros(len(farther), np.bool_)
    count = (len(chunks) + CHUNK - 1) // CHUNK
    is_near, is_compared = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for session in range(len(sums)):
        for place in range(ends[session], ends[session + 1]):
            sums[session] += by_place[place]
            if by_place[place] > PROBABLE:
                is_near[max(chunks[place] - REACH, 0) : chunks[place] + REACH + 1] = True
    best = int(np.argmax(sums))
    if sums.sum() > CERTAIN:
        is_part[best] = is_part[turn] = True
        is_part[np.argsort(farther, kind='mergesort')[:NEAREST]] = True
    for part in np.flatnonzero(is_part):
        for place in range(ends[part], ends[part + 1]):
            if part == best or is_near[chunks[place]]:
                is_compared[place // CHUNK] = True
    return best, is_part, is_near, np.flatnonzero(is_compared)


@kernel
def _note_farther(
    row: np.ndarray, chunks: np.ndarray, ends: np.ndarray, farther: np.ndarray, best: int,
    is_part: np.ndarray, is_near: np.ndarray,
) -> None:  # fmt: skip
    """Write how much farther the nearest place of each compared session is: :func:`_choose`."""
    nearest = np.full(len(farther), np.inf, np.float32)
    for session in np.flatnonzero(is_part):
        for place in range(ends[session], ends[session + 1]):
            if is_near[chunks[place]]:
                nearest[session] = min(nearest[session], row[place])
    for session in np.flatnonzero(is_part):
        farther[session] = nearest[session] - nearest[best]
