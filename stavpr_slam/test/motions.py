# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Twists, rotation first, and rigid motions, by the exponential and logarithm of matrices."""

import numpy as np
from scipy.linalg import expm, logm
from stavpr_ros.mapping.transforms import cross


def exponentials(twists: np.ndarray) -> np.ndarray:
    """Return the motions (n, 4, 4) of twists (n, 6)."""
    lines = np.zeros((len(twists), 4, 4))
    lines[:, :3, :3], lines[:, :3, 3] = cross(twists[:, :3]), twists[:, 3:]
    result: np.ndarray = expm(lines)
    return result


def logarithms(motions: np.ndarray) -> np.ndarray:
    """Return the twists (n, 6) of motions (n, 4, 4)."""
    lines = np.array([logm(motion).real for motion in motions])
    return lines[:, [2, 0, 1, 0, 1, 2], [1, 2, 0, 3, 3, 3]]
