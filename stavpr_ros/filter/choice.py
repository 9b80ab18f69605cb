# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The path of a window: from the belief of the filter to one path with a probability.

A path c has the probability p_c of its places within ``BAND``, by the filter. The checks of the
path as a whole (:mod:`stavpr_ros.filter.checks`) multiply its odds by a factor f_c; where they
refute it, a path through the next most probable place is checked, too. With the rest r of the
probability on the map, and M = sum_c p_c + r,

    P(c) = f_c p_c / (sum_c f_c p_c + r + 1 - M).

In localization, :mod:`stavpr_ros.filter.evidence` makes the probability of the match from it.
"""

from collections.abc import Callable
import sys
from typing import NamedTuple

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.filter.checks import least_at_rest, odds_factor
from stavpr_ros.filter.columns import ColumnLayout
from stavpr_ros.filter.motion import ImageChange
from stavpr_ros.filter.paths import Belief, CLOSE, NEGLIGIBLE
from stavpr_ros.filter.protocol import Filter
from stavpr_ros.filter.refine import BAND, image_times, refined

CANDIDATES = 3  # paths that are checked, at most
REFUTED = 0.01  # factor of the odds by the checks, below which another path is checked, too
MIN_CANDIDATE = REFUTED  # probability of its place, at least: above refuted ones
AROUND = np.array([-BAND, -CLOSE, CLOSE + 1, BAND + 1])  # ends of slices around a place


class WindowImages(NamedTuple):
    """
    The images of a window, oldest first, and the image whose place is sought.

    :param numbers: of the filter's updates, (l,), int64; equal ones are of a camera at rest.
    :param weights: exponents alpha of their likelihoods, (l,).
    :param stamps: ns, (l,), int64; 0 = unknown.
    :param z: returns z of each image at columns (l, S), float32.
    :param n: columns that the filter was updated with.
    :param position: of the image whose place is sought.
    :param is_whole: these are all images of the window.
    :param lag_at_rest: images that the path is followed back, at least, where the camera has not
        moved since that image; None = it has.
    """

    numbers: np.ndarray
    weights: np.ndarray
    stamps: np.ndarray
    z: Callable[[np.ndarray], np.ndarray]
    n: int
    position: int
    is_whole: bool
    lag_at_rest: int | None


class ChosenPath(NamedTuple):
    """
    A path of the window, and the other places that the image may show.

    :param path: column of each image, (l,), int64.
    :param shares: probability of these places and close ones, given the path, (l,).
    :param probability: of the path by the filter; of the chosen one, of the place of the image at
        the position, after the checks.
    :param min_probability: below which it is no match: of a camera at rest.
    :param factor: of its odds, by the checks.
    :param score: mean of -z along the path.
    :param places: columns that the image may show, ascending, (m,), and probabilities: theirs,
        after the checks.
    """

    path: np.ndarray
    shares: np.ndarray
    probability: float
    min_probability: float
    factor: float
    score: float
    places: np.ndarray
    probabilities: np.ndarray


class PathChoice:
    """
    Chooses the path of a window.

    :param filter: after the newest image of the window.
    :param change: of the images, and of the map.
    :param layout: of the places.
    :param width: number of columns.
    """

    def __init__(
        self,
        filter: Filter,  # noqa: A002
        change: ImageChange,
        layout: ColumnLayout,
        width: int,
    ) -> None:
        self._filter, self._change, self._layout = filter, change, layout
        self.grow(width)

    def grow(self, width: int) -> None:
        """Make room for more columns, at equal times."""
        self._place_times = np.arange(width, dtype=np.float64)  # of each column
        self._passes = self._layout.pass_before(np.arange(width, dtype=np.int32))  # likewise

    def learn_times(self, stamps: np.ndarray) -> None:
        """
        Learn at what times the camera passed the places of the map.

        :param stamps: ns, (n,), int64; 0 = unknown.
        """
        passes = self._layout.of_passes(np.arange(len(stamps)))
        columns = self._layout.columns_of(np.arange(len(passes)))
        intervals = np.diff(stamps)[(np.diff(stamps) > 0) & (stamps[:-1] > 0)]
        usual = float(np.median(intervals)) if len(intervals) else 1.0
        between = np.append(np.diff(image_times(stamps, passes[: len(stamps)], usual)), 1.0)
        before, after = passes[:-1], passes[1:]
        steps = np.ones(len(self._place_times))
        steps[columns[1:]] = np.where(
            np.abs(after - before) == 1, between[np.minimum(before, after)], 1.0
        )
        self._place_times = steps.cumsum()

    def choose(self, belief: Belief, images: WindowImages) -> ChosenPath:
        """
        Return the most probable path after the checks, and its probability.

        :param belief: of the image at the position; it has at least one place.
        """
        places, probabilities, own, best = self._layout.merge_sessions(belief, images.n)
        candidates: list[ChosenPath] = []
        while len(candidates) < CANDIDATES:
            candidate = self._candidate(belief, places, probabilities, best, images)
            candidates.append(candidate)
            best = _check(places, probabilities, own, best, candidate.factor)
            if candidate.factor >= REFUTED or probabilities[best] < MIN_CANDIDATE:
                break
        weights = [each.probability * each.factor for each in candidates]
        chosen = candidates[weights.index(max(weights))]
        on_map = min(float(belief.weights.sum()), 1.0)
        unchecked = max(on_map - sum(each.probability for each in candidates), 0.0)
        total = max(unchecked + sum(weights) + 1 - on_map, sys.float_info.min)
        share = float(chosen.shares[images.position])
        of_path, least = max(weights) / total * share, chosen.min_probability * share
        return chosen._replace(probability=of_path, min_probability=least)

    def second_best(
        self, chosen: ChosenPath, n: int, place: int, radius: int
    ) -> tuple[int, float]:
        """Return the most probable column elsewhere, and its probability, 0 if none."""
        places, probabilities = chosen.places, chosen.probabilities
        near = self._layout.around(place, radius)
        second, excluded = _best_beyond(places, probabilities, near, n)
        now, faint = self._filter.most_probable(excluded)
        if second >= 0 and probabilities[second] >= faint * NEGLIGIBLE:
            return int(places[second]), float(probabilities[second])
        return now, faint * NEGLIGIBLE

    def _candidate(
        self, belief: Belief, places: np.ndarray, probabilities: np.ndarray, best: int,
        images: WindowImages,
    ) -> ChosenPath:  # fmt: skip
        """Return the path of the window through a place at the position, and its checks."""
        low, first, end, high = belief.places.searchsorted(places[best] + AROUND).tolist()
        # of the path: its places are certain within the band
        of_path = max(float(probabilities[best]), min(float(belief.weights[low:high].sum()), 1.0))
        state = belief.states[first + belief.weights[first:end].argmax()]
        mean, numbers = self._filter.mean_z(state), images.numbers
        path, columns = self._path(state, images)
        path, placed, z, masses, uneven, compared = refined(
            images.z(columns), path, images.weights * mean, numbers, images.stamps,
            self._place_times[: images.n], self._layout.first_column(path[-1]),
            self._change.equal, self._passes,
        )  # fmt: skip
        moved = int(numbers[-1] - numbers[0])
        speed = float(path[-1] - path[0]) / max(moved, 1)
        excess = self._change.excess(speed) if moved and images.is_whole else 0.0
        factor = odds_factor(uneven, excess)
        least = 0.0
        if images.lag_at_rest is not None:
            at_rest = z[numbers == numbers[-1]]
            least = least_at_rest(at_rest, mean, self._filter.settings.weight)
        score = -float(compared.sum() / len(compared)) if len(compared) else 0.0
        shares = masses.sum(axis=1)
        return ChosenPath(placed, shares, of_path, least, factor, score, places, probabilities)

    def _path(self, state: np.ndarray, images: WindowImages) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the column of each image, before the image at the position at one speed.

        :returns: of :func:`_extended`.
        """
        numbers = images.numbers
        lag = numbers[-1] - numbers[images.position]
        if images.lag_at_rest is not None:  # images before the standstill as well
            lag = max(lag, min(numbers[-1] - numbers[0], images.lag_at_rest))
        places, speed = self._filter.path(state, int(lag)), self._filter.speed(state)
        first = self._layout.first_column(places[0])
        path, columns = _extended(places, numbers, speed, first, images.n)
        return path, columns


# ------------------------------------------------ kernels


@kernel
def _extended(
    places: np.ndarray, numbers: np.ndarray, speed: float, first: int, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the column of each image, at one speed before the path has entered the map.

    :param places: of :meth:`Filter.path`; numbers, n: see :class:`WindowImages`.
    :param speed: of a path that entered with the newest image; first: least column.
    :returns: columns, (l,), int64, and those within ``BAND`` of each, below n, (l, S).
    """
    lag = np.count_nonzero(places >= 0) - 1
    slope = (places[0] - places[lag]) / lag if lag else speed
    path = np.empty(len(numbers), np.int64)
    near = np.empty((len(path), 2 * BAND + 1), np.int64)
    for i in range(len(path)):
        back = numbers[-1] - numbers[i]
        place = places[min(back, lag)] - int(np.rint(max(back - lag, 0) * slope))
        path[i] = max(place, first)
        for s in range(near.shape[1]):
            near[i, s] = min(max(path[i] + s - BAND, 0), n - 1)
    return path, near


@kernel
def _check(
    places: np.ndarray, probabilities: np.ndarray, own: np.ndarray, best: int, factor: float
) -> int:
    """Multiply the probabilities near a place by a factor; return the best of ``own`` then."""
    following = 0
    for i in range(len(places)):
        if abs(places[i] - places[best]) <= BAND:
            probabilities[i] *= factor
        if own[i] and not (own[following] and probabilities[following] >= probabilities[i]):
            following = i
    return following


@kernel
def _best_beyond(
    places: np.ndarray, probabilities: np.ndarray, near: np.ndarray, n: int
) -> tuple[int, np.ndarray]:
    """
    Return the most probable of places outside of slices, its index; -1 = none.

    :param places: ascending; near: slices, ascending, (m, 2).
    :returns: also all places, and the columns below n in the slices, ascending.
    """
    size = len(places)
    for low, end in near:
        size += end - low
    both, count, best, i = np.empty(size, np.int64), 0, -1, 0
    for part in range(len(near) + 1):
        low, end = (near[part, 0], near[part, 1]) if part < len(near) else (n, n)
        while i < len(places) and places[i] < low:
            if best < 0 or probabilities[i] > probabilities[best]:
                best = i
            both[count] = places[i]
            count, i = count + 1, i + 1
        while i < len(places) and places[i] < end:
            i += 1
        for column in range(max(low, 0), min(end, n)):
            both[count] = column
            count += 1
    return best, both[:count]
