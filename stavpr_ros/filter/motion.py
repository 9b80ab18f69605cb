# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How much images change from place to place of the map, and from image to image of the query.

The change of two images is 1 less the mean cosine similarity of their strips, each with the one in
the same place: 0 for equal images, about 1 for unrelated ones. How it grows with the number of
places in between is learned from the map, so that the query's changes show how fast it moves.
"""

from collections import deque
import math

import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.compilation import kernel
from stavpr_ros.filter.model import FilterSettings

MAX_LAG = 5  # places apart up to which the map's changes are learned
MIN_WEIGHT = 0.05  # weight of a place by its change, up to which the curve is not learned from it
LOOK_AHEAD = 8  # places within which an unlit stretch may begin
STRETCH = 4  # places in a row, at least, equal each to the one before: an unlit stretch
DARK_PROBABILITY = 0.3  # probability of such places above which equal images are no standstill
SPREAD, SCALE = 0.25, 0.4  # deviations of the logarithm: of each change, of all in other light
NOISE = 0.15  # deviation of the change by noise, common to all
MIN_LOG_LIKELIHOOD = -8.0  # logarithm of the least likelihood of a speed, without its exponent
COMPARED = 1, 2, 3  # images apart that the window is compared with its path at
SMOOTHED = 5  # latest changes of the query whose mean predicts the speed
OFFSET = 0.02  # added to changes before the logarithm: noise between equal views
MIN_SPEED_WEIGHT = 1e-3  # least relative probability of a speed
MIN_SIMILARITY = 0.01  # similarity of neighboring places below which it is noise
MIN_DISTINCT = 5  # places: fewer have no meaningful mean and deviation
LARGE_CHANGE = 0.97  # quantile of changes from place to place
REST, SLOW = 0.02, 0.1  # shares of it: of a camera at rest at most, and of a slow one
MIN_SIMILARITY_RATIO = 0.1  # factor of the similarity by noise, below which images show no motion


class ImageChange:
    """
    Changes of a map from place to place, and of a query from image to image.

    ``curve`` is the mean change of places 0, 1, ... ``MAX_LAG`` apart while the camera moves, 1
    where none is known; ``standstill`` the change below which a camera is at rest; ``equal`` which
    places equal the one before up to noise.

    :param places: places that there is room for.
    :param length: images in the window of the query.
    """

    def __init__(self, places: int, settings: FilterSettings, length: int) -> None:
        self._settings, self._length = settings, length
        self._at_rest: np.ndarray | None = None  # kept, as these that count, until the map changes
        self._distinct: np.ndarray | None = None
        self._sums, self._counts = np.zeros(MAX_LAG + 1), np.zeros(MAX_LAG + 1)
        self._from_before = np.ones(places, np.float32)  # change of each place from the one before
        self._update_curve()
        self.reset()

    def learn(self, changes: np.ndarray, firsts: np.ndarray | tuple[int, ...] = (0,)) -> None:
        """
        Learn from the changes of all places of a map.

        :param changes: of each place from the places 1 to L = ``MAX_LAG`` before, (L, n).
        :param firsts: first place of each session.
        """
        n = changes.shape[1]
        if not n:
            return
        steps = change_weights(changes[0]) > MIN_WEIGHT
        steps[list(firsts)] = False
        moving = np.ones(n, bool)  # all steps from the place so far before
        for apart in range(1, min(MAX_LAG, n - 1) + 1):
            moving[apart - 1 :] &= steps[: n - apart + 1]
            moving[: apart - 1] = False
            self._sums[apart] = changes[apart - 1, moving].sum(dtype=np.float64)
            self._counts[apart] = np.count_nonzero(moving)
        self._from_before[1:] = changes[0, 1:]
        self._from_before[list(firsts)] = 1
        self._update_curve()

    def learn_newest(self, latest: np.ndarray, n: int) -> None:
        """
        Learn from the newest place of a route.

        :param latest: strips of the newest places, oldest first, (W, m, d); ``MAX_LAG`` + 1 of
            them if there are so many.
        :param n: places of the route.
        """
        last = latest.shape[1] - 1
        changes = [
            change_between(latest[:, last], latest[:, last - apart])
            for apart in range(1, min(MAX_LAG, last) + 1)
        ]
        self._from_before[n - 1] = changes[0] if changes else 1
        self.equal[n - 1] = self._from_before[n - 1] < self.standstill
        self._at_rest = self._distinct = None
        if changes and not changes[0] < self.standstill:
            self._sums[1 : len(changes) + 1] += changes
            self._counts[1 : len(changes) + 1] += 1
            self._update_curve()

    def copy_statistics(self, learned: 'ImageChange', from_before: np.ndarray) -> None:
        """
        Use the statistics of a sample of these places' map.

        :param from_before: change of each place from the one before, (n,), float32.
        """
        self._sums, self._counts = learned._sums, learned._counts
        self._from_before = from_before
        self._update_curve()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        more = np.ones(places - len(self._from_before), np.float32)
        self._from_before = np.append(self._from_before, more)
        self._find_equal()

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self._from_before = np.append(self._from_before[count:], np.ones(count, np.float32))
        self._find_equal()

    def _update_curve(self) -> None:
        measured = self._counts > 0
        self.curve = np.where(measured, self._sums / np.maximum(self._counts, 1), 1)
        self.curve[0] = 0
        self.standstill = self._settings.standstill * self.curve[1]
        self._find_equal()
        speeds = np.array(self._settings.speeds)
        similarity = np.maximum(
            1 - self.curve, 0
        )  # of the similarity: it shrinks in one ratio further
        ratio = min(similarity[-1] / similarity[-2], 1) if similarity[-2] > 0 else 0.0
        beyond = np.arange(1, int(np.ceil(MAX_LAG * speeds.max())) - MAX_LAG + 1)
        further = self.curve[-1] + similarity[-1] * (1 - ratio**beyond)
        decay = float(-np.log(np.clip(similarity[1], MIN_SIMILARITY, 1)))
        self._extended = np.append(self.curve, further), decay
        places = np.outer(speeds, range(1, MAX_LAG + 1)).tolist()
        changes = np.array(
            [[self.expected_change(each) + OFFSET for each in row] for row in places]
        )
        covariances = SPREAD**2 * np.eye(MAX_LAG) + SCALE**2
        covariances = covariances + NOISE**2 / (changes[:, :, None] * changes[:, None])
        # by speed, and images apart
        self._expected, self._precisions = np.log(changes), np.linalg.inv(covariances)

    def expected_change(self, places: float) -> float:
        """
        Return the change of images so many places apart, by the curve of the map.

        The curve is known at whole places. Below one place, the similarity decays exponentially.

        :param places: at least 0.
        """
        return _expected_change(float(places), *self._extended)

    def _find_equal(self) -> None:
        self.equal = self._from_before < self.standstill
        self._at_rest = self._distinct = None

    def is_dark_stretch(self, by_place: np.ndarray) -> bool:
        """
        Whether equal images are expected where the camera is: places of the map are equal there.

        :param by_place: probability of each place, (n,).
        """
        n = len(by_place)
        equal = self._from_before[:n] < 2 * self.standstill
        for _ in range(STRETCH - 1):  # equal places before, too
            equal[1:] &= equal[:-1].copy()
        ahead = np.zeros(n, bool)
        for places in range(min(LOOK_AHEAD, n)):
            ahead[: n - places] |= equal[places:]
        return bool(by_place[ahead].sum() > DARK_PROBABILITY * by_place.sum())

    def reset(self) -> None:
        """Forget the query."""
        self._last: np.ndarray | None = None
        self._latest: deque[float] = deque(maxlen=SMOOTHED)
        # the latest images with motion, image i in slot i modulo their number, and how many came
        self._moving, self._moved = np.empty((0, 0, 0), np.float32), 0
        # changes of the images 1, 2, ... apart: the latest ones, and those of the window, as last
        # rows; and their number since the reset
        self._by_apart, self._compared = np.zeros((SMOOTHED, MAX_LAG)), 0
        self._of_window = np.zeros((self._length, len(COMPARED)))

    def next_query(self, strips: np.ndarray) -> float:
        """Return the change of the query's next image (W, d) from the one before, 1 at first."""
        change = 1.0 if self._last is None else change_between(strips, self._last)
        self._last = strips
        if not self.is_standstill(change):
            if not self._moved:
                self._moving = np.empty((MAX_LAG + 1, *strips.shape), np.float32)
            self._moving[self._moved % len(self._moving)] = strips
            self._moved += 1
        return change

    def recenter_query(self, strips: np.ndarray) -> None:
        """Take the query's last image (W, d) again: its mean has changed. None after a reset."""
        if self._last is not None:
            self._last = strips

    def is_standstill(self, change: float) -> bool:
        """Whether an image equals the one before up to noise: at rest, or in the dark."""
        return bool(change < self.standstill)

    def distinct(self, n: int) -> np.ndarray:
        """Return which of n places count, (n,), bool: of a standstill one; all if few would."""
        if self._distinct is None or len(self._distinct) != n:
            distinct = ~self.equal[:n]
            has_few = np.count_nonzero(distinct) < MIN_DISTINCT
            self._distinct = np.ones(n, bool) if has_few else distinct
        return self._distinct

    def at_rest(self) -> np.ndarray:
        """Return the places where the map's camera was at rest, ascending, (m,)."""
        if self._at_rest is None:
            at_rest = self.equal.copy()
            at_rest[:-1] |= self.equal[1:]
            self._at_rest = np.flatnonzero(at_rest)
        return self._at_rest

    def weight(self, change: float) -> float:
        """Return the exponent alpha of the image's likelihood."""
        s = self._settings
        relative = change / max(float(self.curve[1]), 1e-6)
        return s.weight * min(s.most_change, max(s.least_change, relative))

    def excess(self, speed: float) -> float:
        """
        Return how much faster the window's images change than the map at a speed.

        The changes of images 2 and 3 apart are compared with those expected, as mean logarithm of
        their ratio, less the noise that the changes of neighboring images show: noise, and other
        light, reduce the similarity of all images by one factor.

        :param speed: of the path of the window, places per image, at least 0.
        """
        count = min(self._compared, self._length)
        return _excess(speed, self._of_window[self._length - count :], *self._extended)

    def speed_weights(self, change: float) -> np.ndarray:
        """Return the relative probability of each speed after another change, (V,)."""
        self._latest.append(change)
        mean = sum(self._latest) / len(self._latest)
        return _speed_weights(mean, self._expected, self._settings.change_deviation)

    def speed_likelihoods(self, change: float) -> np.ndarray:
        """
        Return the likelihood of each speed after another change, of the most likely one 1, (V,).

        The likelihood of the state off the map is 1. Compared are the logarithms of the changes of
        images 1 to ``MAX_LAG`` apart, each the mean of the latest ones, with those on the curve of
        the map. Light makes all of them smaller or larger, and noise larger: both count as
        Gaussian errors that the changes have in common.
        """
        if self._moved <= MAX_LAG or not self._settings.speed_weight:
            return np.ones(len(self._expected))
        self._compared += 1
        rows = self._by_apart[SMOOTHED - min(self._compared, SMOOTHED) :]
        return _speed_likelihoods(
            self._moving, self._moved, change, self._by_apart, self._of_window, len(rows),
            self._expected, self._precisions, self._settings.speed_weight,
        )  # fmt: skip


def change_weights(changes: np.ndarray) -> np.ndarray:
    """
    Return how much each place counts, (n,): less where the camera was at rest or slow.

    Nothing below a change from the place before of ``REST``, fully above ``SLOW`` of the large
    changes, and in proportion between; the largest, from one drive to another, do not matter.

    :param changes: of each place from the one before, (n,); the first does not matter.
    """
    large = float(np.quantile(changes, LARGE_CHANGE, method='lower')) if len(changes) else 0.0
    if not large:
        return np.ones(len(changes))
    weights: np.ndarray = np.clip((changes / large - REST) / (SLOW - REST), 0, 1)
    weights[:1] = 1
    return weights


# ------------------------------------------------ kernels


@kernel
def _expected_change(places, curve, decay):
    """Return the change of :meth:`ImageChange.expected_change`."""
    if places < 1:
        return -math.expm1(-decay * places)
    whole = min(int(places), len(curve) - 2)
    low, high = curve[whole], curve[whole + 1]
    return (high - low) * min(places - whole, 1.0) + low


@kernel
def _excess(speed, changes, curve, decay):
    """Return the excess of changes, (m, 3), of images 1, 2, 3 apart; 0 of none."""
    if not len(changes):
        return 0.0
    means, expected = np.zeros(len(COMPARED)), np.empty(len(COMPARED))
    for i in range(len(COMPARED)):
        for row in range(len(changes)):
            means[i] += changes[row, i]
        means[i] = min(means[i] / len(changes), 1.0)
        expected[i] = min(_expected_change(speed * COMPARED[i], curve, decay), 1.0)
    noise = (1 - means[0]) / max(1 - expected[0], MIN_SIMILARITY)
    noise, total = min(max(noise, MIN_SIMILARITY_RATIO), 1.0), 0.0
    for i in range(1, len(COMPARED)):
        change = 1 - min((1 - means[i]) / noise, 1.0)
        total += math.log((change + OFFSET) / (expected[i] + OFFSET))
    return total / (len(COMPARED) - 1)


@kernel
def _speed_weights(change, expected, deviation):
    """Return the relative probability of each speed after a mean change, (V,)."""
    weights = np.empty(len(expected))
    for v in range(len(expected)):
        off = (np.log(change + OFFSET) - expected[v, 0]) / deviation
        weights[v] = np.exp(-0.5 * off**2) + MIN_SPEED_WEIGHT
    return weights


@kernel
def _speed_likelihoods(
    moving, moved, change, by_apart, of_window, count, expected, precisions, exponent
):
    """
    Return the likelihood of each speed, (V,), and add the changes of the newest image.

    :param moving: latest images, (MAX_LAG + 1, W, d), of which so many have moved.
    :param change: of the newest image from the one before.
    :param by_apart, of_window: changes by images apart, (5, MAX_LAG) and (l, 3); updated.
    :param count: rows of ``by_apart`` that are known, the last ones.
    :param expected, precisions: logarithm of the changes at each speed, (V, MAX_LAG), and their
        inverse covariance, (V, MAX_LAG, MAX_LAG).
    """
    newest, off = moving[(moved - 1) % len(moving)], np.zeros(MAX_LAG)
    for rows in (by_apart, of_window):
        for i in range(len(rows) - 1):
            for apart in range(rows.shape[1]):
                rows[i, apart] = rows[i + 1, apart]
    by_apart[-1, 0] = change
    for apart in range(2, MAX_LAG + 1):
        by_apart[-1, apart - 1] = change_between(newest, moving[(moved - 1 - apart) % len(moving)])
    for apart in range(len(COMPARED)):
        of_window[-1, apart] = by_apart[-1, apart]
    for apart in range(MAX_LAG):
        for row in range(len(by_apart) - count, len(by_apart)):
            off[apart] += by_apart[row, apart]
        off[apart] = np.log(off[apart] / count + OFFSET)
    logs, largest = np.zeros(len(expected)), -np.inf
    for v in range(len(expected)):
        for i in range(MAX_LAG):
            for j in range(MAX_LAG):
                product = (off[i] - expected[v, i]) * precisions[v, i, j]
                logs[v] -= 0.5 * product * (off[j] - expected[v, j])
        largest = max(largest, logs[v])
    for v in range(len(expected)):
        logs[v] = np.exp(exponent * max(logs[v] - largest, MIN_LOG_LIKELIHOOD))
    return logs
