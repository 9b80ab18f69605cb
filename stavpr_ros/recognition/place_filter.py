# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the camera is, as a Bayes filter over places and speeds with a state off the map.

After each image the filter holds the probability of every place y, at every speed v (places an
image) and every level k, and of being off the map. The level is how near right places are to
their images on this drive: nearer by day than at night. What is read as evidence is the
z-normalized distance z of the image to each place. At wrong places, and off the map, it has mean 0
and deviation 1; at the right one, mean mu_k, so that the likelihood ratio is

    L[k, y] = exp(alpha (mu_k z[y] - mu_k^2 / 2)).

The exponent alpha < 1 stands for successive images that are not independent: it grows with the
change from the image before, and images of a camera that stands still add nothing. The speed is
predicted from the same change: the map shows how much images of places so far apart differ.

The place of an image is read off a few images later (fixed-lag smoothing): the states of today are
followed back to where they were. After Xu, Sünderhauf and Milford, "Probabilistic Visual Place
Recognition for Hierarchical Localization", RA-L 2021, with speeds, levels and smoothing added.
"""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.recognition import filter_kernels as kernels

TOP = 64  # places whose states are followed back
NEGLIGIBLE = 1e-3  # of the most probable state: states below are not followed back
CLOSE = 2  # places: the probability of a place is that of so many to either side, too


@dataclass(frozen=True)
class FilterSettings:
    """
    Model of the filter; tuned on the data sets named in docs/robust_mode.md.

    :param speeds: places that the query passes an image.
    :param levels: mean z-normalized distance of right places, from bad to good conditions.
    :param weight: alpha of an image that differs from the one before as neighboring places of the
        map do.
    :param most_change, least_change: limits of the change, over that of neighboring places, that
        alpha is multiplied by.
    :param standstill: change, over that of neighboring places, below which the camera stands.
    :param keep_level: probability of keeping the level.
    :param keep_speed: probability of keeping the speed.
    :param spread: probability of one place more than the speed's, and of one less.
    :param leave: probability of leaving the map at an image, and enter: of returning to it.
    :param start: probability of starting on the map.
    :param change_deviation: of the logarithm of the change at one speed.
    """

    speeds: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0, 1.33, 2.0, 3.0, 4.5)
    levels: tuple[float, ...] = (-1.0, -2.0, -3.25)
    weight: float = 0.25
    most_change: float = 2.0
    least_change: float = 0.2
    standstill: float = 0.1
    keep_level: float = 0.998
    keep_speed: float = 0.98
    spread: float = 0.05
    leave: float = 0.01
    enter: float = 0.01
    start: float = 0.7
    change_deviation: float = 0.5

    def level_changes(self) -> np.ndarray:
        """Return the probability of each level by the one before, (K, K), float32."""
        K = len(self.levels)
        changes = np.zeros((K, K), np.float32)
        for k in range(K):
            neighbors = [j for j in (k - 1, k + 1) if 0 <= j < K]
            changes[k, k] = self.keep_level if neighbors else 1
            changes[k, neighbors] = (1 - changes[k, k]) / max(len(neighbors), 1)
        return changes

    def speed_changes(self, weights: np.ndarray) -> np.ndarray:
        """
        Return the probabilities that the kernels take, (4, V), float32.

        :param weights: relative probability of each speed for this image, (V,).
        """
        V = len(self.speeds)
        near, far = (1 - self.keep_speed) * 0.4, (1 - self.keep_speed) * 0.2 / V
        total = self.keep_speed * weights + far * weights.sum()
        total[1:] += near * weights[:-1]
        total[:-1] += near * weights[1:]
        before = np.array([self.keep_speed, near, far])[:, None] / total
        return np.concatenate([before, weights[None]]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Belief:
    """
    Where the camera was some images ago.

    :param probabilities: of each place, those close to it included, (n,).
    :param ways: for each place with a way to it, the most probable state now and the speed then,
        (n, 4), int: level, speed, place, speed then.
    :param weights: probability of each place alone, (n,).
    """

    probabilities: np.ndarray
    weights: np.ndarray
    ways: np.ndarray


class PlaceFilter:
    """
    The filter over n places; see the module.

    :param places: places that there is room for.
    :param lag: most images that states are followed back.
    """

    def __init__(self, places: int, lag: int, settings: FilterSettings | None = None) -> None:
        self.settings = settings or FilterSettings()
        self._speeds = np.array(self.settings.speeds, np.float64)
        self._levels = np.array(self.settings.levels, np.float32)
        self._level_changes = self.settings.level_changes()
        K, V = len(self._levels), len(self._speeds)
        self._steps = np.zeros((lag, V), np.int64)
        self._allocate(places, np.zeros((K, V, 0), np.float32), np.zeros((lag, K, V, 0), np.int8))
        self.reset()

    def _allocate(self, room: int, states: np.ndarray, origins: np.ndarray) -> None:
        shape, n = states.shape[:2], states.shape[2]
        self._a, self._next = (np.zeros((*shape, room), np.float32) for _ in range(2))
        self._origins = np.full((len(origins), *shape, room), kernels.BORN, np.int8)
        self._a[:, :, :n], self._origins[..., :n] = states, origins

    def reset(self) -> None:
        """Forget where the camera was."""
        self._a[:] = self._next[:] = 0
        self._off = np.full(len(self._levels), 1 / len(self._levels))
        self._count = self._known = 0

    @property
    def count(self) -> int:
        """Images since the reset."""
        return self._count

    @property
    def off_map(self) -> float:
        """Probability that the camera is off the map."""
        return float(self._off.sum())

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self._allocate(places, self._a, self._origins)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        for values, none in ((self._a, 0), (self._origins, kernels.BORN)):
            values[..., :-count] = values[..., count:].copy()
            values[..., -count:] = none

    def places_of_states(self) -> np.ndarray:
        """Return the probability of each place, (room,), float32."""
        return self._a.sum(axis=(0, 1))

    def update(self, z: np.ndarray, weight: float, speed_weights: np.ndarray) -> None:
        """
        Advance by an image.

        :param z: z-normalized distances to the first m places, (m,), float32; +inf bans a place.
        :param weight: alpha; 0 = the image is no evidence.
        :param speed_weights: relative probability of each speed, (V,).
        """
        s, n = self.settings, len(z)
        slot = self._count % len(self._steps)
        moved = np.rint(self._speeds * (self._count + 1)) - np.rint(self._speeds * self._count)
        self._steps[slot] = moved
        states = len(self._levels) * len(self._speeds) * max(n, 1)
        if not self._count and n:
            self._a[:, :, :n], self._off[:] = s.start / states, (1 - s.start) / len(self._levels)
        blocks = -(-n // kernels.PLACES)
        totals = np.zeros((blocks, len(self._levels), 3))
        off = self._off @ self._level_changes
        births = (off * s.enter / (len(self._speeds) * max(n, 1))).astype(np.float32)
        if n:
            kernels.advance(
                self._a, n, self._likelihood(z, weight), self._level_changes,
                s.speed_changes(speed_weights), self._steps[slot], np.float32(s.spread),
                np.float32(1 - s.leave), births, self._next, self._origins[slot], totals,
            )  # fmt: skip
            self._a, self._next = self._next, self._a
        before, lost, seen = totals.sum(axis=0).T if n else np.zeros((3, len(off)))
        off = off * (1 - s.enter) + (before - lost) * s.leave + lost
        total = float(off.sum() + seen.sum())
        self._off = off / total
        self._a[:, :, :n] *= np.float32(1 / total)
        if n < self._known:
            self._a[:, :, n:] = self._next[:, :, n:] = 0
        self._known = n
        self._count += 1

    def _likelihood(self, z: np.ndarray, weight: float) -> np.ndarray:
        if not weight:
            return np.ones((len(self._levels), len(z)), np.float32)
        mu = self._levels[:, None]
        return np.exp(np.float32(weight) * (mu * z - mu * mu / 2))

    def belief(self, n: int, images_ago: int) -> Belief:
        """
        Return where the camera was some images ago, by the images since then, too.

        :param n: places.
        :param images_ago: at most ``lag`` and ``count - 1``.
        """
        by_place = self._a[:, :, :n].sum(axis=(0, 1))
        top = np.argpartition(by_place, max(n - TOP, 0))[-TOP:]
        least = NEGLIGIBLE * float(self._a[:, :, top].max()) if n else 1.0
        weights, ways = np.zeros(n, np.float32), np.zeros((n, 4), np.int64)
        kernels.middle_probabilities(
            self._a, np.float32(least), top, self._origins, self._steps,
            (self._count - 1) % len(self._steps), images_ago, weights, ways,
        )  # fmt: skip
        sums = np.concatenate([[0], np.cumsum(weights, dtype=np.float64)])
        ends = np.arange(n)
        high, low = np.minimum(ends + CLOSE + 1, n), np.maximum(ends - CLOSE, 0)
        return Belief(np.minimum(sums[high] - sums[low], 1), weights, ways)

    def way(self, state: np.ndarray, images: int) -> np.ndarray:
        """
        Return the places of the most probable way to a state, newest first, (images + 1,).

        :param state: level, speed, place.
        """
        places = np.empty(images + 1, np.int32)
        kernels.trace_back(
            *(int(i) for i in state[:3]), self._origins, self._steps,
            (self._count - 1) % len(self._steps), images, places,
        )  # fmt: skip
        return places
