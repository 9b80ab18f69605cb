# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Features of a route that grows by one place at a time, centered and whitened, in memory once.

In int8 they are float32 until the route is settled and whitening is not learned again.
From then on they are rounded, and the mean is updated only when as many images have come as there
are places, so that a place is seldom rounded again.
"""

import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.memory import aligned_empty
from stavpr_ros.prepare.blocks import change_weights, MAX_LAG
from stavpr_ros.prepare.centering import evenly_weighted, norms_of, unit_norm, Whitening
from stavpr_ros.simd import LANES

ROOM = 256  # places that there is room for at first; doubled when they are full
GROWTH = 1.125  # the mean is updated when the route is so much longer
SAMPLE = 128  # places that whitening is learned from
SETTLED = 2000  # places from which on it is not learned again; a full route is settled as well
LATEST = MAX_LAG + 1  # places that the newest one is compared with, itself included
AT_ONCE = 64  # places centered or whitened at a time: what is between stays in the cache
PIECE = 512  # places that are summed at a time


class Int8Route(Int8Strips):
    """Strips of a route in int8; see :class:`stavpr_ros.alignment.cpu.int8`."""

    def grow(self, room: int) -> None:
        """Make room for more places."""
        values, reciprocals = self.values, self.reciprocals
        super().__init__(self.shape[0], room, self.shape[2])
        self.values[:, : values.shape[1]] = values
        self.reciprocals[:, : reciprocals.shape[1]] = reciprocals

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        source, to = np.arange(count, self.shape[1]), np.arange(self.shape[1] - count)
        for values in self.values.view(np.int32)[..., 0]:  # of a strip
            values[to // LANES, :, to % LANES] = values[source // LANES, :, source % LANES]
        self.reciprocals[:, to] = self.reciprocals[:, source]


RouteStrips = np.ndarray | Int8Route  # of a route, (W, room, d), float32 or int8


class RouteFeatures:
    """
    Features of the places of a route, less their mean and whitened if that is wanted, unit norm.

    With the norm that a feature had before it was made unit norm, the features give back the
    original ones: nothing is in memory twice.

    :param settings: how the features are made.
    :param mean_centering: subtract the mean.
    :param whitening: whiten; learned again from time to time while the route is short.
    :param limit: most places there will be; None = no limit.
    :param rounds: to int8 once the route is settled, see the module.

    ``latest`` are the features of the newest ``LATEST`` places, oldest first, (W, m, d); ``mean``
    the mean that is subtracted, (W, d), float32, zeros without centering.
    """

    def __init__(
        self,
        settings: FeatureSettings,
        mean_centering: bool,
        whitening: bool,
        limit: int | None,
        rounds: bool = False,
    ) -> None:
        self.count, self._rounds = 0, rounds
        none = np.empty((settings.strips, 0), np.float32)
        self.strips: RouteStrips = none[..., None]  # centered, (W, room, d)
        self._is_settled, self._since_mean = False, 0  # images since the mean was taken
        self.latest = none[..., None]
        self._settings, self._centering, self._limit = settings, mean_centering, limit
        self._whitens = whitening
        self._whitening: Whitening | None = None  # of the features less the mean
        self._cells: tuple[int, int] | None = None
        self._weights = none
        # (W, room): the norm of each feature before it was made unit norm; 0 for zero features
        self._norms = none
        # sum of the original features, and their mean weighted by `change_weights`, (W, d)
        self._sum: np.ndarray = none
        self.mean: np.ndarray = none
        self._newest = none  # original
        self._changes = np.empty(0, np.float32)  # from place to place, (room,)
        self._next_mean = 1

    @property
    def room(self) -> int:
        """Places that there is room for."""
        return self.strips.shape[1]

    @property
    def newest(self) -> np.ndarray:
        """Centered features of the newest place, (W, 1, d), float32."""
        return self.latest[:, -1:]

    def original(self) -> LocalFeatures:
        """
        Return the features as they were appended, in memory of their own.

        Without centering and whitening exactly, with them up to the rounding of float32.
        """
        n = self.count
        if n and (self._centering or self._whitens):
            strips = self._center(slice(n))
            for j in range(len(strips)):
                strips[j] += self.mean[j] * (self._norms[j, :n, None] > 0)
        else:
            strips = self.strips[:, :n].copy()
        return LocalFeatures(strips, self._weights[:, :n].copy(), self._settings, self._cells)

    def append(self, features: LocalFeatures) -> bool:
        """Append the features of one image, strips (W, 1, d); return whether memory grew."""
        strips = features.strips
        grows = self.count == self.room
        if grows:
            self._grow(strips.shape[2])
            self._cells = features.cells
        newest = self._whiten(strips)
        norms: np.ndarray = np.asarray(strips.any(axis=2), np.float32)
        if self._centering or self._whitens:
            newest, norms = _shift_means(newest, norms, -self._whiten(self.mean[:, None]))
        here = slice(self.count, self.count + 1)
        self.strips[:, here], self._norms[:, here] = newest, norms
        self.latest = np.concatenate([self.latest[:, 1 - LATEST :], newest], axis=1)
        self._weights[:, self.count] = features.weights[:, 0]
        before, self._newest = self._newest, strips[:, 0]
        self._changes[self.count] = change_between(self._newest, before) if self.count else 0
        self.count += 1
        if self._centering:
            self._sum += strips[:, 0]
        if self._is_settled:
            self._since_mean += 1
            if self._centering and self._since_mean >= self.count:
                self._learn(0)
            return grows
        is_full = self.count == min(SETTLED, self._limit or SETTLED)
        settles = is_full and self._rounds
        if (self._centering or self._whitens) and (self.count >= self._next_mean or settles):
            self._learn(0)
            self._next_mean = int(self.count * GROWTH) + 1
        if settles:
            self.strips = round_strips(self.strips, self.count)
            self._is_settled, self._since_mean = True, 0
        return grows

    def evict(self, count: int) -> None:
        """Drop the oldest places; the mean is of the others until the next eviction."""
        remaining = self.count - count
        self._weights[:, :remaining] = self._weights[:, count : self.count].copy()
        if self._centering:
            self._sum -= self._total(np.ones(count))
        self._changes[:remaining] = self._changes[count : self.count].copy()
        if (self._centering or self._whitens) and not self._is_settled:
            self.count = remaining
            self._learn(count)
            self._next_mean = self.count + count + 1
            return
        if isinstance(self.strips, np.ndarray):
            move_up(self.strips, count, self.count)
        else:
            self.strips.evict(count)
        move_up(self._norms, count, self.count)
        self.count = remaining

    def _whiten(self, strips: np.ndarray) -> np.ndarray:
        return self._whitening(strips) if self._whitening else strips

    def _center(self, places: slice | np.ndarray) -> np.ndarray:
        """Return features less the mean, not whitened, of their own norm, (W, m, d)."""
        strips = self.strips[:, places] * self._norms[:, places, None]
        return self._whitening.inverse(strips) if self._whitening else strips

    def _grow(self, d: int) -> None:
        """Double the room; memory that is not used yet is not touched."""
        n, W = self.count, self._settings.strips
        room = max(ROOM, 2 * self.room)
        room = room if self._limit is None else min(room, self._limit)
        if not n:
            self._sum, self.mean = np.zeros((W, d)), np.zeros((W, d), np.float32)
            self.strips = self.latest = np.empty((W, 0, d), np.float32)
        if isinstance(self.strips, np.ndarray):
            self.strips = with_room(self.strips, room)
        else:
            self.strips.grow(room)
        self._norms, self._weights = with_room(self._norms, room), with_room(self._weights, room)
        self._changes = np.append(self._changes, np.zeros(room - n, np.float32))

    def _total(self, weights: np.ndarray) -> np.ndarray:
        """Return the weighted sum of the original features of the oldest places, (W, d)."""
        total: np.ndarray = np.zeros_like(self._sum)
        for low in range(0, len(weights), PIECE):
            piece = slice(low, min(low + PIECE, len(weights)))
            if not weights[piece].any():
                continue
            of_place = weights[piece].astype(np.float32)
            norms, alive = self._norms[:, piece] * of_place, self._norms[:, piece] > 0
            of_piece = norms[:, None] @ self.strips[:, piece]
            if self._whitening:
                of_piece = self._whitening.inverse(of_piece)
            total += of_piece[:, 0] + (alive * of_place).sum(axis=1, keepdims=True) * self.mean
        return total

    def _learn(self, first: int) -> None:
        """Take the mean and, until the route is settled, whitening; ``first`` becomes place 0."""
        weights, mean = change_weights(self._changes[: self.count]), self.mean
        if self._centering:
            less = np.append(np.zeros(first), 1 - weights)
            total = self._sum - self._total(less) if less.any() else self._sum
            mean = (total / weights.sum()).astype(np.float32)
        self._shift(first, self._whiten((self.mean - mean)[:, None]))
        self.mean, self._since_mean = mean, 0
        if self._whitens and self.count <= SETTLED and not self._is_settled:
            sample = evenly_weighted(weights, SAMPLE)
            whitening = Whitening.learn(unit_norm(self._center(sample)))
            for low in range(0, self.count, AT_ONCE):
                places = slice(low, min(low + AT_ONCE, self.count))
                strips, norms = whitening(self._center(places)), self._norms[:, places]
                norms[:] = norms_of(strips).clip(1e-12) * (norms > 0)
                self.strips[:, places] = unit_norm(strips)
            self._whitening = whitening
        last = slice(max(0, self.count - LATEST), self.count)
        self.latest = self.strips[:, last].copy()

    def _shift(self, first: int, change: np.ndarray) -> None:
        """Add to the features of places from ``first`` on, which becomes place 0."""
        for low in range(0, self.count, AT_ONCE):
            places = slice(low, min(low + AT_ONCE, self.count))
            source = slice(places.start + first, places.stop + first)
            moved = _shift_means(self.strips[:, source], self._norms[:, source], change)
            self.strips[:, places], self._norms[:, places] = moved


def _shift_means(
    strips: np.ndarray, norms: np.ndarray, change: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Add to features (W, m, d) of norms (W, m) that are not zero; return unit ones and norms."""
    alive = norms[..., None] > 0
    moved = strips * norms[..., None]
    moved += change
    moved *= alive
    length = norms_of(moved)[..., None].clip(1e-12)
    moved /= length
    return moved, (length * alive)[..., 0]


def with_room(values: np.ndarray, room: int) -> np.ndarray:
    """Return (W, n, ...) with room for more places; memory that is not used is not touched."""
    W, n, *rest = values.shape
    out = aligned_empty((W, room, *rest), values.dtype)
    out[:, :n] = values
    return out


def move_up(values: np.ndarray, count: int, last: int) -> None:
    """Move places ``count`` to ``last`` of (W, n, ...) up by ``count``."""
    for first in range(count, last, count):
        end = min(first + count, last)
        values[:, first - count : end - count] = values[:, first:end]


def round_strips(strips: RouteStrips, count: int) -> Int8Route:
    """Return float32 strips (W, room, d), of which ``count`` places are known, in int8."""
    rounded = Int8Route(*strips.shape)
    for low in range(0, count, AT_ONCE):
        places = slice(low, min(low + AT_ONCE, count))
        rounded[:, places] = strips[:, places]
    return rounded
