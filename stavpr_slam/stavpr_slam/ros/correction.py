# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transform from the odometry's frame to the map, as fast as a controller bears it."""

import numpy as np
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import inverse
from stavpr_ros.units import SECOND

LEVER = 2.0  # meters from the robot: points within move at most as fast as the robot
MAX_SECONDS = 1.0  # between two stamps; longer pauses of the odometry count as this


class LimitedCorrection:
    """
    Moves the corrected pose of the robot toward its pose in the graph, on SE(3) about the robot.

    :param speed: m/s; the rotation has ``speed / LEVER`` rad/s; 0 = at once.
    """

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._target, self._target_breaks = np.eye(4), 0
        self._current, self._breaks, self._stamp = np.eye(4), 0, 0

    def aim(self, target: np.ndarray, breaks: int) -> None:
        """
        Set where the correction moves to.

        :param target: from the odometry's frame to the map, shape (4, 4).
        :param breaks: of the odometry so far: after a new one the correction moves at once, since
            the pose of the robot jumps anyway.
        """
        self._target, self._target_breaks = target, breaks

    def at(self, stamp: int, odometry: np.ndarray) -> np.ndarray:
        """
        Return the correction, shape (4, 4), at the newest stamp (ns).

        :param odometry: pose of the robot in the odometry's frame, shape (4, 4).
        """
        target, breaks = self._target, self._target_breaks
        seconds = min(max(stamp - self._stamp, 0) / SECOND, MAX_SECONDS)
        self._stamp = stamp
        if self._speed and breaks == self._breaks:
            present, goal = self._current @ odometry, target @ odometry
            shift = goal[:3, 3] - present[:3, 3]
            turn = Rotation.from_matrix(present[:3, :3].T @ goal[:3, :3]).as_rotvec()
            far = max(float(np.linalg.norm(shift)), LEVER * float(np.linalg.norm(turn)))
            share = self._speed * seconds / far if far else 1.0
            if share < 1:
                present[:3, 3] += share * shift
                present[:3, :3] = present[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
                target = present @ inverse(odometry)
        self._current, self._breaks = target, breaks
        return target
