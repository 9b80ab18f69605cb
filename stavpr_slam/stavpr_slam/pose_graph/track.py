# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The odometry between keyframes, without the poses that interpolation gives."""

import math

import numpy as np
from stavpr_ros.mapping.trajectory import interpolate

SHARE = 0.25  # of the distance and the angle between keyframes, after which a pose is kept
OFF = 0.025  # of them: a pose is kept that interpolation would miss by more
MOST = 32  # poses kept after a keyframe: an odometry that jitters needs no more


class OdometryTrack:
    """
    Stamps and poses of a recording, keyframes among them; others in between are interpolated.

    :param distance, angle: meters and radians between keyframes.
    """

    def __init__(self, distance: float, angle: float) -> None:
        self._distance, self._angle = distance, angle
        self._stamps = np.zeros(64, np.int64)
        self._poses = np.zeros((64, 7))
        self._count = 0
        self._since = 0  # poses kept since the last keyframe
        self._newest: tuple[int, np.ndarray] | None = None

    def add(self, stamp: int, pose: np.ndarray, is_keyframe: bool) -> None:
        """
        Add the odometry.

        :param stamp: ns, above those before.
        :param pose: shape (7,).
        """
        newest, self._newest = self._newest, (stamp, pose)
        if not self._count:
            self._keep(stamp, pose)
            return
        last, start = int(self._stamps[self._count - 1]), self._poses[self._count - 1]
        if newest is not None and newest[0] > last and self._since < MOST:
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
        if self._count == len(self._stamps):
            self._stamps = np.concatenate([self._stamps, np.zeros_like(self._stamps)])
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
        self._stamps[self._count], self._poses[self._count] = stamp, pose
        self._count += 1
        self._since += 1

    @property
    def kept(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the stamps, (n,), int64, ns, and poses, (n, 7), that are kept."""
        return self._stamps[: self._count], self._poses[: self._count]

    @property
    def span(self) -> tuple[int, int]:
        """Return the first and the last stamp, ns; of nothing (1, 0)."""
        return (int(self._stamps[0]), self._newest[0]) if self._newest else (1, 0)

    def at(self, stamp: int) -> np.ndarray:
        """Return the pose at a stamp within the span, shape (7,)."""
        stamps, poses = self.kept
        i = int(np.searchsorted(stamps, stamp, 'right')) - 1
        if stamps[i] == stamp:
            return np.asarray(poses[i])
        if i + 1 < len(stamps):
            after, pose = int(stamps[i + 1]), poses[i + 1]
        else:
            assert self._newest is not None
            after, pose = self._newest
        return interpolate(poses[i], pose, (stamp - int(stamps[i])) / (after - int(stamps[i])))
