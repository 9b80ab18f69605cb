# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""z-normalization of the distances of an image to all places."""

import numpy as np
from stavpr_ros.checks import require_shape
from stavpr_ros.compilation import reassociating_kernel

ONE_SESSION: np.ndarray = np.zeros(1, np.int64)
MIN_DEVIATION = 1e-3  # standard deviation of a row below which it carries no information


def z_normalized(
    row: np.ndarray,
    around: int = 0,
    counted: np.ndarray | None = None,
    firsts: np.ndarray = ONE_SESSION,
) -> np.ndarray:
    """
    Return a row with mean 0 and deviation 1 of its finite entries, shape (n,), float32.

    :param around: subtract the mean of so many places to either side as well, in which no place
        counts for less than -1, so that the right one counts little. Images of one light are
        nearer to each other than to all others, wherever they were taken. 0 = no.
    :param counted: places whose entries count for mean and deviation, (n,), bool; None = all.
    :param firsts: first places of parts that are normalized each by itself, (m,), int64.
    """
    z = np.empty(len(row), np.float32)
    counted = np.ones(len(row), bool) if counted is None else counted
    require_shape('counted', counted, f'{len(row)}', 'bool')
    _z_normalize(row, counted, firsts, z)
    if not around:
        return z
    from scipy.ndimage import uniform_filter1d

    clipped = np.where(np.isfinite(z), np.maximum(z, -1), np.float32(0))
    for part in np.split(clipped, firsts[1:]):
        part[:] = uniform_filter1d(part, 2 * around + 1, mode='nearest')
    return z - clipped


@reassociating_kernel
def _z_normalize(row: np.ndarray, counted: np.ndarray, firsts: np.ndarray, z: np.ndarray) -> None:
    """Write parts with mean 0 and deviation 1 of finite entries, in float64 until then."""
    for part in range(len(firsts)):
        end = firsts[part + 1] if part + 1 < len(firsts) else len(row)
        # slices: loops over them are vectorized
        x, own = row[firsts[part] : end], counted[firsts[part] : end]
        total, squares, count = 0.0, 0.0, 0
        for i in range(len(x)):
            counts = own[i] & np.isfinite(x[i])
            total += x[i] if counts else 0.0
            count += counts
        mean = total / max(count, 1)
        for i in range(len(x)):
            off = x[i] - mean
            squares += off * off if own[i] & np.isfinite(x[i]) else 0.0
        scale = np.float32(1 / max(np.sqrt(squares / max(count, 1)), MIN_DEVIATION))
        out = z[firsts[part] : end]
        for i in range(len(x)):
            out[i] = (x[i] - np.float32(mean)) * scale
