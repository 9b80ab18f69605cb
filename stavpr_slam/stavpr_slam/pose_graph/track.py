# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The odometry between keyframes, without the poses that interpolation gives."""

from array import array
from bisect import bisect_right
import math

import numpy as np
from stavpr_ros.mapping.trajectory import interpolate

SHARE = 0.25  # of the distance and the angle between keyframes, after which a pose is kept
OFF = 0.025  # of them: a pose is kept that interpolation would miss by more
MOST = 32  # poses kept after a keyframe: an odometry that jitters needs no more


class OdometryTrack:
    """
    Odometry without a break, of one robot: the poses that are not interpolated, and keyframes.

    ``newest`` is the stamp (ns) and the pose of the newest odometry, ``spread`` the covariance in
    the message of the last keyframe, (6, 6), ``nodes`` the keyframes, and ``begins`` the stamps
    from which odometry moves with each.

    :param distance, angle: meters and radians between keyframes.
    """

    def __init__(self, distance: float, angle: float, robot: str = '') -> None:
        self._distance, self._angle, self.robot = distance, angle, robot
        self._stamps, self._poses = array('q'), array('d')
        self._since = 0  # poses kept since the last keyframe
        self.newest = 0, np.zeros(7)
        self.spread: np.ndarray | None = None
        self.nodes: list[int] = []
        self.begins: list[int] = []

    def add(self, stamp: int, pose: np.ndarray, is_keyframe: bool) -> None:
        """
        Add the odometry.

        :param stamp: ns, above those before.
        :param pose: shape (7,).
        """
        newest, self.newest = self.newest, (stamp, pose)
        if not self._stamps:
            self._keep(stamp, pose)
            return
        last, start = self._stamps[-1], self._pose(-1)
        if newest[0] > last and self._since < MOST:
            expected = interpolate(start, pose, (newest[0] - last) / (stamp - last))
            if self._differ(expected, newest[1], OFF):
                self._keep(*newest)
                start = newest[1]
        if is_keyframe or (self._since < MOST and self._differ(start, pose, SHARE)):
            self._keep(stamp, pose)
            self._since *= not is_keyframe

    def _differ(self, a: np.ndarray, b: np.ndarray, share: float) -> bool:
        """Return whether two poses are a share of the distance between keyframes apart."""
        distance = math.dist(a[:3].tolist(), b[:3].tolist())
        return distance > share * self._distance or (
            abs(float(a[3:] @ b[3:])) < math.cos(share * self._angle / 2)
        )

    def _keep(self, stamp: int, pose: np.ndarray) -> None:
        self._stamps.append(stamp)
        self._poses.extend(pose.tolist())
        self._since += 1

    def _pose(self, i: int) -> np.ndarray:
        return np.array(self._poses[7 * i : 7 * i + 7 or None])

    @property
    def kept(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the stamps, (n,), int64, ns, and poses, (n, 7), that are kept."""
        return np.array(self._stamps), np.array(self._poses).reshape(-1, 7)

    def has(self, stamp: int) -> bool:
        """Return whether a stamp is between the first and the newest one."""
        return self._stamps[0] <= stamp <= self.newest[0]

    def at(self, stamp: int) -> np.ndarray:
        """Return the pose at a stamp that it has, shape (7,)."""
        i = bisect_right(self._stamps, stamp) - 1
        start, after = self._stamps[i], self.newest
        if start == stamp:
            return self._pose(i)
        if i + 1 < len(self._stamps):
            after = self._stamps[i + 1], self._pose(i + 1)
        return interpolate(self._pose(i), after[1], (stamp - start) / (after[0] - start))
