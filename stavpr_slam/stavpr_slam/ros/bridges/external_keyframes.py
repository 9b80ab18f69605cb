# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframes of another back end: its loop closures are between those, not between images."""

from bisect import bisect_left

import numpy as np
from stavpr_ros.mapping.transforms import cross, inverse, matrices
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.closures import Closure
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise

MAX_KEYFRAMES = 1_000_000


class ExternalKeyframes:
    """
    Keyframes by their stamps, and the odometry between them.

    :param max_gap: seconds between an image and its keyframe at most.
    """

    def __init__(self, max_gap: float) -> None:
        self._max_gap = round(max_gap * SECOND)
        self._stamps: list[int] = []
        self._numbers: list[int] = []
        self.odometry = KeyframeChain(ChainSettings(), OdometryNoise())

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest(self) -> int:
        """Return the stamp of the newest keyframe, ns; 0 = none."""
        return self._stamps[-1] if self._stamps else 0

    def add(self, stamp: int, number: int) -> None:
        """Add a keyframe; one of the same stamp is replaced."""
        i = bisect_left(self._stamps, stamp)
        if i < len(self._stamps) and self._stamps[i] == stamp:
            self._numbers[i] = number
            return
        self._stamps.insert(i, stamp)
        self._numbers.insert(i, number)
        if len(self._stamps) > MAX_KEYFRAMES:
            del self._stamps[0], self._numbers[0]

    def near(self, stamp: int) -> tuple[int, np.ndarray] | None:
        """
        Return the nearest keyframe, and the transform (4, 4) from it to a stamp (ns).

        :returns: None without a keyframe that is near and whose motion to the stamp is known.
        """
        i = bisect_left(self._stamps, stamp)
        around = range(max(i - 1, 0), min(i + 1, len(self._stamps)))
        if not around:
            return None
        best = min(around, key=lambda index: abs(self._stamps[index] - stamp))
        if self._stamps[best] == stamp:
            return self._numbers[best], np.eye(4)
        motion = self.odometry.motion(self._stamps[best], stamp)
        if abs(self._stamps[best] - stamp) > self._max_gap or motion is None:
            return None
        return self._numbers[best], motion


def keyframe_edge(
    closure: Closure, place: np.ndarray, query: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Move a loop closure to the keyframes next to its images.

    :param place, query: transforms (4, 4) from the keyframe to the image, whose errors are left
        out.
    :returns: the pose of the query's keyframe in the frame of the place's, (4, 4), and its
        covariance: x y z, rotations about the fixed axes of the place's, (6, 6).
    """
    after, motion = inverse(query), matrices(closure.pose)
    # t' = A (t + R b): an error of the rotation R also moves the end of the motion b
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -cross((motion[:3, :3] @ after[:3, 3])[None])[0]
    jacobian = np.kron(np.eye(2), place[:3, :3]) @ jacobian
    return place @ motion @ after, jacobian @ closure.covariance @ jacobian.T


def body_information(transform: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """
    Return the inverse of a covariance in the axes of the query, x y z first, shape (6, 6).

    g2o and its file format have the information of an edge in this form.

    :param transform, covariance: see :func:`keyframe_edge`.
    """
    turn = np.kron(np.eye(2), transform[:3, :3].T)
    result: np.ndarray = np.linalg.inv(turn @ covariance @ turn.T)
    return (result + result.T) / 2
