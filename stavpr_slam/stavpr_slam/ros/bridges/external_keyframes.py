# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The keyframes of another back end: its loop closures are between those, not between images."""

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from stavpr_ros.mapping.trajectory import Trajectory
from stavpr_ros.mapping.transforms import inverse, matrices
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.closures import Closure

MAX_KEYFRAMES = 1_000_000


@dataclass(frozen=True, eq=False)
class KeyframeEdge:
    """
    A loop closure between two keyframes of another back end.

    :param place, query: their numbers there.
    :param transform: pose of the query's keyframe in the frame of the place's, shape (4, 4).
    :param covariance: x y z, rotations about the fixed axes of the place's, shape (6, 6).
    """

    place: int
    query: int
    transform: np.ndarray
    covariance: np.ndarray


class ExternalKeyframes:
    """
    Keyframes by their stamps, with the odometry there.

    :param max_gap: seconds between an image and its keyframe at most.
    """

    def __init__(self, max_gap: float) -> None:
        self._max_gap = round(max_gap * SECOND)
        self._stamps: list[int] = []
        self._numbers: list[int] = []
        self._poses: dict[int, np.ndarray] = {}  # by stamp
        self._waiting: list[int] = []  # stamps of keyframes that wait for the odometry after them
        self._odometry = Trajectory(timeout=0.05)

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
        self._waiting.append(stamp)
        if len(self._stamps) > MAX_KEYFRAMES:
            self._poses.pop(self._stamps.pop(0), None)
            del self._numbers[0]
        self._find_poses()

    def add_odometry(self, stamp: int, pose: np.ndarray) -> None:
        """
        Add the odometry; only its last poses are kept.

        :param stamp: ns.
        :param pose: shape (7,).
        :raises InputError: an invalid pose or stamp.
        """
        self._odometry.add(stamp, pose)
        if self._waiting:
            self._find_poses()

    def _find_poses(self) -> None:
        for stamp in self._waiting[:]:
            pose = self._odometry.at(stamp)
            if pose is not None:
                self._poses[stamp] = pose
                self._waiting.remove(stamp)
        del self._waiting[:-100]

    def near(self, stamp: int, pose: np.ndarray | None) -> tuple[int, np.ndarray] | None:
        """
        Return the nearest keyframe, and the transform (4, 4) from it to a stamp.

        :param stamp: ns.
        :param pose: odometry at the stamp, shape (7,); None = unknown.
        :returns: None without a keyframe that is near and whose motion to the stamp is known.
        """
        i = bisect_left(self._stamps, stamp)
        around = range(max(i - 1, 0), min(i + 1, len(self._stamps)))
        if not around:
            return None
        best = min(around, key=lambda index: abs(self._stamps[index] - stamp))
        found = self._stamps[best]
        if found == stamp:
            return self._numbers[best], np.eye(4)
        if abs(found - stamp) > self._max_gap or pose is None or found not in self._poses:
            return None
        motion = inverse(matrices(self._poses[found])) @ matrices(pose)
        return self._numbers[best], motion


def keyframe_edge(
    closure: Closure, place: tuple[int, np.ndarray], query: tuple[int, np.ndarray]
) -> KeyframeEdge:
    """
    Move a loop closure to the keyframes next to its images.

    :param place, query: keyframe, and the transform (4, 4) from it to the image, whose errors are
        left out.
    """
    before, after = place[1], inverse(query[1])
    measured = matrices(closure.pose)
    # t' = A (t + R b): an error of the rotation R also moves the end of the motion b
    x, y, z = measured[:3, :3] @ after[:3, 3]
    jacobian = np.eye(6)
    jacobian[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    turn = np.kron(np.eye(2), before[:3, :3])
    jacobian = turn @ jacobian
    return KeyframeEdge(
        place[0], query[0], before @ measured @ after, jacobian @ closure.covariance @ jacobian.T
    )


def body_information(edge: KeyframeEdge) -> np.ndarray:
    """
    Return the inverse of the covariance in the axes of the query, x y z first, shape (6, 6).

    g2o and its file format have the information of an edge in this form.
    """
    turn = np.kron(np.eye(2), edge.transform[:3, :3].T)
    result: np.ndarray = np.linalg.inv(turn @ edge.covariance @ turn.T)
    return (result + result.T) / 2
