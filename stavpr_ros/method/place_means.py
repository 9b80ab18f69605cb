# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Running mean of z per place (hubness correction).

Images of one light are nearer to each other than to all others, and certain places of that light
are near to a whole stretch of images. A camera that moves passes a place in a few images: what is
near to many in a row looks alike. Over the latest images, the newest that counts q = 0, the mean

    m[y] = sum_q w_q max(-1.5, z_q[y]) / (sum_q w_q + P),    w_q = (1 - 1/T)^q, T = 40, P = 10,

is subtracted from z[y], so that wrong places have mean 0 not only over the places of an image, but
also over the images of a place. The six images before do not count yet, nor any at a standstill:
the right place is near to them as well. A place that was not compared with an image counts as the
last one that was.
"""

from collections import deque

import numpy as np
from stavpr_ros.method.model import DELAY, MEAN_IMAGES, MEAN_PRIOR, NEAREST


class PlaceMeans:
    """The mean z of each place over the latest images, 0 at first."""

    def __init__(self) -> None:
        self._sums = np.zeros(0, np.float32)  # by place
        self._count = 0.0  # sum of the weights
        self._latest: deque[np.ndarray] = deque()  # rows that do not count yet, oldest first

    def correct(self, z: np.ndarray, is_standstill: bool) -> np.ndarray:
        """
        Return the z of an image less the means of its places, and count an earlier image.

        :param z: z-normalized distances to the first m places, (m,), float32; +inf excludes one.
        :param is_standstill: the image equals the one before: it does not count.
        """
        if len(z) > len(self._sums):
            self._sums = _pad_with_last(self._sums, len(z))
        corrected: np.ndarray = z - self._sums[: len(z)] / np.float32(self._count + MEAN_PRIOR)
        if len(z) and not is_standstill:
            compared = np.isfinite(z)
            self._latest.append(np.where(compared, np.maximum(z, NEAREST), np.float32(0)))
        if len(self._latest) > DELAY:
            decay = np.float32(1 - 1 / MEAN_IMAGES)
            self._count = self._count * float(decay) + 1
            self._sums *= decay
            self._sums += _pad_with_last(self._latest.popleft(), len(self._sums))
        return corrected

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self._sums = self._sums[count:]
        self._latest = deque(row[count:] for row in self._latest if len(row) > count)


def _pad_with_last(values: np.ndarray, places: int) -> np.ndarray:
    """Return values (n,) for so many places; those beyond n are as the last one, 0 without any."""
    last = values[-1:] if len(values) else np.zeros(1, np.float32)
    return np.append(values, np.repeat(last, places - len(values)))
