# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of the odometry along its path, as covariances of rigid motions.

A small error of a step is a twist; in the axes of the start of the odometry, the twists of all
steps add up (Barfoot, *State Estimation for Robotics*, 7.3). So the covariance of a path between
two keyframes is the difference of two sums, whatever its shape.
"""

from dataclasses import dataclass

import numpy as np
from stavpr_slam.pose_graph.transforms import adjoints, body_covariance

SHORTEST = 0.05  # meters that a step counts at least
NEGLIGIBLE = 1e-6  # part of a covariance below which it is numerical noise
LEAST = 1e-4  # part of the settings' covariance that given ones are increased by: planar ones

LARGEST_COVARIANCE = 1e12  # element of a message's: drivers write such numbers for "unknown"


@dataclass(frozen=True)
class OdometryNoise:
    """
    Errors of an odometry, as deviations that grow with the distance.

    :param translation: meters per square root of a meter.
    :param rotation: radians per square root of a meter.
    """

    translation: float = 0.05
    rotation: float = 0.012


def step_errors(ends: np.ndarray, noise: OdometryNoise) -> np.ndarray:
    """
    Return the covariance of the twist of a step in the axes of the start, rotation first, (6, 6).

    :param ends: the two keyframes in these axes, shape (2, 4, 4).
    """
    length = float(np.linalg.norm(ends[1, :3, 3] - ends[0, :3, 3]))
    middle = np.eye(4)[None]
    middle[0, :3, 3] = ends[:, :3, 3].mean(axis=0)
    moved = adjoints(middle)[0] * np.repeat([noise.rotation, noise.translation], 3)
    return max(length, SHORTEST) * moved @ moved.T


def message_growth(
    before: np.ndarray | None, after: np.ndarray | None, ends: np.ndarray
) -> np.ndarray | None:
    """
    Return how far covariances of messages grow in a step, in the axes of the start, (6, 6).

    :param before, after: as in ``geometry_msgs/PoseWithCovariance``, shape (6, 6).
    :returns: None where they are unknown, or do not grow as a filter's do.
    """
    if before is None or after is None:
        return None
    if not (np.abs([before, after]) <= LARGEST_COVARIANCE).all():  # NaN as well
        return None
    turns = adjoints(ends)
    own = [body_covariance(*row) for row in zip((before, after), ends, strict=True)]
    growth: np.ndarray = np.diff(turns @ own @ turns.mT, axis=0)[0]
    values = np.linalg.eigvalsh((growth + growth.T) / 2)
    return growth if values[-1] > 0 and values[0] > -NEGLIGIBLE * values[-1] else None
