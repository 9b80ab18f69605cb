# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window of mode robust: a place filter, read at the middle of the window."""

from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
import sys
from typing import Any, TYPE_CHECKING

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.filter.checks import least_at_rest, NEWEST, odds_factor, PathCandidate, unevenness
from stavpr_ros.filter.model import FilterSettings
from stavpr_ros.filter.motion import ImageChange
from stavpr_ros.filter.paths import (
    ascending,
    BAND,
    Belief,
    CLOSE,
    NEGLIGIBLE,
    NO_PLACES,
    OFFSETS,
    refine,
)
from stavpr_ros.filter.place_filter import PlaceFilter
from stavpr_ros.filter.place_means import PlaceMeans
from stavpr_ros.recognition.match import WindowMatch, WindowSequences
from stavpr_ros.recognition.window import (
    ColumnLayout,
    image_times,
    QueryWindow,
    SequenceBuffer,
)

if TYPE_CHECKING:
    from stavpr_ros.filter.cuda_filter import CudaPlaceFilter

CALIBRATION = 2.0  # factor of the odds of being on the map, which the filter declares too low
CANDIDATES = 3  # paths that are checked, at most
REFUTED = 0.01  # factor of the odds by the checks, below which another path is checked, too
LEAST_CANDIDATE = REFUTED  # probability of its place, at least: above that of refuted ones
FEWEST = 2  # images of a match
ON_MAP = 0.5  # probability above which the newest images can have a match
NEAR_LEVEL = -2.3  # mean z of right places, at most, as evidence between near places
AT_REST = 0.05  # relative probability of a camera at rest, below which it moves


@dataclass
class WindowImage:
    """
    An image of the window.

    :param change: from the image before.
    :param weight: exponent alpha of its likelihood.
    :param number: of the filter's last update; images of a camera at rest share one.
    :param is_matched: it had a match as the middle image.
    """

    change: float
    weight: float
    number: int
    is_matched: bool = False


class FilterWindow(QueryWindow):
    """
    A :class:`PlaceFilter` updated image by image, and the window that its answers are of.

    :param sequence: l and k.
    :param places: number of places n.
    :param settings: model of the filter.
    :param layout: of the places.
    :param normalizes, around: see :class:`stavpr_ros.recognition.window.QueryWindow`.
    :param to_oldest: for loop closure: states are followed back to the oldest image of the
        window, which :meth:`match_oldest` requires, instead of the middle one, and the mean z of
        each place is subtracted (:mod:`stavpr_ros.filter.place_means`).

    ``change`` compares images, ``filter`` contains the states.
    """

    buffer_class: type[SequenceBuffer] = SequenceBuffer
    filter_class: 'type[PlaceFilter | CudaPlaceFilter]' = PlaceFilter

    def __init__(
        self,
        sequence: SequenceSettings,
        places: int,
        settings: FilterSettings | None = None,
        layout: ColumnLayout | None = None,
        normalizes: bool = False,
        around: int = 0,
        to_oldest: bool = False,
    ) -> None:
        layout, settings = layout or ColumnLayout(), settings or FilterSettings()
        length, width = sequence.length, layout.width(places)
        buffer = self.buffer_class(length, width, sequence.k, copies=1)
        super().__init__(buffer, layout, normalizes, around)
        self._middle, self._to_oldest = (length - 1) // 2, to_oldest
        self._calibration = 1.0 if to_oldest else CALIBRATION  # loop closure is not too modest
        lag = length - 1 - (0 if to_oldest else self._middle)
        self.filter = self.filter_class(width, lag, settings, layout.gaps)
        self.change = ImageChange(places, settings, length)
        self._speeds, self._levels = settings.speeds, settings.levels
        self._weight = settings.weight
        self._images: deque[WindowImage] = deque(maxlen=length)
        self._at_rest: WindowMatch | None = None  # match of a camera at rest
        self._means = PlaceMeans()
        self._entered = 0  # number of the image with which the latest path came to the map
        self._place_times = np.arange(width, dtype=np.float64)  # of each column

    @property
    def changes(self) -> tuple[float, ...]:
        """Change of each image from the one before, oldest first."""
        return tuple(image.change for image in self._images)

    @property
    def is_standstill(self) -> bool:
        """Whether the newest image equals the one before, up to noise."""
        return self.change.is_standstill(self._images[-1].change)

    def learn_times(self, stamps: np.ndarray) -> None:
        """
        Learn at what times the camera passed the places of the map.

        :param stamps: ns, (n,), int64; 0 = unknown.
        """
        columns = self.layout.columns_of(np.arange(len(stamps)))
        steps = np.ones(len(self._place_times))
        steps[columns[1:]] = np.diff(image_times(stamps, columns))
        self._place_times = steps.cumsum()

    def reset(self) -> None:
        """Drop all images."""
        super().reset()
        self.filter.reset()
        self.change.reset()
        self._images.clear()
        self._at_rest, self._entered = None, 0

    def grow(self, places: int) -> None:
        """Make room for more places."""
        super().grow(places)
        self._place_times = np.arange(places, dtype=np.float64)
        assert isinstance(self.filter, PlaceFilter)
        self.filter.grow(places)
        self.change.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        super().evict(count)
        assert isinstance(self.filter, PlaceFilter)
        self.filter.evict(count)
        self.change.evict(count)
        self._means.evict(count)

    def push(self, row: Any, strips: np.ndarray, stamp: int) -> None:
        """See :meth:`QueryWindow.push`."""
        row, change = self._as_columns(row), self.change.next_query(strips)
        if self._to_oldest:
            row = self._means.subtracted(row, self.change.is_standstill(change))
        self.buffer.push(row, stamp)
        self._update(row, change)

    def add(self, row: np.ndarray, stamp: int, change: float) -> None:
        """
        Add the newest image by its normalized distances, and drop the oldest.

        :param row: to the places, (n,), float32.
        :param change: from the image before.
        """
        row = self.layout.spread(row)
        self.buffer.push(row, stamp)
        self._update(row, change)

    def _counted(self, n: int) -> np.ndarray:
        return self.change.distinct(n)

    def _update(self, z: Any, change: float) -> None:
        """
        Advance the filter by an image.

        An image of a camera at rest adds nothing. Where the map's own images are equal, in a dark
        tunnel, the camera may move: the filter goes on at its speed, without evidence.

        :param z: z-normalized distances to the columns, (m,), float32.
        """
        weight, ones = 0.0, np.ones(len(self._speeds))
        if not self.filter.count:  # the change of the first image is unknown
            weight = self.change.weight(change)
            self.filter.update(z, weight, ones, ones)
        elif not self.change.is_standstill(change):
            weight = self.change.weight(change)
            speeds = self.change.speed_weights(change)
            likelihoods = self.change.speed_likelihoods(change)
            moves = speeds[0] < AT_REST * speeds.max()
            # places where the map's camera was at rest are not near to a moving one
            at_rest = self.layout.columns_of(self.change.at_rest()) if moves else NO_PLACES
            not_near = at_rest[at_rest < len(z)]
            self.filter.update(z, weight, speeds, likelihoods, not_near)
        else:
            by_place = self.layout.gathered(self.filter.places_of_states()[: len(z)])
            if self.change.is_dark_stretch(by_place):
                self.filter.update(z, 0.0, ones, ones)
        self._images.append(WindowImage(change, weight, self.filter.count - 1))
        if self._at_rest is not None:
            self._at_rest = _moved_on(self._at_rest) if self._is_resting(self._middle) else None

    def _match(self, nms_radius: int) -> WindowMatch:
        """
        Return the match of the middle image; that of a camera at rest, for as long as it rests.

        A window of equal images would show neither how even the path to them was nor how fast.
        """
        middle = (len(self._images) - 1) // 2
        found = self._at_rest or self._match_image(middle, nms_radius)
        self._at_rest = found if self._is_resting(middle) else None
        return found

    def _is_resting(self, position: int) -> bool:
        """Whether the camera has not moved since an image; of a full window in localization."""
        is_equal = self._images[position].number == self._images[-1].number
        return is_equal and self.buffer.full and not self._to_oldest

    def match_newest(self, nms_radius: int) -> tuple[WindowMatch, int]:
        """Return the match of the newest images: :meth:`QueryWindow.match_newest`."""
        count = 0 if self._to_oldest else self._since_entering()
        if count < FEWEST:
            return WindowMatch(), 0
        images = self._images
        self._images = deque(islice(images, len(images) - count, None))
        found = self.layout.in_places(self._match_image((count - 1) // 2, nms_radius))
        self._images = images
        return found, count

    def _since_entering(self) -> int:
        """
        Return how many of the newest images to match, if the whole window shows nothing.

        Those since the most probable path has come to the map, at most as many as states are
        followed back; all of a window that is not full.

        :returns: 0 if the path has been on the map for longer than the window.
        """
        belief = self.filter.belief(self.buffer.known, 0)
        if not belief.weights.sum() > ON_MAP:
            return 0
        if not self.buffer.full:
            return len(self._images)
        numbers = np.array([image.number for image in self._images])
        lag = min(len(self._images) - 1 - self._middle, int(numbers[-1]))
        path = self.filter.path(belief.states[np.argmax(belief.weights)], lag)
        known = int(np.count_nonzero(path >= 0))
        if known <= lag:
            self._entered = int(numbers[-1]) - known + 1
        if self._entered < numbers[0]:
            return 0
        return int(np.count_nonzero(numbers >= max(self._entered, numbers[-1] - lag)))

    def match_oldest(self, nms_radius: int, is_matched: bool) -> WindowMatch:
        """See :meth:`QueryWindow.match_oldest`."""
        self._images[self._middle].is_matched = is_matched
        if self._images[0].is_matched or not is_matched:
            return WindowMatch()
        return self._match_image(0, nms_radius)

    def _match_image(self, position: int, nms_radius: int) -> WindowMatch:
        """
        Return the match of an image by all images of the window.

        :param position: of the image in the window, not before the lag of the filter.
        """
        n, first = self.buffer.known, self.buffer.first
        if not n:
            return WindowMatch()
        belief = self.filter.belief(n, self._images[-1].number - self._images[position].number)
        if not len(belief.places):
            return self._off_map(n, first)
        places, probabilities, best = self.layout.shared(belief, n, CLOSE)
        chosen, of_path = self._chosen(belief, places, probabilities, best, position)
        refined, shares = chosen.path, chosen.shares
        probability, middle = of_path * float(shares[position]), int(refined[position])
        second, found = self._second_best(n, places, probabilities, middle, nms_radius)
        path = _numbered(refined + first)
        match = SequenceMatch(
            first=int(path[0, 1]),
            last=int(path[-1, 1]),
            middle=middle + first,
            distance=1 - probability,
            second_best_index=second + first if found > 0 else -1,
            second_best_distance=1 - found if found > 0 else float('nan'),
        )
        sequences = partial(self._sequences, n, first, places, probabilities)
        least = chosen.least * float(shares[position])
        return WindowMatch(match, path, sequences, probability, shares, least)

    def _chosen(
        self,
        belief: Belief,
        places: np.ndarray,
        probabilities: np.ndarray,
        best: int,
        position: int,
    ) -> tuple[PathCandidate, float]:
        """
        Return the most probable path after the checks, and its probability, calibrated.

        Where the checks refute a path, one through the next most probable place is checked, too.

        :param places, probabilities: of the image at ``position``, (m,); probabilities near a
            path that was checked are written: multiplied by its factor.
        :param best: index of the most probable of them.
        """
        found: list[PathCandidate] = []
        while len(found) < CANDIDATES:
            found.append(self._candidate(belief, places[best], probabilities[best], position))
            probabilities[np.abs(places - places[best]) <= BAND] *= found[-1].factor
            best = int(np.argmax(probabilities))
            if found[-1].factor >= REFUTED or probabilities[best] < LEAST_CANDIDATE:
                break
        chosen = max(found, key=lambda candidate: candidate.weight)
        on_map = min(float(belief.weights.sum()), 1.0)
        unchecked = max(on_map - sum(candidate.probability for candidate in found), 0.0)
        weight, every = chosen.weight, unchecked + sum(candidate.weight for candidate in found)
        odds_sum = every + (1 - on_map) / self._calibration
        return chosen, weight / max(odds_sum, sys.float_info.min)

    def _candidate(
        self, belief: Belief, place: int, probability: float, position: int
    ) -> PathCandidate:
        """Return the path of the window through a place at an image, and its checks."""
        apart = np.abs(belief.places - place)
        near = apart <= CLOSE
        # of the path: it is known within the band
        of_path = max(float(probability), min(float(belief.weights[apart <= BAND].sum()), 1.0))
        state = belief.states[near][np.argmax(belief.weights[near])]
        numbers = np.array([image.number for image in self._images])
        path = self._path(state, numbers, position)
        path, shares, placed, z = self._refined(path, numbers, state[0])
        moved = int(numbers[-1] - numbers[0])
        is_whole = len(self._images) == len(self.buffer)
        speed = float(path[-1] - path[0]) / max(moved, 1)
        excess = self.change.excess(speed) if moved and is_whole else 0.0
        factor = odds_factor(unevenness(path, z, 1.0 if is_whole else NEWEST), excess)
        least = 0.0
        if self._is_resting(position):
            at_rest = z[numbers == numbers[-1]]
            least = least_at_rest(at_rest, self._levels[state[0]], self._weight)
        return PathCandidate(placed, shares, of_path, factor, least)

    def _refined(
        self, path: np.ndarray, numbers: np.ndarray, level: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """
        Return the places near a path that explain the images of the window best.

        Bad conditions bring the right place nearer to all others, less to those around it: places
        are estimated with the evidence of usual conditions. The path is checked where the evidence
        of the filter has its mean: more would make paths through look-alike places more even.

        :param path: place of each image, ascending, (l,).
        :param numbers: of the images, (l,): equal ones are of a camera at rest.
        :param level: index of the mean z-normalized distance of right places.
        :returns: places that are checked, (l,), probability of those close to the estimated
            places, (l,), these, (l,), and z of each image at the place that is checked, (l,).
        """
        n = self.buffer.known
        places = path[:, None] + OFFSETS
        inside = np.minimum(np.maximum(places, 0), n - 1)
        mean = self._levels[level]
        exponents = np.array([image.weight for image in self._images]) * mean
        z = self.buffer.at(inside, len(inside))
        of_images = image_times(np.array(self.buffer.stamps[-len(path) :]), numbers)
        times = of_images, self._place_times[:n]
        masses, means = refine(z, path, exponents, numbers, *times, min(mean, NEAR_LEVEL) / mean)
        ends = self.layout.first_column(path[-1]), n - 1
        checked, placed = ascending(path, means[0], *ends), ascending(path, means[1], *ends)
        close = np.abs(places - placed[:, None]) <= CLOSE
        first, last = self.layout.positions_of(inside[[0, -1], [0, -1]]).tolist()
        stretches = self.change.stretches(first, last + 1)
        if stretches[-1] - stretches[0] < last - first:  # equal places are as one
            own, others = map(self.layout.positions_of, (inside, placed[:, None]))
            close |= stretches[own - first] == stretches[others - first]
        offsets = np.minimum(np.maximum(checked - path, -BAND), BAND) + BAND
        shares = (masses * close).sum(axis=1)
        return checked, shares, placed, z[np.arange(len(path)), offsets]

    def _second_best(
        self, n: int, places: np.ndarray, probabilities: np.ndarray, middle: int, radius: int
    ) -> tuple[int, float]:
        """Return the most probable place beyond a radius, and its probability, 0 if none."""
        around = np.arange(max(0, middle - radius), min(n, middle + radius + 1))
        now, faint = self.filter.most_probable(np.sort(np.append(around, places)))
        faint *= NEGLIGIBLE
        apart = np.abs(places - middle) > radius
        if apart.any():
            second = int(np.argmax(np.where(apart, probabilities, 0)))
            if probabilities[second] >= faint:
                return int(places[second]), float(probabilities[second])
        return now, faint

    def _sequences(
        self, n: int, first: int, places: np.ndarray, probabilities: np.ndarray
    ) -> WindowSequences:
        """Return all places; improbable ones have a share of their probability now."""
        every = self.filter.places_of_states()[:n] * np.float64(NEGLIGIBLE)
        every[places] = probabilities
        costs = np.where(every > 0, 1 - every, np.inf)
        return WindowSequences(costs, np.arange(first, first + n), every)

    def _off_map(self, n: int, first: int) -> WindowMatch:
        """Return the place that is most probable now, with the probability 0."""
        place = self.filter.most_probable(NO_PLACES)[0] + first
        match = SequenceMatch(place, place, place, 1.0, -1, float('nan'))
        sequences = partial(self._sequences, n, first, NO_PLACES, np.empty(0))
        return WindowMatch(match, _numbered(np.full(len(self._images), place)), sequences, 0.0)

    def _path(self, state: np.ndarray, numbers: np.ndarray, position: int) -> np.ndarray:
        """Return the place of each image, (l,); before the one at a position at one speed."""
        back = numbers[-1] - numbers
        lag = int(back[position])
        if self._is_resting(position):  # images before the standstill as well
            lag = max(lag, int(min(back[0], len(numbers) - 1 - self._middle)))
        places = self.filter.path(state, lag)
        lag = int(np.count_nonzero(places >= 0)) - 1  # since the path has entered the map
        slope = (places[0] - places[lag]) / lag if lag else self._speeds[state[3]]
        earlier = np.maximum(back - lag, 0) * slope
        path = places[np.minimum(back, lag)].astype(np.int64) - np.rint(earlier).astype(np.int64)
        return np.maximum(path, self.layout.first_column(places[0]))


def _numbered(places: np.ndarray) -> np.ndarray:
    """Return the place of each image as a path: position in the window and place, (l, 2)."""
    path = np.empty((len(places), 2), np.int32)
    path[:, 0], path[:, 1] = np.arange(len(places)), places
    return path


def _moved_on(found: WindowMatch) -> WindowMatch:
    """Return the match of a window after one more image of a camera at rest."""
    if found.nearest is None:
        return found
    path, shares = found.path.copy(), np.append(found.shares[1:], found.shares[-1:])
    path[:-1, 1] = found.path[1:, 1]
    nearest = replace(found.nearest, first=int(path[0, 1]))
    return replace(found, nearest=nearest, path=path, shares=shares)
