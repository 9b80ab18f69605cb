# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the camera was: states of the place filter followed back over the latest images.

For each image, an origin of every state is kept. Two of them share a byte, the origin for
an even speed in the lower half and for the next speed in the upper one::

    origin = 3 * step + speed    step 0: as far as the speed, 1: one place more, 2: one less
                                 speed 0: the same, 1: one lower, 2: one higher
    ENTERED                      the state was off the map

    ring of the latest images    (lag, blocks, K, (V + 1) // 2, BLOCK), uint8
"""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.simd import prefetch

BLOCK = 128  # places whose states are neighbors in memory; a multiple of all LANES
ENTERED = 9  # origin of a state that came from off the map
ALL_ENTERED = ENTERED | ENTERED << 4  # two origins
NO_PLACES: np.ndarray = np.empty(0, np.int64)
TOP = 64  # places whose states are followed back
NEGLIGIBLE = 1e-3  # of the most probable state: states below are not followed back
CLOSE = 2  # places: the probability of a place includes its neighbors within CLOSE


@dataclass(frozen=True, eq=False)
class Belief:
    """
    Where the camera was a number of images ago.

    :param places: places that paths of probable states lead to, ascending, (m,).
    :param weights: probability of each of them alone, (m,).
    :param states: of each, the most probable state now and the speed then, (m, 4), int: level,
        speed, place, speed then.
    """

    places: np.ndarray
    weights: np.ndarray
    states: np.ndarray


# ------------------------------------------------ kernels


@kernel
def _before(k, v, y, origins, steps):
    """Return speed and place of a state one image before, -1 as place where it was off the map."""
    origin = (origins[y // BLOCK, k, v // 2, y % BLOCK] >> (v % 2 * 4)) & 15
    if origin == ENTERED:
        return v, -1
    r, step, change = steps[v], origin // 3, origin % 3
    places = r if step == 0 else r + 1 if step == 1 else max(r - 1, 0)
    return v - (change == 1) + (change == 2), y - places


@kernel
def is_excluded(z, first, end):
    """Return whether all distances from ``first`` to before ``end`` are infinite."""
    while first < end and not z[first] < np.inf:
        first += 1
    return first >= end


@kernel
def trace_back(k, v, y, origins, steps, newest, count, places):
    """
    Write the most probable path to a state, newest place first.

    :param origins: ring of the last images' origins, (m, blocks, K, (V + 1) // 2, BLOCK), uint8.
    :param steps: ring of their steps, (m, V).
    :param newest: slot of the newest image.
    :param count: images to go back, at most m.
    :param places: (count + 1,), written: the place at each image, -1 before the path entered the
        map.
    """
    places[0] = y
    for i in range(count):
        slot = (newest - i) % len(origins)
        v, y = _before(k, v, y, origins[slot], steps[slot])
        places[i + 1] = y
        if y < 0:
            places[i + 1 :] = -1
            return


@kernel
def backtrack(a, by_place, maxima, n, origins, steps, newest, count, scale):
    """
    Follow the probable states of the most probable places back over a number of images.

    :param a: states, (blocks, K, V, BLOCK); scale: factor that makes probabilities of them.
    :param by_place, maxima, n: see :func:`_largest`.
    :param count: images to go back; other parameters: see :func:`trace_back`.
    :returns: places, weights and states of the :class:`Belief`.
    """
    _, K, V, _ = a.shape
    tops, largest = _largest(by_place, maxima, n), np.float32(0)
    for y in tops:
        for k in range(K):
            for v in range(V):
                largest = max(largest, a[y // BLOCK, k, v, y % BLOCK])
    least = np.float32(NEGLIGIBLE) * largest
    states, total = np.empty((len(tops) * K * V, 5), np.int64), 0
    probabilities = np.empty(len(states))
    for y in tops:
        for k in range(K):
            for v in range(V):
                p = a[y // BLOCK, k, v, y % BLOCK]
                if p >= least and p > 0:
                    states[total, 0], states[total, 1], states[total, 2] = y, k, v
                    states[total, 3], states[total, 4] = y, v
                    probabilities[total] = p * scale
                    total += 1
    blocks, halves, flat = origins.shape[1], origins.shape[3], origins.reshape(-1)
    for i in range(count):  # all together: each waits for its memory
        slot, remaining = (newest - i) % len(origins), 0
        earlier = (newest - i - 1) % len(origins) * blocks
        for at in range(total):
            speed, place = _before(
                states[at, 1], states[at, 4], states[at, 0], origins[slot], steps[slot]
            )
            if place >= 0:
                for column in range(1, 4):
                    states[remaining, column] = states[at, column]
                states[remaining, 0], states[remaining, 4] = place, speed
                probabilities[remaining] = probabilities[at]
                row = ((earlier + place // BLOCK) * K + states[at, 1]) * halves
                prefetch(flat, (row + speed // 2) * BLOCK + place % BLOCK)
                remaining += 1
        total = remaining
    return merged(states[:total], probabilities)


@kernel
def _largest(by_place, maxima, n):
    """
    Return the ``TOP`` most probable places, the most probable first.

    :param by_place: sums of the states of n places, and maxima: the largest of each block.
    """
    count = min(TOP, n)
    values, places, last = np.full(count, -1, np.float32), np.empty(count, np.int64), count - 1
    for block in range((n + BLOCK - 1) // BLOCK):
        if maxima[block] <= values[last]:
            continue
        for y in range(block * BLOCK, min((block + 1) * BLOCK, n)):
            if by_place[y] <= values[last]:
                continue
            at = last
            while at > 0 and values[at - 1] < by_place[y]:
                values[at], places[at] = values[at - 1], places[at - 1]
                at -= 1
            values[at], places[at] = by_place[y], y
    return places


@kernel
def merged(states, probabilities):
    """
    Add up the probabilities of states that were at one place.

    :param states: (m, 5): place then, level, speed and place now, speed then.
    :param probabilities: of each state, (m,) or more, float64.
    :returns: places, weights and states of the :class:`Belief`.
    """
    places, weights = np.empty(len(states), np.int64), np.zeros(len(states))
    best, count = np.empty(len(states), np.int64), 0
    for i in range(len(states)):
        at = np.searchsorted(places[:count], states[i, 0])
        if at == count or places[at] != states[i, 0]:
            for later in range(count, at, -1):
                places[later], weights[later] = places[later - 1], weights[later - 1]
                best[later] = best[later - 1]
            places[at], weights[at], best[at] = states[i, 0], 0, i
            count += 1
        elif probabilities[i] > probabilities[best[at]]:
            best[at] = i
        weights[at] += probabilities[i]
    return places[:count], weights[:count], states[best[:count]][:, 1:]


@kernel
def sum_close(places, weights, n):
    """Return the places below n within ``CLOSE`` of any place, and their sums, at most 1."""
    near = np.empty(len(places) * (2 * CLOSE + 1), np.int64)
    sums, count, low, end = np.empty(len(near)), 0, 0, 0
    for place in places:
        for y in range(max(place - CLOSE, end), min(place + CLOSE + 1, n)):
            while places[low] < y - CLOSE:
                low += 1
            total, i = 0.0, low
            while i < len(places) and places[i] <= y + CLOSE:
                total += weights[i]
                i += 1
            near[count], sums[count] = y, min(total, 1.0)
            count, end = count + 1, y + 1
    return near[:count], sums[:count]


@kernel
def find_most_probable(by_place, maxima, excluded):
    """Return the most probable place outside ``excluded``, ascending, and its sum, 0 if none."""
    best, at, i = np.float32(-1), 0, 0
    for block in range(len(maxima)):
        while i < len(excluded) and excluded[i] < block * BLOCK:
            i += 1
        if maxima[block] <= best:
            continue
        for y in range(block * BLOCK, (block + 1) * BLOCK):
            while i < len(excluded) and excluded[i] < y:
                i += 1
            value = np.float32(0) if i < len(excluded) and excluded[i] == y else by_place[y]
            if value > best:
                best, at = value, y
    return at, best
