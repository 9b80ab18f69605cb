# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How much images change from place to place of the map, and from image to image of the query.

The change of two images is 1 less the mean cosine similarity of their strips, each with the one in
the same place: 0 for equal images, about 1 for unrelated ones. How it grows with the number of
places in between is learned from the map, so that the query's changes show whether it moves faster
than a path on the map.
"""

from collections import deque
from collections.abc import Callable
import math

import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.compilation import kernel
from stavpr_ros.method.model import (
    CLOSE,
    DARK_PROBABILITY,
    LOOK_AHEAD,
    MAX_CHANGE,
    MAX_CREEP,
    MIN_CHANGE,
    MIN_LOCAL,
    OFFSET,
    STANDSTILL,
    STRETCH,
)
from stavpr_ros.prepare.blocks import change_weights, MAX_LAG

MIN_WEIGHT = 0.05  # weight of a place by its change, up to which the curve is not learned from it
COMPARED = 3  # images apart up to which the window is compared with its path
FURTHER = 20  # places beyond MAX_LAG that the curve is continued for
MIN_SIMILARITY = 0.01  # similarity of neighboring places below which it is noise
MIN_DISTINCT = 5  # places: fewer have no meaningful mean and deviation
MIN_SIMILARITY_RATIO = 0.1  # factor of the similarity by noise, below which images show no motion


class ImageChange:
    """
    Changes of a map from place to place, and of a query from image to image.

    ``curve`` is the mean change of places 0, 1, ... ``MAX_LAG`` apart while the camera moves, 1
    where none is known; ``standstill`` the change below which a camera is at rest.

    :param columns: columns of places that there is room for.
    :param length: images in the window of the query.
    """

    def __init__(self, columns: int, length: int) -> None:
        self._length = length
        self._sums, self._counts = np.zeros(MAX_LAG + 1), np.zeros(MAX_LAG + 1)
        self._from_before = np.ones(columns, np.float32)  # of each column from the one before
        self._update_curve()
        self.reset()

    def learn(
        self,
        changes: np.ndarray,
        firsts: np.ndarray | tuple[int, ...] = (0,),
        to_columns: Callable[[np.ndarray], np.ndarray] = np.asarray,
    ) -> None:
        """
        Learn from the changes of all places of a map.

        :param changes: of each place from the places 1 to L = ``MAX_LAG`` before, (L, n).
        :param firsts: first place of each session.
        :param to_columns: :meth:`.columns.ColumnLayout.changes_from_before`.
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
        from_before = changes[0].copy()
        from_before[list(firsts)] = 1
        self._from_before[:] = to_columns(from_before)
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
        if changes and not changes[0] < self.standstill:
            self._sums[1 : len(changes) + 1] += changes
            self._counts[1 : len(changes) + 1] += 1
            self._update_curve()

    def copy_statistics(self, learned: 'ImageChange', from_before: np.ndarray) -> None:
        """
        Use the statistics of a sample of these places' map.

        :param from_before: change of each column from the one before, (m,), float32.
        """
        self._sums, self._counts = learned._sums, learned._counts
        self._from_before = from_before
        self._update_curve()

    def grow(self, columns: int) -> None:
        """Make room for more places."""
        more = np.ones(columns - len(self._from_before), np.float32)
        self._from_before = np.append(self._from_before, more)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self._from_before = np.append(self._from_before[count:], np.ones(count, np.float32))

    def _update_curve(self) -> None:
        measured = self._counts > 0
        self.curve = np.where(measured, self._sums / np.maximum(self._counts, 1), 1)
        self.curve[0] = 0
        self.standstill = STANDSTILL * self.curve[1]
        # the similarity shrinks in one ratio further
        similarity = np.maximum(1 - self.curve, 0)
        ratio = min(similarity[-1] / similarity[-2], 1) if similarity[-2] > 0 else 0.0
        further = self.curve[-1] + similarity[-1] * (1 - ratio ** np.arange(1, FURTHER))
        decay = float(-np.log(np.clip(similarity[1], MIN_SIMILARITY, 1)))
        self._curve_with_tail = np.append(self.curve, further), decay

    def is_dark_stretch(self, by_place: np.ndarray) -> bool:
        """
        Whether equal images are expected where the camera is: places of the map are equal there.

        :param by_place: probability of each column, (n,).
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
        # the latest images that moved, newest first, and the changes of those of the window from
        # the images 1, 2, 3 before
        self._recent_strips: deque[np.ndarray] = deque(maxlen=COMPARED + 1)
        self._window_changes: deque[list[float]] = deque(maxlen=self._length)
        self._last: np.ndarray | None = None

    def next_query(self, strips: np.ndarray) -> float:
        """Return the change of the query's next image (W, d) from the one before, 1 at first."""
        change = 1.0 if self._last is None else change_between(strips, self._last)
        self._last = strips
        if not self.is_standstill(change):
            self._recent_strips.appendleft(strips)
            if len(self._recent_strips) > COMPARED:
                apart = [
                    change_between(strips, earlier) for earlier in list(self._recent_strips)[2:]
                ]
                self._window_changes.append([change, *apart])
        return change

    def recenter_query(self, strips: np.ndarray) -> None:
        """Take the query's last image (W, d) again: its mean has changed. None after a reset."""
        if self._last is not None:
            self._last = strips

    def is_standstill(self, change: float) -> bool:
        """Whether an image equals the one before up to noise: at rest, or in the dark."""
        return bool(change < self.standstill)

    def distinct(self, columns: slice | np.ndarray) -> np.ndarray:
        """Return which columns count, (n,), bool: of a standstill one; all if few would."""
        distinct = ~(self._from_before[columns] < self.standstill)
        has_few = np.count_nonzero(distinct) < MIN_DISTINCT
        return np.ones_like(distinct) if has_few else distinct

    def weight(self, change: float) -> float:
        """Return the weight of an image by its change: equal images add nothing."""
        relative = change / max(float(self.curve[1]), 1e-6)
        return min(MAX_CHANGE, max(MIN_CHANGE, relative))

    def excess(self, speed: float) -> float:
        """
        Return how much faster the window's images change than the map at a speed.

        The changes of images 2 and 3 apart are compared with those expected, as mean logarithm of
        their ratio, less the noise that the changes of neighboring images show: noise, and other
        light, reduce the similarity of all images by one factor.

        :param speed: of the path of the window, places per image, at least 0.
        """
        changes = np.array(self._window_changes).reshape(-1, COMPARED)
        return _excess(speed, changes, *self._curve_with_tail)

    def creep(self, first: int, last: int, images: int) -> float:
        """
        Return how much more the images of a path change than the map there, as a logarithm.

        A path creeps where the camera leaves the map and the places around look alike. Unlike
        :meth:`excess`, it compares each image with the one before alone, and the map with itself
        around the path.

        :param first: column at the start of the path; last: at its end.
        :param images: newest ones that are on it.
        :returns: 0 to ``MAX_CREEP``: noise is no motion; 0 as long as no change is known.
        """
        changes = [lags[0] for lags in self._window_changes][-images:]
        around = self._from_before[max(first - CLOSE, 0) : last + CLOSE + 1]
        if not changes or not (around < 1).any():
            return 0.0
        expected = expected_change((last - first) / max(images - 1, 1), *self._curve_with_tail)
        local = float(around[around < 1].mean())
        local = max(math.log((local + OFFSET) / (self.curve[1] + OFFSET)), MIN_LOCAL)
        change = sum(changes) / len(changes)
        creep = math.log((change + OFFSET) / (expected + OFFSET)) - local
        return min(max(creep, 0.0), MAX_CREEP)


# ------------------------------------------------ kernels


@kernel
def expected_change(places, curve, decay):  # type: ignore[no-untyped-def]
    """
    Return the change of images so many places apart, at least 0, by the curve of the map.

    The curve is known at whole places. Below one place, the similarity decays exponentially.
    """
    if places < 1:
        return -math.expm1(-decay * places)
    whole = min(int(places), len(curve) - 2)
    low, high = curve[whole], curve[whole + 1]
    return (high - low) * min(places - whole, 1.0) + low


@kernel
def _excess(speed, changes, curve, decay):  # type: ignore[no-untyped-def]
    """Return the excess of changes, (m, 3), of images 1, 2, 3 apart; 0 of none."""
    if not len(changes):
        return 0.0
    means, expected = np.zeros(COMPARED), np.empty(COMPARED)
    for i in range(COMPARED):
        for row in range(len(changes)):
            means[i] += changes[row, i]
        means[i] = min(means[i] / len(changes), 1.0)
        expected[i] = min(expected_change(speed * (i + 1), curve, decay), 1.0)
    noise = (1 - means[0]) / max(1 - expected[0], MIN_SIMILARITY)
    noise, total = min(max(noise, MIN_SIMILARITY_RATIO), 1.0), 0.0
    for i in range(1, COMPARED):
        change = 1 - min((1 - means[i]) / noise, 1.0)
        total += math.log((change + OFFSET) / (expected[i] + OFFSET))
    return total / (COMPARED - 1)
