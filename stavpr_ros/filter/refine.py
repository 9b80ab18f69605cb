# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Refinement of a path: where the camera was beside it, by all images of the window.

The speeds of the filter are few, and before the middle of the window its path is a straight line.
The offset s_i of each image's place from the path is a hidden Markov model: it changes by 2 places
less, ..., 2 more from image to image with the probabilities ``STEPS``, and the evidence is the
filter's, exp(alpha_i mu z_i[s]), at the path's level. The forward-backward algorithm
(:func:`smooth`) gives its probabilities.

The place of an image is the mean by such a model and by straight paths, of a camera that advances
evenly in time (:func:`straight_offsets`). Each counts by the likelihood of the window.
"""

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.filter.checks import unevenness
from stavpr_ros.filter.paths import CLOSE

BAND = 5  # places to either side of the filter's path
OFFSETS = np.arange(-BAND, BAND + 1)
START_DEVIATION = 3.0  # places, of the path at the oldest image of the window
STEPS = np.array([0.03, 0.12, 0.7, 0.12, 0.03])  # probability of 2 places less than the path, ...
EVENLY = 0.03  # probability of a camera that advances evenly
ENDS = np.arange(-3, 3.1, 0.5)  # places, from the path to the ends of its straight path
END_DEVIATION = 1.25  # places, of these ends
MIN_DEVIATION = 0.5  # places: of both where few images moved
MIN_LIKELIHOOD = 1e-20  # least likelihood of an image
LONGEST = 4.0  # intervals between images: beyond, the camera stopped, or its speed is unknown


@kernel
def image_times(stamps: np.ndarray, numbers: np.ndarray, usual: float) -> np.ndarray:
    """
    Return the times of images, (m,), float64, ascending.

    A camera that loses images still advances evenly in time: the stamps of a window show where
    images are missing, the stamps of a map where places are. An interval is 1 where a stamp is
    unknown or not above the one before.

    :param stamps: ns, (m,), int64; 0 = unknown.
    :param numbers: (m,), int64; equal ones are of a camera at rest, for which no time passes.
    :param usual: interval that is the unit, ns.
    """
    times = np.zeros(len(stamps))
    for i in range(len(stamps) - 1):
        is_known = stamps[i + 1] > stamps[i] > 0
        step = min((stamps[i + 1] - stamps[i]) / usual, LONGEST) if is_known else 1.0
        times[i + 1] = times[i] + (step if numbers[i + 1] > numbers[i] else 0.0)
    return times


@kernel
def usual_interval(stamps: np.ndarray) -> float:
    """Return the median of the known intervals of a few images, ns; 1 where none is known."""
    steps, count = np.empty(len(stamps), np.int64), 0
    for i in range(len(stamps) - 1):
        if stamps[i + 1] > stamps[i] > 0:
            at, step = count, stamps[i + 1] - stamps[i]
            while at > 0 and steps[at - 1] > step:
                steps[at] = steps[at - 1]
                at -= 1
            steps[at] = step
            count += 1
    return (steps[(count - 1) // 2] + steps[count // 2]) / 2 if count else 1.0


# ------------------------------------------------ kernels


@kernel
def refine(z, path, exponents, images, times, place_times):
    """
    Return where the camera was beside a path, by all images of the window.

    The second mean offset is by two models. With the likelihoods P of the window if the camera
    advances evenly in time and Q if not, and the means by both, it is

        (0.03 P even + 0.97 Q uneven) / (0.03 P + 0.97 Q)

    Their deviations are in proportion to the images that moved: the filter knows the path of a
    slow camera by the images before the window.

    :param z: z-normalized distances of each image to the places near the path, (l, S), float32.
    :param path: place of each image, ascending, (l,), int64.
    :param exponents: of their likelihoods: alpha times the mean of right places, (l,).
    :param images: the filter's number of each, (l,): equal ones are of a camera at rest.
    :param times: of the images, ascending, (l,), float64, of any unit.
    :param place_times: of the n places, ascending, (n,), float64, of any unit.
    :returns: probability of each offset for each image, (l, S), and mean offsets by the first
        model and by both, (2, l).
    """
    l, n = len(path), len(place_times)
    masses, means = np.empty(z.shape), np.zeros((2, l))
    likelihoods, moves = np.empty(z.shape), np.empty((l, len(STEPS)))
    _window_likelihoods(z, path, exponents, images, n, likelihoods, moves)
    _start(START_DEVIATION, masses[0])
    uneven, log = masses, smooth(likelihoods, moves, masses)
    moved = (images[-1] - images[0]) / max(l - 1, 1)
    if moved < 1:  # another model than the first
        uneven = np.empty(z.shape)
        _start(max(START_DEVIATION * moved, MIN_DEVIATION), uneven[0])
        log = smooth(likelihoods, moves, uneven)
    q = (1 - EVENLY) * np.exp(log)
    deviation = max(END_DEVIATION * moved, MIN_DEVIATION)
    p = EVENLY * straight_offsets(likelihoods, path, times, place_times, deviation, means[1])
    share = p / (p + q) if p > 0 else 0.0
    for i in range(l):
        mean = 0.0
        for s in range(len(OFFSETS)):
            means[0, i] += masses[i, s] * OFFSETS[s]
            mean += uneven[i, s] * OFFSETS[s]
        means[1, i] = share * means[1, i] + (1 - share) * mean
    return masses, means


@kernel
def refined(z, path, exponents, images, stamps, place_times, first, equal, passes):
    """
    Return the places near a path that explain the images of the window best.

    The path is checked at the mean of the first model.

    :param z, path, exponents, images, place_times: see :func:`refine`.
    :param stamps: ns, (l,), int64; 0 = unknown.
    :param first: least place.
    :param equal: which passes equal the one before: such are as one.
    :param passes: of each place.
    :returns: columns that are checked, (l,), the estimated ones, (l,), z of each image at the
        column that is checked, (l,), the probability of each offset, (l, S), 0 where it is not
        close to the estimated column, the unevenness, and the finite z of images that differ from
        the one before, (m,).
    """
    times, n = image_times(stamps, images, usual_interval(stamps)), len(place_times)
    masses, means = refine(z, path, exponents, images, times, place_times)
    checked, placed = _ascending(path, means[0], first, n), _ascending(path, means[1], first, n)
    of_checked, compared = np.empty(len(path), np.float32), np.empty(len(path), np.float32)
    count, begin, end = 0, passes[max(path[0] - BAND, 0)], passes[min(path[-1] + BAND, n - 1)]
    has_equal = equal[begin + 1 : end + 1].any()
    for i in range(len(path)):
        of_checked[i] = z[i, min(max(checked[i] - path[i], -BAND), BAND) + BAND]
        if np.isfinite(of_checked[i]) and (i == 0 or images[i] != images[i - 1]):
            compared[count] = of_checked[i]
            count += 1
        for s in range(len(OFFSETS)):
            place = path[i] + OFFSETS[s]
            if abs(place - placed[i]) > CLOSE:
                own, other = passes[min(max(place, 0), n - 1)], passes[placed[i]]
                between = equal[min(own, other) + 1 : max(own, other) + 1]
                masses[i, s] *= has_equal and between.all()
    uneven = unevenness(checked, of_checked)
    return checked, placed, of_checked, masses, uneven, compared[:count]


@kernel
def _ascending(path, offsets, first, n):
    """
    Return places at offsets from a path, (l,), int64, which never go back.

    :param path: places, (l,), int64, and offsets, (l,), float64.
    :param first: least place, and n: behind the largest.
    """
    places = np.empty(len(path), np.int64)
    for i in range(len(path)):
        place = min(max(path[i] + int(np.rint(offsets[i])), first), n - 1)
        places[i] = max(place, places[i - 1]) if i else place
    return places


@kernel
def _start(deviation, masses):
    """Write the probability of each offset before the first image, (S,)."""
    for s in range(len(OFFSETS)):
        masses[s] = np.exp(-0.5 * (OFFSETS[s] / deviation) ** 2)
    _normalize(masses)


@kernel
def _window_likelihoods(z, path, exponents, images, n, likelihoods, moves):
    """
    Write the input of :func:`smooth`.

    :param n: places; others: see :func:`refine`.
    """
    for i in range(len(path)):
        for s in range(z.shape[1]):
            inside = 0 <= path[i] + s - BAND < n and np.isfinite(z[i, s])
            likelihoods[i, s] = np.exp(exponents[i] * z[i, s]) if inside else 0
        largest = 0.0
        for s in range(z.shape[1]):
            largest = max(largest, likelihoods[i, s])
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
        log += np.log(max(_normalize(masses[i]), MIN_LIKELIHOOD))
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
    """Make a row's sum 1, evenly for a row of zeros, and return the sum before."""
    total = 0.0
    for s in range(len(masses)):
        total += masses[s]
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

    They lead from near the place of the oldest image to near the place of the newest, and pass all
    places at one ratio of the time on the map to the time of the query.

    :param likelihoods: see :func:`smooth`; offsets beyond are excluded.
    :param path: place of each image, ascending, (l,), int64.
    :param times: of the images, (l,), and place_times: of the places, (n,); ascending.
    :param deviation: of the ends of a path, places.
    :param means: zeros, (l,); written: the mean offset of each image.
    :returns: likelihood of all images.
    """
    last, end_of_map = len(path) - 1, len(place_times) - 1
    offsets, passed = np.zeros(len(path)), np.ones(len(path))  # passed: share of the time
    for i in range(len(path) if times[last] > times[0] else 0):
        passed[i] = (times[i] - times[0]) / (times[last] - times[0])
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
    for i in range(len(path) if sum_of_weights > 0 else 0):
        means[i] /= sum_of_weights
    return sum_of_weights / prior


@kernel
def _time_at(place_times: np.ndarray, place: float) -> float:
    """Return the time at a place, also between two; the places beyond the ends are the ends."""
    place = min(max(place, 0.0), len(place_times) - 1.0)
    y = min(int(place), max(len(place_times) - 2, 0))
    later = min(y + 1, len(place_times) - 1)
    return place_times[y] + (place_times[later] - place_times[y]) * (place - y)
