# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms as homogeneous matrices, many at once."""

import numpy as np


def matrices(poses: np.ndarray) -> np.ndarray:
    """Return x y z and quaternion x y z w, shape (..., 7), as transforms (..., 4, 4)."""
    from scipy.spatial.transform import Rotation

    poses = np.asarray(poses, np.float64)
    result = np.zeros((*poses.shape[:-1], 4, 4))
    turns = Rotation.from_quat(poses[..., 3:].reshape(-1, 4)).as_matrix()
    result[..., :3, :3] = turns.reshape(*poses.shape[:-1], 3, 3)
    result[..., :3, 3] = poses[..., :3]
    result[..., 3, 3] = 1
    return result


def to_poses(transforms: np.ndarray) -> np.ndarray:
    """Return matrices (..., 4, 4) as poses (..., 7)."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(transforms[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    shape = transforms.shape[:-2]
    return np.concatenate([transforms[..., :3, 3], turns.reshape(*shape, 4)], axis=-1)


def turn_pose(pose: np.ndarray, yaw: float) -> np.ndarray:
    """Return a pose (7,) turned about its own z axis, radians to the left."""
    if not yaw:
        return pose
    (x, y, z, w), c, s = pose[3:], np.cos(yaw / 2), np.sin(yaw / 2)
    turn = x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s
    return np.array([*pose[:3], *turn])


def inverse(transforms: np.ndarray) -> np.ndarray:
    """Return the inverses of rigid transforms (..., 4, 4)."""
    result = np.zeros_like(transforms)
    R = np.swapaxes(transforms[..., :3, :3], -1, -2)
    result[..., :3, :3] = R
    result[..., :3, 3] = -(R @ transforms[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1
    return result


def cross(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (n, 3, 3) of the cross products with vectors (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
