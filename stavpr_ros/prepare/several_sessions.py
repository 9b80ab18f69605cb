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
from stavpr_ros.prepare.cpu_matcher import CpuMatcher

CERTAIN = 0.99  # probability of the map, above which places are left out
PROBABLE = 1e-3  # probability of a place, above which the places around it are compared
CHUNK = 32  # places compared together; a multiple of all LANES
REACH = 2  # chunks around a probable place
NEAREST = 3  # sessions of which a part is compared, besides another one in turn


class SeveralSessions:
    """
    A matcher that leaves places out.

    :param matcher: of all places, strategy ``adaptive`` or ``vanilla``.
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
        self._matcher, self._runs, self._probabilities = matcher, runs, probabilities
        numbers = np.arange(len(same_as))
        related = np.where(same_as < numbers, numbers, -1)
        for run in runs:  # a place without a relation is where the one before it is
            related[run] = np.maximum.accumulate(related[run])
        self._chunks = np.where(related < 0, numbers, same_as[related]) // CHUNK  # of positions
        self._farther = np.zeros(len(runs))  # how much farther the nearest place of each is
        self._turn = 0

    @property
    def places(self) -> int:
        """Return the number of places n."""
        return self._matcher.places

    def distances(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of one image to every place, (n,); +inf where it is left out."""
        by_place, runs = self._probabilities(), self._runs
        if not by_place.sum() > CERTAIN:
            return self._matcher.distances(strips, weights)
        best = int(np.argmax(np.add.reduceat(by_place, [run.start for run in runs])))
        others = [*np.argsort(self._farther)[:NEAREST].tolist(), self._turn % len(runs)]
        self._turn += 1
        probable = self._chunks[by_place > PROBABLE]
        is_near, is_compared = np.zeros((2, -(-self.places // CHUNK)), bool)
        for apart in range(-REACH, REACH + 1):
            is_near[np.clip(probable + apart, 0, len(is_near) - 1)] = True
        near = {
            session: runs[session].start + np.flatnonzero(is_near[self._chunks[runs[session]]])
            for session in {best, *others}
        }
        is_compared[runs[best].start // CHUNK : -(-runs[best].stop // CHUNK)] = True
        for places in near.values():
            is_compared[places // CHUNK] = True
        compared = np.flatnonzero(is_compared)
        out = np.full((len(is_compared), CHUNK), np.inf, np.float32)
        out[compared] = self._matcher.distances_at(strips, compared * CHUNK, CHUNK)
        row: np.ndarray = out.ravel()[: self.places]
        nearest = {session: row[places].min(initial=np.inf) for session, places in near.items()}
        for session, distance in nearest.items():
            self._farther[session] = distance - nearest[best]
        return row

    def distance_matrix(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of Q images to every place, (Q, n)."""
        return self._matcher.distance_matrix(strips, weights)
