# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances, logarithms and adjoints of rigid transforms, many at once."""

import numpy as np
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import cross


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
    :returns: that of ``Z Exp([rotation, translation])``, shape (6, 6).
    """
    turn = transform[:3, :3].T
    change = np.zeros((6, 6))
    change[:3, 3:] = change[3:, :3] = turn
    result: np.ndarray = change @ covariance @ change.T
    return result


def logarithms(motions: np.ndarray) -> np.ndarray:
    """
    Return the logarithms of motions (n, 4, 4), rotation first, shape (n, 6).

    A turn about any one point is exact (Sola et al., *A micro Lie theory for state estimation in
    robotics*, 2018, equations 174 and 179).
    """
    turn = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    half = np.maximum(np.linalg.norm(turn, axis=1), 1e-4) / 2
    hat, shift = cross(turn), motions[:, :3, 3, None]
    once = hat @ shift
    rest = (1 - half / np.tan(half)) / (4 * half**2)
    moved = shift - once / 2 + rest[:, None, None] * (hat @ once)
    return np.concatenate([turn, moved[:, :, 0]], axis=1)


def adjoints(motions: np.ndarray) -> np.ndarray:
    """Return the adjoints of motions (n, 4, 4), rotation first, shape (n, 6, 6)."""
    R = motions[:, :3, :3]
    result = np.zeros((len(motions), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = R
    result[:, 3:, :3] = cross(motions[:, :3, 3]) @ R
    return result


def exponentials(twists: np.ndarray) -> np.ndarray:
    """Return the motions (n, 4, 4) of twists (n, 6), the inverse of :func:`logarithms`."""
    angle = np.maximum(np.linalg.norm(twists[:, :3], axis=1), 1e-4)[:, None, None]
    hat, result = cross(twists[:, :3]), np.tile(np.eye(4), (len(twists), 1, 1))
    result[:, :3, :3] = Rotation.from_rotvec(twists[:, :3]).as_matrix()
    once = (1 - np.cos(angle)) / angle**2 * hat
    twice = (angle - np.sin(angle)) / angle**3 * (hat @ hat)
    result[:, :3, 3] = ((np.eye(3) + once + twice) @ twists[:, 3:, None])[:, :, 0]
    return result
