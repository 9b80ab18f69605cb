# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The correction moves no faster than its limit, about the robot."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import inverse, matrices
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.ros.correction import LEVER, LimitedCorrection

SECOND = 10**9
RATE = 20  # odometry a second


def planar(x: float, y: float, degrees: float) -> np.ndarray:
    return matrices(planar_poses(np.array([[x, y, np.radians(degrees)]])))[0]


def robot(i: int) -> np.ndarray:
    """Return the odometry: 1 m/s, 500 m from its origin."""
    return planar(500 + i / RATE, 20.0, 30.0)


def steps(target: np.ndarray, count: int, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much the corrected pose moves beside the odometry, m and rad, each time."""
    correction, shown = LimitedCorrection(speed), []
    correction.at(SECOND, robot(0))
    correction.aim(target, 0)
    before = np.eye(4)
    for i in range(1, count):
        result = correction.at(SECOND + i * SECOND // RATE, robot(i))
        shown.append(inverse(before @ robot(i)) @ result @ robot(i))
        before = result
    moves = np.array(shown)
    turns = Rotation.from_matrix(moves[:, :3, :3]).magnitude()
    return np.linalg.norm(moves[:, :3, 3], axis=1), turns


def test_correction_moves_the_robot_at_the_limited_speed():
    """20 degrees about the origin of the odometry, far away, are 174 m at the robot."""
    moved, turned = steps(planar(0, 0, 20), 20 * RATE, 0.5)
    np.testing.assert_allclose(moved, 0.5 / RATE, rtol=1e-3)
    assert turned.max() < 0.5 / LEVER / RATE


def test_correction_of_a_rotation_about_the_robot_turns_at_the_limited_speed():
    at = robot(40)
    moved, turned = steps(at @ planar(0, 0, 90) @ inverse(at), 40, 0.5)
    assert turned.max() == pytest.approx(0.5 / LEVER / RATE, rel=0.1)
    assert moved.max() <= 0.5 / RATE + 1e-9


def test_correction_arrives_exactly():
    target, correction = planar(1, 2, 0.1), LimitedCorrection(1.0)
    correction.at(SECOND, robot(0))
    correction.aim(target, 0)
    for i in range(1, 10 * RATE):
        result = correction.at(SECOND + i * SECOND // RATE, robot(0))
    np.testing.assert_array_equal(result, target)


def test_correction_without_a_limit_moves_at_once():
    moved, _ = steps(planar(0, 3, 0), 4, 0.0)
    np.testing.assert_allclose(moved, [3, 0, 0], atol=1e-9)


def test_correction_after_a_break_of_the_odometry_moves_at_once():
    correction = LimitedCorrection(0.5)
    correction.at(SECOND, robot(0))
    correction.aim(planar(0, 3, 0), 1)
    np.testing.assert_array_equal(correction.at(SECOND, robot(0)), planar(0, 3, 0))


def test_correction_ignores_stamps_that_jump():
    correction = LimitedCorrection(0.5)
    correction.at(SECOND, robot(0))
    correction.aim(planar(0, 3, 0), 0)
    for stamp, moved in ((0, 0.0), (3600 * SECOND, 0.5), (7200 * SECOND, 1.0)):
        assert correction.at(stamp, robot(0))[1, 3] == pytest.approx(moved)
