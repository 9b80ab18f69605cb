# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Checks of a path as a whole, after the place filter has found it.

The filter takes images one by one, as independent evidence. Two properties of the window
distinguish right paths from those through places that look alike, in all kinds of light:

- **evenness**: at right places z is about equal; at look-alike ones a few images are very near and
  others far. s and m are deviation and mean of z over the places of the path;
- **motion**: a path that creeps explains images of any drive. e is the logarithm of the change of
  the images over the change of the map at the speed of the path
  (:meth:`stavpr_ros.filter.motion.ImageChange.excess`).

The odds of a path are multiplied by::

    exp(-10 max(0, s - max(1.4, 0.45 |m|)) - 25 max(0, e - 0.04))

The place of a camera at rest is not confirmed by later images. Its path needs the odds::

    9 exp(-(1 - alpha) max(0, mu z - mu^2 / 2))

with the mean z of the images at rest: less than 9, as of the first images of a drive, where they
are near, with the weight that the filter does not give to an image of many.
"""

import math

import numpy as np
from stavpr_ros.compilation import kernel

EVEN, EVEN_SHARE = 1.4, 0.45  # deviation of z at right places, and as a share of its mean
UNEVEN_WEIGHT = 10.0  # logarithm of the odds, by the deviation beyond
MIN_PLACES = 3  # of a path whose deviation is meaningful
SURE_AT_REST = 0.9  # probability that a path needs where the camera is at rest and z is not near
EXCESS, EXCESS_WEIGHT = 0.04, 25.0  # of right paths at most, and its weight in the odds beyond


@kernel
def unevenness(path: np.ndarray, z: np.ndarray) -> float:
    """
    Return by how much z varies more along a path than it may at right places, 0 if it does not.

    Each place counts once, with its nearest image: a map of few places has none between them.

    :param path: place of each image, ascending, (l,), int64.
    :param z: z-normalized distance of each image to its place, (l,), float32; infinite ones do
        not count.
    """
    nearest, count, place = np.empty(len(path)), 0, path[0]
    for i in range(len(path)):
        if z[i] < np.inf:
            if not count or path[i] != place:
                place, nearest[count] = path[i], np.inf
                count += 1
            nearest[count - 1] = min(nearest[count - 1], z[i])
    if count < MIN_PLACES:
        return 0.0
    nearest = nearest[:count]
    mean = nearest.sum() / count
    deviation = np.sqrt(((nearest - mean) ** 2).sum() / count)
    return max(deviation - max(EVEN, -EVEN_SHARE * mean), 0.0)


def odds_factor(uneven: float, excess: float) -> float:
    """
    Return the factor of the odds of a path, above 0, at most 1.

    :param uneven: of :func:`unevenness`.
    :param excess: logarithm of the change of the images over the map's change along the path.
    """
    return math.exp(-UNEVEN_WEIGHT * uneven - EXCESS_WEIGHT * max(excess - EXCESS, 0.0))


def least_at_rest(z: np.ndarray, level: float, weight: float) -> float:
    """
    Return the probability that a path needs where the camera is at rest.

    :param z: z-normalized distances of the images at rest to their place, (m,), m > 0.
    :param level: mean z of right places on this drive, mu.
    :param weight: of an image among others, alpha.
    """
    nearness = max(level * float(z.mean()) - level**2 / 2, 0.0)
    odds = SURE_AT_REST / (1 - SURE_AT_REST) * math.exp(-(1 - weight) * nearness)
    return odds / (1 + odds)
