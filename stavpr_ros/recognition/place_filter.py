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
from stavpr_ros.alignment.cpu.simd import LANES
from stavpr_ros.recognition.place_filter_kernels import (
    advance,
    BLOCK,
    BORN,
    followed_back,
    PLACES,
    trace_back,
)
from stavpr_ros.recognition.robust import FilterSettings

TOP = 64  # places whose states are followed back
NEGLIGIBLE = 1e-3  # of the most probable state: states below are not followed back
CLOSE = 2  # places: the probability of a place is that of so many to either side, too
ALL_BORN = BORN | BORN << 4  # two origins


@dataclass(frozen=True, eq=False)
class Belief:
    """
    Where the camera was some images ago.

    :param places: places to which a way leads, ascending, (m,).
    :param weights: probability of each of them alone, (m,).
    :param ways: the most probable state now and the speed then, (m, 4), int: level, speed, place,
        speed then.
    """

    places: np.ndarray
    weights: np.ndarray
    ways: np.ndarray

    def probabilities(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the places of n whose probability, that of close ones included, is not 0.

        :returns: places, ascending, (m,), and their probabilities.
        """
        near = np.unique(self.places[:, None] + np.arange(-CLOSE, CLOSE + 1))
        near = near[(near >= 0) & (near < n)]
        sums = np.concatenate([[0], np.cumsum(self.weights)])
        low = np.searchsorted(self.places, near - CLOSE)
        high = np.searchsorted(self.places, near + CLOSE, 'right')
        return near, np.minimum(sums[high] - sums[low], 1)


class PlaceFilter:
    """
    The filter over n places; see the module.

    It holds 4 bytes for each state of a place and half a byte for each image of the lag: 247 bytes
    a place with the default speeds and levels and a lag of 10.

    :param places: places that there is room for.
    :param lag: most images that states are followed back.
    """

    def __init__(self, places: int, lag: int, settings: FilterSettings | None = None) -> None:
        self.settings = settings or FilterSettings()
        self._speeds = np.array(self.settings.speeds, np.float64)
        self._levels = np.array(self.settings.levels, np.float32)
        self._level_changes = self.settings.level_changes()
        self._steps = np.zeros((lag, len(self._speeds)), np.int64)
        self._reach = -(-(int(np.ceil(self._speeds.max())) + 2) // LANES) * LANES
        self._allocate(places)
        self.reset()

    def _allocate(self, room: int) -> None:
        K, V = len(self._levels), len(self._speeds)
        self._room, pitch = room, -(-room // LANES) * LANES
        # not normalized: times scale, the states are probabilities
        self._a: np.ndarray = np.zeros((K, V, pitch), np.float32)
        self._by_place: np.ndarray = np.zeros(room, np.float32)  # sum of the states
        self._maxima: np.ndarray = np.zeros(-(-room // BLOCK), np.float32)  # of it, by block
        shape = len(self._steps), K, (V + 1) // 2, pitch
        self._origins: np.ndarray = np.full(shape, ALL_BORN, np.uint8)
        self._halos: np.ndarray = np.zeros((-(-room // PLACES), K, V, self._reach), np.float32)

    def reset(self) -> None:
        """Forget where the camera was."""
        self._a[:] = self._by_place[:] = self._maxima[:] = 0
        self._scale = 1.0
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
        a, origins, by_place, n = self._a, self._origins, self._by_place, self._room
        self._allocate(places)
        self._a[:, :, :n], self._origins[..., :n] = a[:, :, :n], origins[..., :n]
        self._set_by_place(by_place)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        for values, none in ((self._a, 0), (self._origins, ALL_BORN)):
            values[..., :-count] = values[..., count:].copy()
            values[..., -count:] = none
        self._set_by_place(self._by_place[count:].copy())

    def _set_by_place(self, by_place: np.ndarray) -> None:
        self._by_place[: len(by_place)], self._by_place[len(by_place) :] = by_place, 0
        for block in range(len(self._maxima)):
            self._maxima[block] = self._by_place[block * BLOCK : (block + 1) * BLOCK].max()

    def places_of_states(self) -> np.ndarray:
        """Return the probability of each place, (room,), float32."""
        return self._by_place * np.float32(self._scale)

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
        if n < self._known:
            self._a[:, :, n:] = self._by_place[n:] = self._maxima[-(-n // BLOCK) :] = 0
        totals = np.zeros((-(-n // BLOCK), len(self._levels), 3))
        off = self._off @ self._level_changes
        births = (off * s.enter / (len(self._speeds) * max(n, 1))).astype(np.float32)
        if n:
            advance(
                self._a, n, np.ascontiguousarray(z), np.float32(weight), self._levels,
                self._level_changes * np.float32(self._scale), s.speed_changes(speed_weights),
                self._steps[slot], np.float32(s.spread), np.float32(1 - s.leave), births,
                self._halos, self._origins[slot], totals, self._by_place, self._maxima,
            )  # fmt: skip
        before, lost, seen = totals.sum(axis=0).T if n else np.zeros((3, len(off)))
        off = off * (1 - s.enter) + (before - lost) * s.leave + lost
        total = float(off.sum() + seen.sum())
        self._off, self._scale = off / total, 1 / total
        self._known = n
        self._count += 1

    def belief(self, n: int, images_ago: int) -> Belief:
        """
        Return where the camera was some images ago, by the images since then, too.

        :param n: places.
        :param images_ago: at most ``lag`` and ``count - 1``.
        """
        top = self._top(n)
        least = NEGLIGIBLE * self._a[:, :, top].max(initial=0)
        most = len(top) * len(self._levels) * len(self._speeds)
        ways, states = np.empty((most, 5), np.int64), np.empty(most, np.float32)
        count = followed_back(
            self._a, np.float32(least or 1), top, self._origins, self._steps,
            (self._count - 1) % len(self._steps), images_ago, ways, states,
        )  # fmt: skip
        ways, probabilities = ways[:count], states[:count].astype(np.float64) * self._scale
        order = np.lexsort((-probabilities, ways[:, 0]))  # the most probable first, of each place
        places, firsts, each = np.unique(ways[order, 0], return_index=True, return_inverse=True)
        weights = np.bincount(each, probabilities[order], len(places))
        return Belief(places, weights, ways[order[firsts], 1:])

    def _top(self, n: int) -> np.ndarray:
        """Return the ``TOP`` most probable places, int64; they lie in blocks with large maxima."""
        blocks = -(-n // BLOCK)
        some = np.sort(np.argpartition(self._maxima[:blocks], max(blocks - TOP, 0))[-TOP:])
        places = (some[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        places = places[places < n]
        return places[np.argpartition(self._by_place[places], max(len(places) - TOP, 0))[-TOP:]]

    def most_probable(self, n: int, excluded: np.ndarray) -> tuple[int, float]:
        """
        Return the most probable place now and its probability, 0 if all are excluded.

        :param n: places, at least 1.
        :param excluded: places that do not count.
        """
        maxima, by_place = self._maxima[: -(-n // BLOCK)].copy(), self._by_place[:n]
        touched = np.unique(excluded // BLOCK)
        pieces = (touched[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        pieces = np.setdiff1d(pieces[pieces < n], excluded, assume_unique=True)
        maxima[touched] = 0
        block = int(np.argmax(maxima))
        pieces = np.append(pieces, np.arange(block * BLOCK, min((block + 1) * BLOCK, n)))
        pieces = np.setdiff1d(pieces, excluded)
        if not pieces.size:
            return 0, 0.0
        place = int(pieces[np.argmax(by_place[pieces])])
        return place, float(by_place[place]) * self._scale

    def way(self, state: np.ndarray, images: int) -> np.ndarray:
        """
        Return the places of the most probable way to a state, newest first, (images + 1,).

        :param state: level, speed, place.
        """
        places = np.empty(images + 1, np.int32)
        trace_back(
            *(int(i) for i in state[:3]), self._origins, self._steps,
            (self._count - 1) % len(self._steps), images, places,
        )  # fmt: skip
        return places
