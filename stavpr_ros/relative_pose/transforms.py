# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses, x y z and quaternion x y z w, as matrices."""

import numpy as np
from scipy.spatial.transform import Rotation


def matrix_of(pose: np.ndarray) -> np.ndarray:
    """Return a pose, shape (7,), as a homogeneous matrix (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
    return matrix


def pose_of(matrix: np.ndarray) -> np.ndarray:
    """Return a homogeneous matrix (4, 4) as a pose, shape (7,)."""
    return np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_quat()])


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a homogeneous matrix (4, 4) of a rigid motion."""
    result = np.eye(4)
    result[:3, :3] = matrix[:3, :3].T
    result[:3, 3] = -result[:3, :3] @ matrix[:3, 3]
    return result


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (m, 3, 3) of the cross products with vectors (m, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
