# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How much an image differs from the one before it, and how much places of the map differ.

The change of two images is 1 less the mean cosine similarity of their strips, each with the one in
the same place: 0 for equal images, about 1 for unrelated ones. How it grows with the number of
places in between is learned from the map, so that the query's changes show how fast it moves.
"""

from collections import deque

import numba as nb
import numpy as np
from stavpr_ros.compilation import parallel_kernel
from stavpr_ros.recognition.place_filter import FilterSettings

APART = 5  # places apart up to which the map's changes are learned
SMOOTHED = 5  # latest changes of the query whose mean predicts the speed
OFFSET = 0.02  # added to changes before the logarithm: noise between equal views
FLOOR = 1e-3  # least relative probability of a speed
AHEAD = 8  # places within which an unlit stretch may begin
UNLIT = 0.3  # probability of such places above which equal images do not mean standstill


@parallel_kernel
def _changes(strips, apart, out):
    """Write the change of each place of (W, n, d) from the one ``apart`` places before, (n,)."""
    W, n, d = strips.shape
    for y in nb.prange(apart, n):
        total = np.float32(0)
        for j in range(W):
            a, b = strips[j, y], strips[j, y - apart]
            dot, norm = np.float32(0), np.float32(0)
            for i in range(d):
                dot += a[i] * b[i]
                norm += a[i] * a[i] + b[i] * b[i]
            total += dot if norm > 0 else np.float32(1)
        out[y] = 1 - total / W


class ImageChange:
    """
    Changes of a map, and of the query that is compared with it.

    :param places: places that there is room for.
    """

    def __init__(self, places: int, settings: FilterSettings) -> None:
        self._settings = settings
        self._speeds = np.array(settings.speeds)
        self._sums, self._counts = np.zeros(APART + 1), np.zeros(APART + 1)
        self._from_before = np.ones(places, np.float32)  # change of each place from the one before
        self.reset()

    def reset(self) -> None:
        """Forget the query."""
        self._last: np.ndarray | None = None
        self._latest: deque[float] = deque(maxlen=SMOOTHED)

    def learn(self, strips: np.ndarray) -> None:
        """Learn from all places of a map, unit-norm strips (W, n, d), float32."""
        changes = np.empty(strips.shape[1], np.float32)
        for apart in range(1, min(APART, strips.shape[1] - 1) + 1):
            _changes(strips, apart, changes)
            self._sums[apart] = changes[apart:].sum(dtype=np.float64)
            self._counts[apart] = len(changes) - apart
            if apart == 1:
                self._from_before[1:] = changes[1:]

    def learn_newest(self, strips: np.ndarray) -> None:
        """Learn from the newest place of a route, (W, n, d) of all its places."""
        n = strips.shape[1]
        newest = strips[:, n - 1]
        changes = [
            change_between(newest, strips[:, n - 1 - apart])
            for apart in range(1, min(APART, n - 1) + 1)
        ]
        self._from_before[n - 1] = changes[0] if changes else 1
        if changes and not self.is_standstill(changes[0]):
            self._sums[1 : len(changes) + 1] += changes
            self._counts[1 : len(changes) + 1] += 1

    def grow(self, places: int) -> None:
        """Make room for more places."""
        more = np.ones(places - len(self._from_before), np.float32)
        self._from_before = np.append(self._from_before, more)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self._from_before = np.append(self._from_before[count:], np.ones(count, np.float32))

    @property
    def curve(self) -> np.ndarray:
        """Mean change of places 0, 1, ... ``APART`` apart; 1 where none is known."""
        known = self._counts > 0
        curve = np.where(known, self._sums / np.maximum(self._counts, 1), 1)
        curve[0] = 0
        return curve

    def next_query(self, strips: np.ndarray) -> float:
        """Return the change of the query's next image (W, d) from the one before, 1 at first."""
        change = 1.0 if self._last is None else change_between(strips, self._last)
        self._last = strips
        return change

    def is_standstill(self, change: float) -> bool:
        """Whether the query's images are equal up to noise: the camera stands, or it is dark."""
        return bool(change < self._settings.standstill * self.curve[1])

    def unlit(self, by_place: np.ndarray) -> bool:
        """
        Whether equal images are expected where the camera is: places of the map are equal there.

        :param by_place: probability of each place, (n,).
        """
        n = len(by_place)
        equal = self._from_before[:n] < 2 * self._settings.standstill * self.curve[1]
        ahead = np.zeros(n, bool)
        for places in range(min(AHEAD, n)):
            ahead[: n - places] |= equal[places:]
        return bool(by_place[ahead].sum() > UNLIT * by_place.sum())

    def weight(self, change: float) -> float:
        """Return the exponent alpha of the image's likelihood."""
        s = self._settings
        relative = change / max(float(self.curve[1]), 1e-6)
        return s.weight * min(s.most_change, max(s.least_change, relative))

    def speed_weights(self, change: float) -> np.ndarray:
        """Return the relative probability of each speed after another change, (V,)."""
        self._latest.append(change)
        seen = np.log(np.mean(self._latest) + OFFSET)
        expected = np.log(np.interp(self._speeds, np.arange(APART + 1), self.curve) + OFFSET)
        off = (seen - expected) / self._settings.change_deviation
        return np.asarray(np.exp(-0.5 * off**2) + FLOOR)


def change_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the change of two images, unit-norm strips (W, d) each; equal where both are zero."""
    similarity = np.einsum('jd,jd->j', a, b)
    similarity[~(a.any(axis=1) | b.any(axis=1))] = 1
    return float(1 - similarity.mean())
