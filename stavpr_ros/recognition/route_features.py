# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features of a route that grows by one place at a time, centered and whitened, in memory once."""

import numpy as np
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.recognition.robust import evenly, unit_norm, Whitening
import torch

ROOM = 256  # places that there is room for at first; doubled when they are full
GROWTH = 1.125  # the mean is updated when the route is so much longer
SAMPLE = 128  # places that whitening is learned from
SETTLED = 2000  # places from which on it is not learned again
AT_ONCE = 64  # places whitened at a time
PIECE = 512  # places centered at a time: the intermediate results stay in the cache


class RouteFeatures:
    """
    Features of the places of a route, less their mean and whitened if that is wanted, unit norm.

    With the norm that a feature had before it was made unit norm, the features give back the
    original ones: nothing is held twice.

    :param settings: how the features are made.
    :param mean_centering: subtract the mean.
    :param whitening: whiten; learned again from time to time while the route is short.
    :param limit: most places there will be; None = no limit.
    """

    def __init__(
        self, settings: FeatureSettings, mean_centering: bool, whitening: bool, limit: int | None
    ) -> None:
        self.count = 0
        self.strips = torch.empty((settings.strips, 0, 0))  # centered, (W, room, d)
        self._settings, self._centering, self._limit = settings, mean_centering, limit
        self._whitens = whitening
        self._whitening: Whitening | None = None  # of the features less the mean
        self._cells: tuple[int, int] | None = None
        self._weights = torch.empty((settings.strips, 0))
        # (W, room): the norm of each feature before it was made unit norm; 0 for zero features
        self._norms = torch.empty((settings.strips, 0))
        self._sum = self._mean = torch.empty(
            (settings.strips, 0)
        )  # of the original features, (W, d)
        self._next_mean = 1

    @property
    def room(self) -> int:
        """Places that there is room for."""
        return self.strips.shape[1]

    @property
    def newest(self) -> torch.Tensor:
        """Centered features of the newest place, (W, 1, d)."""
        return self.strips[:, self.count - 1 : self.count]

    @property
    def mean(self) -> torch.Tensor:
        """Return the mean that is subtracted, (W, d), float32; zeros without centering."""
        return self._mean

    def original(self) -> LocalFeatures:
        """
        Return the features as they were appended, in memory of their own.

        Without centering and whitening exactly, with them up to the rounding of float32.
        """
        n = self.count
        if n and (self._centering or self._whitens):
            strips = self._centered(slice(n))
            for j in range(len(strips)):
                strips[j] += self._mean[j] * (self._norms[j, :n, None] > 0)
        else:
            strips = self.strips[:, :n].clone()
        return LocalFeatures(strips, self._weights[:, :n].clone(), self._settings, self._cells)

    def append(self, features: LocalFeatures) -> bool:
        """Append the features of one image, strips (W, 1, d); return whether memory grew."""
        strips = features.strips.cpu()
        grows = self.count == self.room
        if grows:
            self._grow(strips.shape[2])
            self._cells = features.cells
        self.strips[:, self.count] = self._whitened(strips)[:, 0]
        self._weights[:, self.count] = features.weights[:, 0]
        self._norms[:, self.count] = strips[:, 0].any(dim=1)
        self.count += 1
        if self._centering:
            self._sum += strips[:, 0]
        if self._centering or self._whitens:
            self._shift(self.count - 1, self.count - 1, -self._whitened(self._mean[:, None])[:, 0])
            if self.count >= self._next_mean:
                self._learn(0)
                self._next_mean = int(self.count * GROWTH) + 1
        return grows

    def evict(self, count: int) -> None:
        """Drop the oldest places; the mean is then that of the others until the next eviction."""
        kept = self.count - count
        self._weights[:, :kept] = self._weights[:, count : self.count].clone()
        if self._centering or self._whitens:
            self._subtract_from_sum(count)
            self.count = kept
            self._learn(count)
            self._next_mean = self.count + count + 1
            return
        for first in range(count, self.count, count):
            last = min(first + count, self.count)
            self.strips[:, first - count : last - count] = self.strips[:, first:last]
        self.count = kept

    def _whitened(self, strips: torch.Tensor) -> torch.Tensor:
        return self._whitening(strips) if self._whitening else strips

    def _centered(self, places: slice | np.ndarray) -> torch.Tensor:
        """Return features less the mean, not whitened, of their own norm, (W, m, d)."""
        strips = self.strips[:, places] * self._norms[:, places, None]
        return self._whitening.inverse(strips) if self._whitening else strips

    def _grow(self, d: int) -> None:
        """Double the room; memory that is not used yet is not touched."""
        n, W = self.count, self._settings.strips
        room = max(ROOM, 2 * self.room)
        room = room if self._limit is None else min(room, self._limit)
        strips, norms, weights = (
            torch.empty((W, room, d)),
            torch.empty((W, room)),
            torch.empty((W, room)),
        )
        if n:
            strips[:, :n], norms[:, :n], weights[:, :n] = self.strips, self._norms, self._weights
        else:
            self._sum, self._mean = torch.zeros((W, d), dtype=torch.float64), torch.zeros((W, d))
        self.strips, self._norms, self._weights = strips, norms, weights

    def _subtract_from_sum(self, count: int) -> None:
        """Subtract the original features of the oldest places from the sum."""
        if not self._centering:
            return
        total, alive = torch.zeros_like(self._mean), self._norms[:, :count] > 0
        for j in range(len(self.strips)):
            for low in range(0, count, PIECE):
                piece = slice(low, min(low + PIECE, count))
                total[j] += self._norms[j, piece] @ self.strips[j, piece]
        if self._whitening:
            total = self._whitening.inverse(total[:, None])[:, 0]
        self._sum -= total + alive.sum(dim=1, keepdim=True) * self._mean

    def _learn(self, first: int) -> None:
        """Take the present mean and, of a short route, whitening; ``first`` becomes place 0."""
        mean = (self._sum / self.count).float() if self._centering else self._mean
        self._shift(first, 0, self._whitened((self._mean - mean)[:, None])[:, 0])
        self._mean = mean
        if self._whitens and self.count <= SETTLED:
            some = evenly(self.count, SAMPLE)
            whitening = Whitening.learned(unit_norm(self._centered(some)))
            for low in range(0, self.count, AT_ONCE):
                places = slice(low, min(low + AT_ONCE, self.count))
                strips, norms = whitening(self._centered(places)), self._norms[:, places]
                norms.copy_(strips.norm(dim=2).clamp_(min=1e-12) * (norms > 0))
                self.strips[:, places] = unit_norm(strips)
            self._whitening = whitening

    def _shift(self, first: int, to: int, change: torch.Tensor) -> None:
        """
        Add to features, and make them unit norm again; zero features stay zero.

        :param first: place from which on; the last one ends up as the last of ``count``.
        :param to: place where they are written to, at most ``first``.
        :param change: shape (W, d).
        """
        for j in range(len(self.strips)):
            strips, norms = self.strips[j], self._norms[j]
            for low in range(to, self.count, PIECE):
                high = min(low + PIECE, self.count)
                source, target = slice(low + first - to, high + first - to), slice(low, high)
                alive = norms[source, None] > 0
                moved = strips[source] * norms[source, None]
                moved += change[j]
                moved *= alive
                length = moved.norm(dim=1, keepdim=True).clamp_(min=1e-12)
                torch.div(moved, length, out=strips[target])
                norms[target] = (length * alive)[:, 0]
