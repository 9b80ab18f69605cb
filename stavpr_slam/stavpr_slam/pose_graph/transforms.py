# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances and adjoints of rigid transforms."""

import numpy as np
from stavpr_ros.mapping.transforms import cross

ORDER = [3, 4, 5, 0, 1, 2]
TRANSLATION_FIRST = np.ix_(ORDER, ORDER)  # of a matrix that has the rotation first, or the reverse


def planar_poses(poses: np.ndarray) -> np.ndarray:
    """Return planar poses (N, 3), x y and yaw in radians, as poses (N, 7)."""
    result = np.zeros((len(poses), 7))
    result[:, :2] = poses[:, :2]
    result[:, 5], result[:, 6] = np.sin(poses[:, 2] / 2), np.cos(poses[:, 2] / 2)
    return result


def body_covariance(covariance: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """
    Return the covariance of a pose in the axes of its own frame, rotation first.

    :param covariance: as in ``geometry_msgs/PoseWithCovariance``: x y z and rotations about the
        fixed axes of the parent frame, shape (6, 6).
    :param transform: the pose, shape (4, 4).
    :returns: covariance of ``[rotation, translation]`` in ``Z Exp([rotation, translation])``, with
        the pose Z, shape (6, 6).
    """
    turn = transform[:3, :3].T
    change = np.zeros((6, 6))
    change[:3, 3:] = change[3:, :3] = turn
    return change @ covariance @ change.T


def adjoints(motions: np.ndarray) -> np.ndarray:
    """Return the adjoints of motions (n, 4, 4), rotation first, shape (n, 6, 6)."""
    R = motions[:, :3, :3]
    result = np.zeros((len(motions), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = R
    result[:, 3:, :3] = cross(motions[:, :3, 3]) @ R
    return result
