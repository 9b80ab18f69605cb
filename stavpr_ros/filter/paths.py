# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the camera was: states of the place filter followed back over the latest images.

For each image, an origin of every state is kept. Two of them share a byte, that of an even speed
in the lower half and that of the next speed in the upper one::

    origin = 3 * step + speed    step 0: as far as the speed, 1: one place more, 2: one less
                                 speed 0: the same, 1: one lower, 2: one higher
    ENTERED                      the state was off the map

    ring of the latest images    (lag, blocks, K, (V + 1) // 2, BLOCK), uint8

The path of a state is then refined (:func:`refine`): the speeds of the filter are
few, and before the middle of the window the path is a straight line. The offset of each image's
place from it is a hidden Markov model: it changes little from image to image, and the evidence is
the filter's, at the path's level. The forward-backward algorithm gives its probabilities.

The place of an image is the mean by such a model and by straight paths, of a camera that advances
evenly in time. Each counts by the likelihood of the window.
"""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.alignment.cpu.simd import prefetch
from stavpr_ros.compilation import kernel

BLOCK = 128  # places whose states are neighbors in memory; a multiple of all LANES
ENTERED = 9  # origin of a state that came from off the map
ALL_ENTERED = ENTERED | ENTERED << 4  # two origins
NO_PLACES: np.ndarray = np.empty(0, np.int64)
TOP = 64  # places whose states are followed back
NEGLIGIBLE = 1e-3  # of the most probable state: states below are not followed back
CLOSE = 2  # places: the probability of a place is that of its neighbors within CLOSE, too
BAND = 5  # places to either side of the filter's path
START_DEVIATION = 3.0  # places, of the path at the oldest image of the window
STEPS = np.array([0.03, 0.12, 0.7, 0.12, 0.03])  # probability of 2 places less than the path, ...
EVENLY = 0.03  # probability of a camera that advances evenly
ENDS = np.arange(-3, 3.1, 0.5)  # places, from the path to the ends of its straight path
END_DEVIATION = 1.25  # places, of these ends
LEAST_DEVIATION = 0.5  # places: of both where few images moved
OFFSETS = np.arange(-BAND, BAND + 1)
IMPOSSIBLE = 1e-20  # least likelihood of an image


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

    def probabilities(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the places of n whose probability, with that of close ones, is not 0.

        :returns: places, ascending, (m,), and their probabilities.
        """
        most = len(self.places) * (2 * CLOSE + 1)
        near, sums = np.empty(most, np.int64), np.empty(most)
        count = _sum_close(self.places, self.weights, n, near, sums)
        return near[:count], sums[:count]


def belief_of(states: np.ndarray, probabilities: np.ndarray) -> Belief:
    """
    Return the belief that states give.

    :param states: (m, 5): place then, level, speed and place now, speed then.
    :param probabilities: of each state, (m,), float64.
    """
    order = np.argsort(states[:, 0], kind='stable')
    best, weights = np.empty(len(order), np.int64), np.zeros(len(order))
    count = _merge(states, probabilities, order, best, weights)
    found = states[best[:count]]
    return Belief(found[:, 0], weights[:count], found[:, 1:])


def refine(
    z: np.ndarray, path: np.ndarray, exponents: np.ndarray, images: np.ndarray,
    times: np.ndarray, place_times: np.ndarray, evidence: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """
    Return where the camera was beside a path, by all images of the window.

    The second mean offset is by other evidence, and by two models. With the likelihoods P of the
    window if the camera advances evenly in time and Q if not, and the means by both, it is

        (0.03 P even + 0.97 Q uneven) / (0.03 P + 0.97 Q)

    Their deviations are in proportion to the images that moved: the filter knows the path of a
    slow camera by the images before the window.

    :param z: z-normalized distances of each image to the places near the path, (l, S), float32.
    :param path: place of each image, ascending, (l,), int64.
    :param exponents: of their likelihoods: alpha times the mean of right places, (l,).
    :param images: the filter's number of each, (l,): equal ones are of a camera at rest.
    :param times: of the images, ascending, (l,), float64, of any unit.
    :param place_times: of the n places, ascending, (n,), float64, of any unit.
    :param evidence: factor of the exponents for the second mean offset.
    :returns: probability of each offset for each image, (l, S), and mean offsets by the first
        model and by both, (2, l).
    """
    masses, means = np.empty(z.shape), np.zeros((2, len(path)))
    _refine(z, path, exponents, images, times, place_times, evidence, masses, means)
    return masses, means


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
def backtrack_states(a, least, tops, origins, steps, newest, count, states, probabilities):
    """
    Follow states back over a number of images.

    :param a: states, (blocks, K, V, BLOCK).
    :param least: states below it are excluded.
    :param tops: places whose states count, (m,).
    :param count: images to go back; other parameters: see :func:`trace_back`.
    :param states: (m K V, 5), written: place then, state now (k, v, y), speed then.
    :param probabilities: (m K V,), written: of these states.
    :returns: number of states that were on the map then.
    """
    found = 0
    for y in tops:
        for k in range(a.shape[1]):
            for v in range(a.shape[2]):
                p = a[y // BLOCK, k, v, y % BLOCK]
                if p >= least:
                    states[found, 0], states[found, 1], states[found, 2] = y, k, v
                    states[found, 3], states[found, 4] = y, v
                    probabilities[found] = p
                    found += 1
    _, blocks, _, halves, _ = origins.shape
    flat = origins.reshape(-1)
    for i in range(count):  # all together: each waits for its memory
        slot, left = (newest - i) % len(origins), 0
        earlier = (newest - i - 1) % len(origins) * blocks
        for at in range(found):
            speed, place = _before(
                states[at, 1], states[at, 4], states[at, 0], origins[slot], steps[slot]
            )
            if place >= 0:
                for column in range(1, 4):
                    states[left, column] = states[at, column]
                states[left, 0], states[left, 4] = place, speed
                probabilities[left] = probabilities[at]
                row = ((earlier + place // BLOCK) * a.shape[1] + states[at, 1]) * halves
                prefetch(flat, (row + speed // 2) * BLOCK + place % BLOCK)
                left += 1
        found = left
    return found


@kernel
def find_largest(by_place, blocks, n, places):
    """Write the places of blocks, below n, with the largest sums, the largest first."""
    values, last = np.full(len(places), -1, np.float32), len(places) - 1
    for block in blocks:
        for y in range(block * BLOCK, min((block + 1) * BLOCK, n)):
            if by_place[y] <= values[last]:
                continue
            at = last
            while at > 0 and values[at - 1] < by_place[y]:
                values[at], places[at] = values[at - 1], places[at - 1]
                at -= 1
            values[at], places[at] = by_place[y], y


@kernel
def _merge(states, probabilities, order, best, weights):
    """
    Add up the probabilities of states that were at one place.

    :param states: see :func:`belief_of`; order: of their places, ascending.
    :param best, weights: of each place, its most probable state and its sum, written.
    :returns: number of places.
    """
    found = -1
    for i in order:
        if found < 0 or states[i, 0] != states[best[found], 0]:
            found += 1
            best[found] = i
        elif probabilities[i] > probabilities[best[found]]:
            best[found] = i
        weights[found] += probabilities[i]
    return found + 1


@kernel
def _sum_close(places, weights, n, near, sums):
    """Write the places below n within ``CLOSE`` of any place, and their sums, at most 1."""
    found = low = end = 0
    for place in places:
        for y in range(max(place - CLOSE, end), min(place + CLOSE + 1, n)):
            while places[low] < y - CLOSE:
                low += 1
            total, i = 0.0, low
            while i < len(places) and places[i] <= y + CLOSE:
                total += weights[i]
                i += 1
            near[found], sums[found] = y, min(total, 1.0)
            found, end = found + 1, y + 1
    return found


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


@kernel
def _refine(z, path, exponents, images, times, place_times, evidence, masses, means):
    """Write the results of :func:`refine`."""
    l, n = len(path), len(place_times)
    likelihoods, moves = np.empty(z.shape), np.empty((l, len(STEPS)))
    _window_likelihoods(z, path, exponents, 1.0, images, n, likelihoods, moves)
    _start(START_DEVIATION, masses[0])
    uneven, log = masses, smooth(likelihoods, moves, masses)
    moved = (images[-1] - images[0]) / max(l - 1, 1)
    if evidence != 1 or moved < 1:  # another model than the first
        _window_likelihoods(z, path, exponents, evidence, images, n, likelihoods, moves)
        uneven = np.empty(z.shape)
        _start(max(START_DEVIATION * moved, LEAST_DEVIATION), uneven[0])
        log = smooth(likelihoods, moves, uneven)
    q = (1 - EVENLY) * np.exp(log)
    deviation = max(END_DEVIATION * moved, LEAST_DEVIATION)
    p = EVENLY * straight_offsets(likelihoods, path, times, place_times, deviation, means[1])
    share = p / (p + q) if p > 0 else 0.0
    for i in range(l):
        mean = 0.0
        for s in range(len(OFFSETS)):
            means[0, i] += masses[i, s] * OFFSETS[s]
            mean += uneven[i, s] * OFFSETS[s]
        means[1, i] = share * means[1, i] + (1 - share) * mean


@kernel
def ascending(path, offsets, first, last):
    """
    Return places at offsets from a path, (l,), int64, which never go back.

    :param path: places, (l,), int64, and offsets, (l,), float64.
    :param first, last: least and largest place.
    """
    places = np.empty(len(path), np.int64)
    for i in range(len(path)):
        place = min(max(path[i] + int(np.rint(offsets[i])), first), last)
        places[i] = max(place, places[i - 1]) if i else place
    return places


@kernel
def _start(deviation, masses):
    """Write the probability of each offset before the first image, (S,)."""
    for s in range(len(OFFSETS)):
        masses[s] = np.exp(-0.5 * (OFFSETS[s] / deviation) ** 2)
    _normalize(masses)


@kernel
def _window_likelihoods(z, path, exponents, evidence, images, n, likelihoods, moves):
    """
    Write the input of :func:`smooth`.

    :param evidence: factor of the exponents; n: places; others: see :func:`refine`.
    """
    for i in range(len(path)):
        for s in range(z.shape[1]):
            inside = 0 <= path[i] + s - BAND < n and np.isfinite(z[i, s])
            likelihoods[i, s] = np.exp(evidence * exponents[i] * z[i, s]) if inside else 0
        largest = likelihoods[i].max()
        for s in range(z.shape[1]):
            likelihoods[i, s] = likelihoods[i, s] / largest if largest > 0 else 1
        step = path[i] - path[i - 1] if i else 0
        same = i > 0 and images[i] == images[i - 1]
        for d in range(-2, 3):
            moved = STEPS[d + 2] if step + d >= 0 else 0
            moves[i, d + 2] = (1 if d == 0 else 0) if same else moved


@kernel
def smooth(likelihoods: np.ndarray, moves: np.ndarray, masses: np.ndarray) -> float:
    """
    Write the probability of each offset at each image, by the forward-backward algorithm.

    :param likelihoods: of each image at each offset, relative to the largest, (l, S); equal for
        an image that no offset explains.
    :param moves: probability that the offset becomes 2 less, ..., 2 more before an image, (l, 5).
    :param masses: (l, S), written; its first row contains the probabilities before all images.
    :returns: logarithm of the likelihood of all images.
    """
    l, S = likelihoods.shape
    log = 0.0
    for i in range(l):
        for s in range(S):
            if i:
                masses[i, s] = 0
                for d in range(max(-2, s - S + 1), min(2, s) + 1):
                    masses[i, s] += masses[i - 1, s - d] * moves[i, d + 2]
            masses[i, s] *= likelihoods[i, s]
        log += np.log(max(_normalize(masses[i]), IMPOSSIBLE))
    later, weighed = np.ones(S), np.empty(S)
    for i in range(l - 2, -1, -1):
        for s in range(S):
            weighed[s] = later[s] * likelihoods[i + 1, s]
        for s in range(S):
            later[s] = 0
            for d in range(max(-2, -s), min(2, S - 1 - s) + 1):
                later[s] += moves[i + 1, d + 2] * weighed[s + d]
        _normalize(later)
        total = 0.0
        for s in range(S):
            total += masses[i, s] * later[s]
        if total > 0:
            for s in range(S):
                masses[i, s] *= later[s] / total
    return log


@kernel
def _normalize(masses: np.ndarray) -> float:
    """Make a row's sum 1, that of a row of zeros evenly, and return the sum before."""
    total = masses.sum()
    for s in range(len(masses)):
        masses[s] = masses[s] / total if total > 0 else 1 / len(masses)
    return total


@kernel
def straight_offsets(
    likelihoods: np.ndarray, path: np.ndarray, times: np.ndarray, place_times: np.ndarray,
    deviation: float, means: np.ndarray,
) -> float:  # fmt: skip
    """
    Add up the offsets of straight paths, each by the likelihood of the images.

    They lead from a place near that of the oldest image to one near that of the newest, and pass
    all places at one ratio of the time on the map to that of the query.

    :param likelihoods: those of :func:`smooth`; offsets beyond are excluded.
    :param path: place of each image, ascending, (l,), int64.
    :param times: of the images, (l,), and place_times: of the places, (n,); ascending.
    :param deviation: of the ends of a path, places.
    :param means: zeros, (l,); written: the mean offset of each image.
    :returns: likelihood of all images.
    """
    last, end_of_map = len(path) - 1, len(place_times) - 1
    offsets, passed = np.zeros(len(path)), np.ones(len(path))  # passed: share of the time
    if times[last] > times[0]:
        passed[:] = (times - times[0]) / (times[last] - times[0])
    sum_of_weights, prior = 0.0, 0.0
    for from_first in ENDS:
        for from_last in ENDS:
            weight = np.exp(-0.5 * (from_first**2 + from_last**2) / deviation**2)
            prior += weight
            begin = _time_at(place_times, path[0] + from_first)
            end = max(_time_at(place_times, path[last] + from_last), begin)
            y = max(path[0] + int(ENDS[0]), 0)
            for i in range(last + 1):
                time = begin + (end - begin) * passed[i]
                while y < end_of_map and place_times[y + 1] <= time:
                    y += 1
                place = float(y)
                if y < end_of_map:
                    place += (time - place_times[y]) / (place_times[y + 1] - place_times[y])
                offsets[i] = place - path[i]
                s = int(np.rint(offsets[i])) + BAND
                weight *= likelihoods[i, s] if 0 <= s < likelihoods.shape[1] else 0
                if weight == 0:
                    break
            sum_of_weights += weight
            for i in range(last + 1):
                means[i] += weight * offsets[i]
    if sum_of_weights > 0:
        means /= sum_of_weights
    return sum_of_weights / prior


@kernel
def _time_at(place_times: np.ndarray, place: float) -> float:
    """Return the time at a place, also between two; the places beyond the ends are the ends."""
    place = min(max(place, 0.0), len(place_times) - 1.0)
    y = min(int(place), max(len(place_times) - 2, 0))
    later = min(y + 1, len(place_times) - 1)
    return place_times[y] + (place_times[later] - place_times[y]) * (place - y)
