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
- by how many **cells** e the path agrees better than that path elsewhere, its competitor
  (:mod:`stavpr_ros.recognition.cells`);
- the number l of images that are matched: a window, or the newest images alone;
- r, the **recent** windows of the drive: whether this drive is on the map at all.

The probability is 1 / (1 + exp(-x)), below one half 1 / (1 + exp((x / 5)^2)), with::

    x = own + 5 min(0, ln(r / (1 - r)))
    own = K + 0.5 ln(p / (1 - p)) + 2.4 ln(1 + l d) + 2.06 ln(1 + max(e, 0))

K is of the kind of features, with its cells or without
(:class:`stavpr_ros.features.registry.Kind`). Where p is below one half, own is at most
ln(p / (1 - p)) + 4: a path that has left the map has been right. The square below one half serves
drives off the map and on it, and moves nothing over it.

r is the share of the windows before that are likely matches by themselves, own > -0.6, or, if that
is larger, the share of the latest ones that are sure by themselves, own > 5.2: of a drive that
comes to the map late.

By logistic regression y on windows of drives with ``gradient`` and ``hybrid``, and on their first
images: each route, floors that look alike, reverse drives and unrelated routes have the same
weight; x = 2 (y - 0.8), with less of r and more of p. benchmarks/results/evidence.md names the
data, and has the results on sets left out, other quantities, and what other factors do.
"""

import math

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.filter.paths import is_excluded
from stavpr_ros.simd import LANES, load, select, splat, store

POSTERIOR, LEAD, CELLS, RECENT = 0.5, 2.4, 2.06, 5.0
GAIN = 4.0  # by which the evidence raises the log odds of p, at most
UNLIKELY = 5.0  # the log odds x below 0 are -(x / UNLIKELY)^2
LIKELY, SURE = -0.6, 5.2  # own evidence of likely and of sure windows
APART = 20  # places: paths nearer than that to the path are not elsewhere
SPEEDS = np.array([1 / 3, 1 / 2, 3 / 4, 1.0, 4 / 3, 2.0, 3.0])  # of straight paths
CERTAIN = 1e-4  # probability p beyond which, and beyond 1 less it, the odds do not grow
MIN_RECENT = 0.2  # a drive that comes to the map late is recognized there
FIRST = 8  # windows that count as the share .5 at first
LAST, LATEST = 100, 20  # windows that the shares of likely and of sure ones go back
FAR = np.float32(1)  # z beside the map, and of places that are not compared
INF = np.float32(np.inf)
ZERO = np.float32(0)
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


def own_evidence(
    constant: float,
    posterior: float,
    lead: float,
    images: int,
    cells: float = 0.0,
) -> float:
    """
    Return the evidence of a path by its window alone; -inf if it is impossible.

    :param constant: of the kind of features, K.
    :param posterior: p, by the filter and the checks.
    :param lead: d, of :func:`lead_of`.
    :param images: l.
    :param cells: e, by how many cells it agrees better than its competitor; 0 = not compared.
    """
    if posterior <= 0:
        return -math.inf
    odds = _log_odds(posterior, CERTAIN)
    own = constant + POSTERIOR * odds + LEAD * math.log1p(images * lead)
    own += CELLS * math.log1p(max(cells, 0.0))
    return min(own, odds + GAIN) if odds < 0 else own


def lead_of(score: float, elsewhere: float) -> float:
    """Return the lead d by m, the mean of -z along the path, and m' of :func:`best_elsewhere`."""
    return max(score - max(elsewhere, 0.0), 0.0)


def path_probability(own: float, recent: float) -> float:
    """
    Return the probability of a path.

    :param own: of :func:`own_evidence`.
    :param recent: r, of the windows before.
    """
    x = own + RECENT * min(_log_odds(recent, MIN_RECENT), 0.0)
    return 1 / (1 + math.exp(-x if x > 0 else (x / UNLIKELY) ** 2))


@kernel
def changed_images(numbers: np.ndarray) -> np.ndarray:
    """
    Return which images differ from the one before, (l,), bool; the first one counts.

    :param numbers: of the images, (l,); equal ones are of a camera at rest.
    """
    changed = np.ones(len(numbers), np.bool_)
    for i in range(1, len(numbers)):
        changed[i] = numbers[i] != numbers[i - 1]
    return changed


@kernel
def straight_steps(numbers: np.ndarray, position: int) -> np.ndarray:
    """
    Return the steps of straight paths from the place of an image, (V, l), int64.

    :param numbers: of the images, (l,); equal ones are of a camera at rest.
    """
    steps = np.empty((len(SPEEDS), len(numbers)), np.int64)
    for v in range(len(SPEEDS)):
        for i in range(len(numbers)):
            steps[v, i] = np.rint(SPEEDS[v] * (numbers[i] - numbers[position]))
    return steps


@kernel
def _counted(rows, numbers, steps):  # type: ignore[no-untyped-def]
    """Return the rows and steps of images that differ from the one before, (m,), (V, m)."""
    counted, changed, count = np.empty_like(rows), changed_images(numbers), 0
    for i in range(len(rows)):
        if changed[i]:
            counted[count] = rows[i]
            for v in range(len(steps)):
                steps[v, count] = steps[v, i]
            count += 1
    return counted[:count], steps[:, :count]


@kernel
def best_elsewhere(
    memory: np.ndarray, rows: np.ndarray, n: int, numbers: np.ndarray, position: int,
    excluded: np.ndarray,
) -> tuple[float, np.ndarray]:  # fmt: skip
    """
    Return the largest mean of -z of straight paths, -inf where there is none, and its path.

    :param memory: distances z, (L, n or more), float32.
    :param rows: of the images in memory, (l,).
    :param numbers, position: of :func:`straight_steps`; images that do not differ from the one
        before do not count.
    :param excluded: first ones and ends of the places whose paths do not count, (m, 2).
    :returns: also the place of each image that counts, within the map, (m,), int64; or empty.
    """
    rows, steps = _counted(rows, numbers, straight_steps(numbers, position))
    images = len(rows)
    before, behind = max(-steps[-1, 0], 0), max(steps[-1, images - 1], 0)  # of the largest speed
    width = before + CHUNK + behind
    near = np.empty((images, width), np.float32)  # z of the images around a chunk, finite
    flat, sums, lanes = near.reshape(-1), np.empty(CHUNK, np.float32), np.empty(LANES, np.float32)
    best, place, speed = INF, -1, 0
    for start in range(0, n, CHUNK):
        if is_excluded(memory[rows[-1]], start, min(start + CHUNK, n)):
            continue
        first, end = max(start - before, 0), min(start + CHUNK + behind, n)
        for i in range(images):
            row, own = memory[rows[i], first:end], near[i]
            own[: first - start + before] = own[end - start + before :] = FAR
            own = own[first - start + before : end - start + before]
            for y in range(len(row)):
                own[y] = row[y] if row[y] < INF else FAR
        for v in range(len(SPEEDS)):
            for x in range(0, CHUNK, 4 * LANES):  # four sums at a time: each waits for itself
                a, b, c, d = splat(ZERO), splat(ZERO), splat(ZERO), splat(ZERO)
                for i in range(images):
                    at = i * width + before + steps[v, i] + x
                    a, b = a + load(flat, at), b + load(flat, at + LANES)
                    c, d = c + load(flat, at + 2 * LANES), d + load(flat, at + 3 * LANES)
                store(sums, x, a)
                store(sums, x + LANES, b)
                store(sums, x + 2 * LANES, c)
                store(sums, x + 3 * LANES, d)
            sums[n - start :] = INF
            for first, end in excluded:
                sums[max(first - start, 0) : max(end - start, 0)] = INF
            least = splat(INF)
            for x in range(0, CHUNK, LANES):
                least = select(load(sums, x) < least, load(sums, x), least)
            store(lanes, 0, least)
            if lanes.min() < best:
                place, speed = start + int(sums.argmin()), v
                best = sums[place - start]
    path = np.empty(images if place >= 0 else 0, np.int64)
    for i in range(len(path)):
        path[i] = min(max(place + steps[speed, i], 0), n - 1)
    return -float(best) / images, path


def _log_odds(probability: float, least: float) -> float:
    """Return the logarithm of the odds of a probability, from ``least`` to 1 less it."""
    probability = min(max(probability, least), 1 - least)
    return math.log(probability / (1 - probability))
