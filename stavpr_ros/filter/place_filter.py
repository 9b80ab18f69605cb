# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the camera is, as a Bayes filter over places and speeds with a state off the map.

After each image the filter has a probability for every place y, at every speed v (places an
image) and every level k, and for being off the map. The level is how near right places are to
their images on this drive: nearer by day than at night. The evidence is the z-normalized distance
z of the image to each place. At wrong places, and off the map, it has mean 0 and deviation 1; at
the right one, mean mu_k, so that the likelihood ratio is

    L[k, y] = exp(alpha (mu_k z[y] - mu_k^2 / 2)).

The exponent alpha < 1 accounts for successive images that are not independent: it grows with the
change from the image before, and images of a camera at rest add nothing. The speed is predicted
from the same change: the map shows the change of images by the places between them.

The place of an image is determined a few images later (fixed-lag smoothing): the most probable
states are followed back over the latest images. After Xu, Sünderhauf and Milford, "Probabilistic
Visual Place Recognition for Hierarchical Localization", RA-L 2021, with speeds, levels and
smoothing added.

Memory, for n columns: places, with a gap between two sessions, whose states are 0 and lost::

    column     0          128        256   ...              2048       2176  ...    n
    session    | places of session 0    |  gap  | places of session 1 ...            |
    block      |<- BLOCK ->|           |         ...       |           |   ...      |
    part       |<------------------ PLACES --------------->|<-- of another thread -->|
    halo                                       |<- reach ->|  copied for the next part

    states     (blocks, K, V, BLOCK), float32: the states of a block are neighbors
    sums       of the states of each column, and the largest of each block
    halos      (parts, K, V, reach), float32: copy of the last columns before each part
    origins    (lag, blocks, K, (V + 1) // 2, BLOCK), uint8: ring of the latest images; where
               each state came from, two in a byte (:mod:`stavpr_ros.filter.paths`)

All states advance in one pass, in place. A thread computes a part from its last block to its
first, since states only move up: the columns before a block are not written yet, and those before
the part, which belong to another thread, are in its halo. States are not normalized: the factor
that makes their sum 1 is part of the next image's level changes.
"""

import numpy as np
from stavpr_ros import checks
from stavpr_ros.filter.kernels import advance, PLACES
from stavpr_ros.filter.model import FilterSettings, MODEL
from stavpr_ros.filter.paths import (
    ALL_ENTERED,
    backtrack,
    Belief,
    BLOCK,
    find_most_probable,
    NO_PLACES,
    trace_back,
)
from stavpr_ros.filter.protocol import Filter
from stavpr_ros.memory import aligned_zeros
from stavpr_ros.simd import LANES

NO_PLACE = np.float32(-np.inf)  # z of a gap between sessions, where likelihoods are 1


class PlaceFilter(Filter):
    """
    The filter of the module, on the CPU; ``count`` is the number of images since the reset.

    A state takes 4 bytes, and half a byte for each image of the lag: 274 bytes a place with the
    default speeds and levels and a lag of 10.

    :param places: places that there is room for.
    :param lag: most images that states are followed back.
    :param gaps: columns between sessions, ascending; a state that enters one leaves the map.
    :raises SettingsError: no lag, or places below 0.
    :raises InputError: arguments of any method that do not fit the places, lag and speeds.
    """

    def __init__(
        self,
        places: int,
        lag: int,
        settings: FilterSettings = MODEL,
        gaps: np.ndarray = NO_PLACES,
    ) -> None:
        checks.require_whole('places', places, 0)
        checks.require_whole('lag', lag, 1, 'image')
        checks.require_ascending('gaps', gaps, places)
        self.settings = settings
        self._gaps = gaps
        self._speeds = np.array(self.settings.speeds, np.float64)
        self._levels = np.array(self.settings.levels, np.float32)
        self._level_changes = self.settings.level_changes()
        self._steps = np.zeros((lag, len(self._speeds)), np.int64)
        self._reach = -(-(int(np.ceil(self._speeds.max())) + 2) // LANES) * LANES
        self._allocate(places)
        self.reset()

    def _allocate(self, room: int) -> None:
        K, V = len(self._levels), len(self._speeds)
        self._room, blocks = room, max(1, -(-room // BLOCK))
        # not normalized: times scale, the states are probabilities
        self._a: np.ndarray = aligned_zeros((blocks, K, V, BLOCK))
        self._by_place: np.ndarray = np.zeros(blocks * BLOCK, np.float32)  # sums of the states
        self._maxima: np.ndarray = np.zeros(blocks, np.float32)  # of these, by block
        shape = len(self._steps), blocks, K, (V + 1) // 2, BLOCK
        self._origins: np.ndarray = np.full(shape, ALL_ENTERED, np.uint8)
        self._halos: np.ndarray = np.zeros((-(-room // PLACES), K, V, self._reach), np.float32)

    def reset(self) -> None:
        """Forget where the camera was."""
        self._a[:] = self._by_place[:] = self._maxima[:] = 0
        self._scale = 1.0
        self._off = np.full(len(self._levels), 1 / len(self._levels))
        self._known = self.count = 0

    def grow(self, places: int) -> None:
        """Make room for more places."""
        checks.require_whole('places', places, self._room)
        a, origins, by_place = self._a, self._origins, self._by_place
        self._allocate(places)
        self._a[: len(a)], self._origins[:, : len(a)] = a, origins
        self._set_by_place(by_place)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        checks.require_indices('count', count, self._room + 1)
        _move_up(self._a, count, 0)
        for origins in self._origins:
            _move_up(origins, count, ALL_ENTERED)
        self._set_by_place(self._by_place[count:].copy())

    def move_back(self, places: slice, count: int) -> None:
        """Move states back: :meth:`Filter.move_back`."""
        y = np.arange(places.start, places.stop)
        checks.require_indices('places', [*y, *(y - count)], self._room)
        checks.require_whole('count', count, len(y), 'places')
        block, at, block_to, at_to = *divmod(y, BLOCK), *divmod(y - count, BLOCK)
        self._a[block_to, :, :, at_to] += self._a[block, :, :, at]
        self._by_place[y - count] += self._by_place[y]
        self._a[block, :, :, at] = self._by_place[y] = 0
        self._find_maxima()
        for origins in self._origins:
            origins[block_to, :, :, at_to] = origins[block, :, :, at]

    def _set_by_place(self, by_place: np.ndarray) -> None:
        self._by_place[: len(by_place)], self._by_place[len(by_place) :] = by_place, 0
        self._find_maxima()

    def _find_maxima(self) -> None:
        self._maxima[:] = self._by_place.reshape(-1, BLOCK).max(axis=1)

    def places_of_states(self) -> np.ndarray:
        """Return the probability of each place, (room,), float32."""
        return self._by_place[: self._room] * np.float32(self._scale)

    def update(
        self,
        z: np.ndarray,
        weight: float,
        speed_weights: np.ndarray,
        speed_likelihoods: np.ndarray | None = None,
        not_near: np.ndarray = NO_PLACES,
    ) -> None:
        """See :meth:`Filter.update`."""
        z = checks.float32_vector('z', z, int(self._gaps.max(initial=-1)) + 1, self._room)
        s, n, slot = self.settings, len(z), self.count % len(self._steps)
        checks.require_at_least('weight', weight, 0)
        checks.require_indices('not_near', not_near, n)
        if speed_likelihoods is None:
            speed_likelihoods = np.ones(len(s.speeds))
        speeds = checks.relative_weights(len(s.speeds), speed_weights, speed_likelihoods)
        if not self.count and n:
            states = len(self._speeds) * max(n - len(self._gaps), 1)  # of a level
            self._a[: -(-n // BLOCK)] = s.start / (len(self._levels) * states)
            self._maxima[:] = s.start
            self._a[self._gaps // BLOCK, :, :, self._gaps % BLOCK] = 0
            self._off[:] = (1 - s.start) / len(self._levels)
        if not self.count or n < self._known:
            self._clear_from(n)
        if len(self._gaps) or len(not_near):
            z = z.copy()
            z[not_near] = np.maximum(z[not_near], 0)
            z[self._gaps] = NO_PLACE
        self._off = self._off @ self._level_changes
        total = advance(
            self._a, n, z, np.float32(weight), self._levels,
            self._level_changes, self._scale, self._speeds, *speeds,
            self.count, s.keep_speed, s.spread, s.leave, s.enter, self._off, self._gaps,
            self._halos, self._origins[slot], self._steps[slot], self._by_place, self._maxima,
        )  # fmt: skip
        self._scale = 1 / total
        self._known = n
        self.count += 1

    def _clear_from(self, n: int) -> None:
        """Set states and sums from place n on to 0."""
        self._a[n // BLOCK :, :, :, n % BLOCK :] = 0
        self._a[n // BLOCK + 1 :] = 0
        self._by_place[n:] = self._maxima[-(-n // BLOCK) :] = 0

    def belief(self, n: int, images_ago: int) -> Belief:
        """See :meth:`Filter.belief`."""
        checks.require_indices('n', n, self._room + 1)
        checks.require_indices('images_ago', images_ago, min(len(self._steps) + 1, self.count))
        newest = (self.count - 1) % len(self._steps)
        states = self._a, self._by_place, self._maxima, n
        return Belief(
            *backtrack(*states, self._origins, self._steps, newest, images_ago, self._scale)
        )

    def most_probable(self, excluded: np.ndarray) -> tuple[int, float]:
        """See :meth:`Filter.most_probable`."""
        checks.require_ascending('excluded', excluded, len(self._by_place))
        place, probability = find_most_probable(self._by_place, self._maxima, excluded)
        return place, probability * self._scale

    def path(self, state: np.ndarray, images: int) -> np.ndarray:
        """See :meth:`Filter.path`; a state is level, speed, place, speed then."""
        for part, end in zip(state[:3].tolist(), (*self._a.shape[1:3], self._room), strict=True):
            checks.require_indices('state', part, end)
        checks.require_indices('images', images, len(self._steps) + 1)
        places = np.empty(images + 1, np.int32)
        trace_back(
            *state[:3].tolist(), self._origins, self._steps,
            (self.count - 1) % len(self._steps), images, places,
        )  # fmt: skip
        return places


def _move_up(values: np.ndarray, count: int, none: int) -> None:
    """Move places of (blocks, K, ., BLOCK) up by ``count``; behind them, write ``none``."""
    for row in np.ndindex(values.shape[1:3]):
        places = values[:, *row].ravel()  # a copy
        end = len(places) - count
        places[:end], places[end:] = places[count:].copy(), none
        values[:, *row] = places.reshape(len(values), -1)
