# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
When images were taken, by their stamps.

A camera that loses images still advances evenly in time: the stamps of a window show where images
are missing, and those of a map where places are.
"""

import numpy as np
from stavpr_ros.compilation import kernel

LONGEST = 4.0  # intervals: the camera stopped, or its speed is unknown


@kernel
def image_times(stamps: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """
    Return the times of images, (m,), float64, ascending, in intervals of most of them.

    An interval is 1 where a stamp is unknown or not above the one before.

    :param stamps: ns, (m,), int64; 0 = unknown.
    :param numbers: (m,), int64; equal ones are of a camera at rest, for which no time passes.
    """
    steps = np.diff(stamps).astype(np.float64)
    is_known = (steps > 0) & (stamps[:-1] > 0)
    usual = np.median(steps[is_known]) if is_known.any() else 1.0
    times = np.zeros(len(stamps))
    for i in range(len(steps)):
        step = min(steps[i] / usual, LONGEST) if is_known[i] else 1.0
        times[i + 1] = times[i] + (step if numbers[i + 1] > numbers[i] else 0.0)
    return times
