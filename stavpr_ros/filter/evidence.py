# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The probability of the path of a window, by quantities without a unit.

z at right places has another mean for each kind of features, each map and each light. These do not
depend on it:

- p, the probability of the path by the filter, after the checks;
- the **lead** d = max(0, m - max(0, m')): m is the mean of -z along the path, m' the largest along
  straight paths of the same images elsewhere, more than ``APART`` places from its position
  (:func:`best_elsewhere`): how much nearer it is than its look-alikes, in this window and light.
  Of a camera at rest, one image counts;
- the number l of images that are matched: a window, or the newest images alone;
- r, the **recent** windows of the drive: whether this drive is on the map at all.

The probability is 1 / (1 + exp(-x)) with::

    x = own + 3.65 min(0, ln(r / (1 - r)))
    own = -7.01 + 0.62 ln(p / (1 - p)) + 2.56 ln(1 + l d)

r is the share of the windows before that are likely matches by themselves, own > -0.6, or, if that
is larger, the share of the latest ones that are sure by themselves, own > 3.4: of a drive that
comes to the map late. The mean of p separates less: by night p is low on right paths, too.

By logistic regression on features ``gradient`` and ``efficientnet_lite1`` together: on full
windows of drives, half of them with detours, and on the first images of drives. Each of six
routes, floors that look alike, and unrelated routes have the same weight. The log odds y of this
regression are recalibrated on routes left out, x = 2 (y - 0.8), with 1.25 times the factor of r:
of what it declared 0.9 with ``gradient``, 0.97 was right, and detours are matched at 0.7 and
below. benchmarks/results/evidence.md names the data, and has the results on data sets left out,
other quantities, and what half and double of each factor does.
"""

import math

import numpy as np
from stavpr_ros.alignment.cpu.simd import LANES, load, select, splat, store
from stavpr_ros.compilation import kernel

CONSTANT, POSTERIOR, LEAD, RECENT = -7.01, 0.62, 2.56, 3.65
LIKELY, SURE = -0.6, 3.4  # own evidence of windows that are counted
APART = 20  # places: paths nearer than that to the path are not elsewhere
SPEEDS = np.array([1 / 3, 1 / 2, 3 / 4, 1.0, 4 / 3, 2.0, 3.0])  # of straight paths
CERTAIN = 1e-4  # probability p beyond which, and beyond 1 less it, the odds do not grow
MIN_RECENT = 0.2  # a drive that comes to the map late is recognized there
FIRST = 8  # windows that count as the share .5 at first
LAST, LATEST = 100, 20  # windows that the shares of likely and of sure ones go back
FAR = np.float32(1)  # z beside the map, and of places that are not compared
INF = np.float32(np.inf)
CHUNK = 128  # places whose sums are computed together


class RecentWindows:
    """The share r of a drive's windows that are matches by themselves: .5 at first."""

    def __init__(self) -> None:
        self._likely = self._sure = 0.5
        self._count = FIRST

    @property
    def share(self) -> float:
        """Return r."""
        return max(self._likely, self._sure)

    def add(self, own: float) -> None:
        """Count another window by its own evidence."""
        self._count = min(self._count + 1, LAST)
        self._likely += ((own > LIKELY) - self._likely) / self._count
        self._sure += ((own > SURE) - self._sure) / min(self._count, LATEST)


def own_evidence(posterior: float, score: float, elsewhere: float, images: int) -> float:
    """
    Return the evidence of a path by its window alone; -inf if it is impossible.

    :param posterior: p, by the filter and the checks.
    :param score: m, mean of -z along the path.
    :param elsewhere: m', of :func:`best_elsewhere`.
    :param images: l.
    """
    if posterior <= 0:
        return -math.inf
    lead = max(score - max(elsewhere, 0.0), 0.0)
    return CONSTANT + POSTERIOR * _log_odds(posterior, CERTAIN) + LEAD * math.log1p(images * lead)


def path_probability(own: float, recent: float) -> float:
    """
    Return the probability of a path.

    :param own: of :func:`own_evidence`.
    :param recent: r, of the windows before.
    """
    return 1 / (1 + math.exp(-own - RECENT * min(_log_odds(recent, MIN_RECENT), 0.0)))


def changed_images(numbers: np.ndarray) -> np.ndarray:
    """
    Return which images differ from the one before, (l,), bool; the first one counts.

    :param numbers: of the images, (l,); equal ones are of a camera at rest.
    """
    changed: np.ndarray = np.diff(numbers, prepend=numbers[0] - 1) != 0
    return changed


def straight_steps(numbers: np.ndarray, position: int) -> np.ndarray:
    """
    Return the steps of straight paths from the place of an image, (V, l), int64.

    :param numbers: of the images, (l,); equal ones are of a camera at rest.
    """
    steps: np.ndarray = np.rint(SPEEDS[:, None] * (numbers - numbers[position])).astype(np.int64)
    return steps


@kernel
def best_elsewhere(
    memory: np.ndarray, rows: np.ndarray, n: int, steps: np.ndarray, excluded: np.ndarray
) -> float:
    """
    Return the largest mean of -z of straight paths, -inf where there is none.

    :param memory: distances z, (L, n or more), float32.
    :param rows: of the images in memory, (l,).
    :param steps: of :func:`straight_steps`.
    :param excluded: first ones and ends of the places whose paths do not count, (m, 2).
    """
    sums, images, infinite, far = np.empty(CHUNK, np.float32), len(rows), splat(INF), splat(FAR)
    flat, least = memory.reshape(-1), infinite
    for start in range(0, n, CHUNK):
        count = min(CHUNK, n - start)
        newest = rows[-1] * memory.shape[1] + start
        if not (flat[newest : newest + count] < INF).any():
            continue
        for v in range(len(steps)):
            sums[:count], sums[count:] = 0, INF
            for i in range(images):
                shift = start + steps[v, i]
                row = rows[i] * memory.shape[1] + shift
                low = min(max(-shift, 0), count)
                high = max(min(n - shift, count), low)
                whole = low + (high - low) // LANES * LANES
                for x in range(low, whole, LANES):
                    z = load(flat, row + x)
                    near = select(z < infinite, z, far)
                    store(sums, x, load(sums, x) + near)
                for x in range(whole, high):
                    sums[x] += flat[row + x] if flat[row + x] < INF else FAR
                sums[:low] += FAR
                sums[high:count] += FAR
            for first, end in excluded:
                sums[min(max(first - start, 0), count) : min(max(end - start, 0), count)] = INF
            for x in range(0, CHUNK, LANES):
                least = select(load(sums, x) < least, load(sums, x), least)
    store(sums, 0, least)
    return -float(sums[:LANES].min()) / images


def _log_odds(probability: float, least: float) -> float:
    """Return the logarithm of the odds of a probability, from ``least`` to 1 less it."""
    probability = min(max(probability, least), 1 - least)
    return math.log(probability / (1 - probability))
