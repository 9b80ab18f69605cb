# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Relative motion: whether the trajectory of the query, by odometry, fits its path on the map.

Look-alike corridors are distinguished by their turns. Only positions are compared, in the plane of
x and y (z is up), relative to each other: the frames of odometry and map may differ, and so may
the bodies whose poses they are.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from stavpr_ros.method.match import Path
from stavpr_ros.method.model import ALONG, FARTHEST, LONGEST, UNUSUAL

TURNS = 2  # degrees of freedom of the trajectory's shape; its length has one
MIN_IMAGES = 3
MIN_DOUBT = 1e-9  # no probability is 1
NO_PLACE = -FARTHEST - 1  # no match goes on from it
Positions = Sequence[np.ndarray] | np.ndarray
Run = tuple[int, int, int, int]


class RelativeMotion:
    """
    Compares the trajectory of a query by odometry with the paths of its matches.

    A disagreement stays in the test for ``LONGEST`` windows: while matches continue each other,
    the trajectory since the first of them is compared beside the window's.

    :param length: images in a window, l.
    :param error: see :func:`agreement`.
    :param positions: x and y of the places that are not evicted, meters; NaN = unknown. Empty =
        nothing is compared.

    ``trajectory`` contains x and y of each image by odometry, (2,), meters; NaN = unknown.
    ``run`` describes the matches that continue each other: images since the window of the first
    one began; place of the last one, images after it, and its newest place, below 0 if images
    alone do not accept it.
    """

    def __init__(self, length: int, error: float, positions: Positions) -> None:
        self._error, self.positions = error, positions
        self.trajectory: deque[np.ndarray] = deque(maxlen=LONGEST * length)
        self.reset()

    def reset(self) -> None:
        """Drop the images of the query."""
        self.trajectory.clear()
        self.run = 0, NO_PLACE, 0, NO_PLACE

    def agreement(
        self,
        path: Path,
        accepted: bool,
        first: int,
        session: tuple[int, int],
    ) -> tuple[float, Run]:
        """
        Return the p-value of the trajectory, given the path of a match.

        Also ``run`` with this match, for the owner to keep: an image may have several.

        The last position of the trajectory, of the match's newest image, is known.

        :param accepted: by the images alone.
        :param first: first place that is not evicted.
        :param session: first place of the match's session, and the first one behind it.
        """
        place, newest = path.place, path.last
        length, agreed = len(path.pairs), 1.0
        since, *last = self.run
        after = length - 1 - (length - 1) // 2  # images after the middle one
        step = place - last[0] if after == last[1] else newest - last[2]
        follows = accepted and 0 <= path.direction * step <= FARTHEST
        run = since + 1 if follows else length, place, after, newest if accepted else NO_PLACE
        reach = FARTHEST * len(self.trajectory) + 1  # places to either side of the trajectory
        low = max(first, session[0], place - reach)
        high = min(first + len(self.positions), session[1], place + reach)
        track = np.array(self.positions[low - first : high - first])
        ends = place - low, newest - low
        if path.direction < 0:
            track, ends = track[::-1], (high - 1 - place, high - 1 - newest)
        trajectory = np.array(self.trajectory)
        if ends[1] < ends[0]:  # over the seam of a closed route, where the poses have the drift
            return agreed, run
        for count in {length, min(len(trajectory), run[0])}:
            part = trajectory[-count:]
            p_value = agreement(track, ends, part, count - 1 - after, self._error)
            agreed = agreed if np.isnan(p_value) else min(agreed, p_value)
        return agreed, run


def with_odometry_test(probability: float, agreed: float) -> float:
    """
    Return the probability of a match whose trajectory has this p-value, below ``UNUSUAL``.

    Agreement is no evidence: other places have a track of that shape as well.
    """
    odds = probability / max(1 - probability, MIN_DOUBT) * agreed / UNUSUAL
    return odds / (1 + odds)


def agreement(
    track: np.ndarray, places: tuple[int, int], trajectory: np.ndarray, middle: int, error: float
) -> float:
    """
    Return the p-value of the trajectory of a query, given its path.

    It is the share of queries on the right path whose trajectory would fit the map less. The
    trajectory by odometry is laid along the track, from the middle image of the window on. Two
    properties are compared: its shape, less one rotation and shift, and its length from the middle
    image to the newest with the path's. With the deviations sigma_i = hypot(``ALONG``
    spacings, ``error`` s_i) of an image s_i meters from the middle one, the sum

        chi^2 = 2 mean_i (abs(r_i) / sigma_i)^2 + (length - length of path)^2 / sigma^2

    of the distances r_i that remain has three degrees of freedom, since successive images deviate
    alike. The path has two places to be wrong about: its sigma has 2 ``ALONG``.

    :param track: positions of successive places, meters, (k, 2); NaN = unknown.
    :param places: rows of the track matched with the middle image and with the newest.
    :param trajectory: positions of successive images by odometry, meters, (m, 2); NaN = unknown.
    :param middle: row of the middle image in ``trajectory``.
    :param error: of a distance by odometry, as a share of it.
    :returns: 0 to 1; NaN where too little is known.
    """
    at, lengths = _lengths(track)
    images, driven = _lengths(trajectory)
    ends = [np.flatnonzero(at == place) for place in places]
    own = np.flatnonzero(images == middle)
    if not (own.size and images[-1] == len(trajectory) - 1 and all(end.size for end in ends)):
        return float('nan')
    if not lengths[-1] > 0:  # the map's camera was at rest
        return float('nan')
    start, end = (float(lengths[rows[0]]) for rows in ends)
    driven = driven - driven[own[0]]
    spacing = float(lengths[-1]) / (len(lengths) - 1)
    length_error = driven[-1] - (end - start)
    total = length_error**2 / _variance(2 * ALONG * spacing, error * driven[-1])
    inside = (start + driven >= 0) & (start + driven <= lengths[-1])
    if np.count_nonzero(inside) < MIN_IMAGES:
        return float('nan')
    images, driven = images[inside], driven[inside]
    mine = trajectory[images] @ (1, 1j)
    theirs = np.interp(start + driven, lengths, track[at] @ (1, 1j))
    mine, theirs = mine - mine.mean(), theirs - theirs.mean()
    turn = np.vdot(mine, theirs)
    rest = np.abs(theirs - mine * (turn / abs(turn) if turn else 1))
    total += TURNS * np.mean(rest**2 / _variance(ALONG * spacing, error * driven))
    from scipy.special import chdtrc

    return float(chdtrc(TURNS + 1, total))


def _variance(along: float, drift: np.ndarray | float) -> np.ndarray:
    return np.maximum(along**2 + np.square(drift), 1e-12)


def _lengths(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of (m, 2) that are known, and the distance driven until each, meters."""
    rows = np.flatnonzero(np.isfinite(positions[:, 0]))
    steps = np.linalg.norm(np.diff(positions[rows], axis=0), axis=1)
    return rows, np.concatenate([[0.0], np.cumsum(steps)])[: len(rows)]
