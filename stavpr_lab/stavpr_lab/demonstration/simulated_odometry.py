# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry with errors, for tests, benchmarks and the demonstration; poses are x, y, yaw."""

import numpy as np

# At drift 1: deviation of the scale of a step, per step; of the heading, per square root
# of a meter; bias of the heading, per meter; bias of the scale.
SCALE_NOISE, HEADING_NOISE, HEADING_BIAS, SCALE_BIAS = (
    0.02,
    np.radians(0.5),
    np.radians(0.02),
    0.01,
)


def add_drift(
    truth: np.ndarray, is_noticed: np.ndarray, dice: np.random.Generator, drift: float
) -> np.ndarray:
    """
    Return what an odometry with errors makes of true poses.

    :param truth: shape (N, 3).
    :param moved: whether the odometry noticed the motion before each image, shape (N,).
    :returns: shape (N, 3); the first is 0, 0, 0.
    """
    signs = dice.choice([-1, 1], 2)
    result = np.zeros_like(truth)
    for i in range(1, len(truth)):
        step = relative_poses(truth[i - 1], truth[i : i + 1])[0] * is_noticed[i]
        length = float(np.hypot(*step[:2]))
        scale = 1 + drift * (signs[0] * SCALE_BIAS + SCALE_NOISE * dice.normal())
        turn = HEADING_NOISE * np.sqrt(length) * dice.normal() + signs[1] * HEADING_BIAS * length
        yaw = result[i - 1, 2]
        c, s = np.cos(yaw), np.sin(yaw)
        result[i, :2] = result[i - 1, :2] + scale * (np.array([[c, -s], [s, c]]) @ step[:2])
        result[i, 2] = yaw + step[2] + drift * turn
    return result


def relative_poses(origin: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return planar poses (N, 3) in the frame of one, shape (3,)."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    return np.column_stack(
        [(poses[:, :2] - origin[:2]) @ np.array([[c, -s], [s, c]]), poses[:, 2] - origin[2]]
    )
