# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How much the images of a map change from place to place.

The change of two images is 1 less the mean cosine similarity of their strips, each with the one in
the same place: 0 for equal images, about 1 for unrelated ones.
"""

import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.recognition.blocks import PlaceChanges
from stavpr_ros.recognition.robust import change_weights, FilterSettings
import torch

LEARNED_AT_ONCE = 256  # places
APART = 5  # places apart up to which the map's changes are learned
STANDING = 0.05  # weight of a place by its change, up to which the curve is not learned from it
AHEAD = 8  # places within which an unlit stretch may begin
STRETCH = 4  # places in a row, at least, equal each to the one before: an unlit stretch
UNLIT = 0.3  # probability of such places above which equal images do not mean standstill


class MapChange:
    """
    Changes of a map from place to place.

    ``curve`` holds the mean change of places 0, 1, ... ``APART`` apart while the camera moves, 1
    where none is known; ``standstill`` the change below which a camera stands.

    :param places: places that there is room for.
    """

    def __init__(self, places: int, settings: FilterSettings) -> None:
        self._settings = settings
        self._sums, self._counts = np.zeros(APART + 1), np.zeros(APART + 1)
        self._from_before = np.ones(places, np.float32)  # change of each place from the one before
        self._update_curve()

    def learn(
        self,
        strips: torch.Tensor | np.ndarray | Int8Strips,
        firsts: np.ndarray | tuple[int, ...] = (0,),
    ) -> None:
        """
        Learn from all places of a map.

        :param strips: unit-norm, (W, n, d), of any precision.
        :param firsts: first place of each session.
        """
        n = strips.shape[1]
        seen = PlaceChanges(n, APART)
        for low in range(0, n, LEARNED_AT_ONCE):
            seen.add(torch.as_tensor(strips[:, low : low + LEARNED_AT_ONCE]))
        self.take(seen.changes, firsts)

    def take(self, changes: np.ndarray, firsts: np.ndarray | tuple[int, ...] = (0,)) -> None:
        """
        Take the changes of all places of a map.

        :param changes: of each place from the ones 1 to ``APART`` places before, (``APART``, n).
        :param firsts: first place of each session.
        """
        n = changes.shape[1]
        if not n:
            return
        steps = change_weights(changes[0]) > STANDING
        steps[list(firsts)] = False
        moving = np.ones(n, bool)  # all steps from the place so far before
        for apart in range(1, min(APART, n - 1) + 1):
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

        :param latest: strips of the newest places, oldest first, (W, m, d); ``APART`` + 1 of them
            if there are so many.
        :param n: places of the route.
        """
        last = latest.shape[1] - 1
        changes = [
            change_between(latest[:, last], latest[:, last - apart])
            for apart in range(1, min(APART, last) + 1)
        ]
        self._from_before[n - 1] = changes[0] if changes else 1
        self._equal[n - 1] = self._from_before[n - 1] < self.standstill
        if changes and not changes[0] < self.standstill:
            self._sums[1 : len(changes) + 1] += changes
            self._counts[1 : len(changes) + 1] += 1
            self._update_curve()

    def adopt(self, learned: 'MapChange', from_before: np.ndarray) -> None:
        """
        Take what was learned from a sample, for some places of its map.

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
        known = self._counts > 0
        self.curve = np.where(known, self._sums / np.maximum(self._counts, 1), 1)
        self.curve[0] = 0
        self.standstill = self._settings.standstill * self.curve[1]
        self._find_equal()

    def _find_equal(self) -> None:
        self._equal = self._from_before < self.standstill  # to the place before, up to noise

    def unlit(self, by_place: np.ndarray) -> bool:
        """
        Whether equal images are expected where the camera is: places of the map are equal there.

        :param by_place: probability of each place, (n,).
        """
        n = len(by_place)
        equal = self._from_before[:n] < 2 * self.standstill
        for _ in range(STRETCH - 1):  # equal places before, too
            equal[1:] &= equal[:-1].copy()
        ahead = np.zeros(n, bool)
        for places in range(min(AHEAD, n)):
            ahead[: n - places] |= equal[places:]
        return bool(by_place[ahead].sum() > UNLIT * by_place.sum())
