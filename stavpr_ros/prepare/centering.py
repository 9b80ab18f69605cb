# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Mean centering and whitening of features, learned from a map; z-normalization of distances.

A feature x of a strip becomes x - m, with the mean m of the map's features of that strip, the
directions in which places vary most are shrunk, and the norm is 1 again. Images of the query have
the running mean of the query instead: the part that all images of a drive share, its light,
distinguishes no places.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from stavpr_ros.checks import require_shape
from stavpr_ros.compilation import reassociating_kernel
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping.stored_features import MapStatistics
from stavpr_ros.prepare.blocks import (
    change_weights,
    convert_blocks,
    convert_features,
    PlaceChanges,
)

PRIOR = 20  # images that the map's mean counts for in the query's, and at most a standstill
RANK = 64  # directions that whitening shrinks, at most
SAMPLE = 256  # places that whitening is learned from
STRENGTH = 1.5  # of whitening: c in the gains of its directions
ONE_SESSION: np.ndarray = np.zeros(1, np.int64)
MIN_DEVIATION = 1e-3  # standard deviation of a row below which it carries no information


class Whitening:
    """
    Shrinks the directions in which places vary most, for each strip alone.

    With the principal directions u_i of the places and their shares s_i of the variance,

        x -> x + sum_i (g_i - 1) u_i u_i^T x,    g_i = (1 + c s_i / sum_j s_j^2)^(-1/2).

    Shares are relative to their mean, weighted by themselves, so that c has the same meaning for
    all kinds of features. Whitening in full, c to infinity, would make noise of weak directions as
    strong as the others: a map of one light does not show the changes by other lights.

    :param directions: u_i, shape (W, rank, d), float32.
    :param gains: g_i, shape (W, rank), float64.

    ``change`` holds g_i - 1, shape (W, 1, rank), float32.
    """

    def __init__(self, directions: np.ndarray, gains: np.ndarray) -> None:
        self.directions, self.gains = directions, gains
        gains = gains[:, None]
        self.change = (gains - 1).astype(np.float32)
        self._inverse = (1 / gains - 1).astype(np.float32)

    @staticmethod
    def learn(strips: np.ndarray) -> 'Whitening':
        """Learn from unit-norm features of places, (W, m, d), m > 0."""
        learned = [_principal_directions(strip) for strip in strips]  # one by one: less memory
        directions, gains = zip(*learned, strict=True)
        return Whitening(np.stack(directions), np.stack(gains))

    def __call__(self, strips: np.ndarray) -> np.ndarray:
        """Return features (W, n, d) with the directions shrunk, of less than unit norm."""
        return self._scale(strips, self.change)

    def inverse(self, strips: np.ndarray) -> np.ndarray:
        """Return the features that became these."""
        return self._scale(strips, self._inverse)

    def _scale(self, strips: np.ndarray, change: np.ndarray) -> np.ndarray:
        parts = strips @ self.directions.transpose(0, 2, 1)
        parts *= change
        scaled: np.ndarray = parts @ self.directions
        scaled += strips
        return scaled


def _principal_directions(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``RANK`` directions at most of (m, d), (rank, d), float32, and gains (rank,)."""
    samples = features.astype(np.float64)
    # of the places with each other: there are fewer of them than dimensions
    values, vectors = np.linalg.eigh(samples @ samples.T)
    shares = values.clip(0) / max(values.sum(), 1e-12)
    gains = 1 / np.sqrt(1 + STRENGTH * shares / max((shares**2).sum(), 1e-12))
    directions = vectors[:, -RANK:].T @ samples
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-9)
    return directions.astype(np.float32), gains[-RANK:]


class MeanCentering:
    """
    Subtracts the part of the features that all images of a traverse share, and whitens the rest.

    Features have unit norm again afterwards; zero features stay zero. All images of a camera at
    rest count as one: the mean would become its place.

    :param features: of the map, strips (W, n, d).
    :param centering, whitening: which of the two to apply.
    :param statistics: learned from the features before, for both; None = learn them.
    """

    def __init__(
        self,
        features: LocalFeatures,
        centering: bool = True,
        whitening: bool = True,
        statistics: MapStatistics | None = None,
    ) -> None:
        self._centering = centering
        self.whitening: Whitening | None = None
        if statistics is not None:
            self.mean = statistics.mean
            self.whitening = Whitening(statistics.directions, statistics.gains)
        else:
            self._learn(features, whitening)
        self.reset()

    def _learn(self, features: LocalFeatures, whitening: bool) -> None:
        total = np.zeros((len(features.weights), features.dimension))
        changes = PlaceChanges(len(features), 1)
        for _, strips in convert_blocks(features, lambda block: block.strips):
            changes.add(strips)
            total += strips.sum(axis=1, dtype=np.float64)
        weights = change_weights(changes.changes[0])
        if weights.min(initial=1) < 1:
            for places, strips in convert_blocks(features, lambda block: block.strips):
                total -= (strips * (1 - weights[places])[:, None]).sum(axis=1)
        mean = total / max(weights.sum(), 1) * self._centering
        self.mean = mean.astype(np.float32)  # (W, d)
        if whitening and len(features):
            centered = self.places(features[evenly_weighted(weights, SAMPLE)]).strips
            self.whitening = Whitening.learn(centered)

    def reset(self) -> None:
        """Drop the images of the query."""
        # float64: in float32, the images of a long traverse would be rounded away
        self._before = self._sum, self._count = self.mean.astype(np.float64) * PRIOR, PRIOR
        self._standing = 0  # images

    def places(
        self,
        features: LocalFeatures,
        visit: Callable[[np.ndarray], None] = lambda strips: None,
        rounds: bool = False,
    ) -> LocalFeatures:
        """
        Return features of the map, or of single images, less the map's mean, whitened.

        :param visit, rounds: see :func:`stavpr_ros.prepare.blocks.convert_features`.
        """
        convert = partial(self._convert, mean=self.mean)
        return convert_features(features, convert, visit, rounds)

    def _convert(self, strips: np.ndarray, mean: np.ndarray) -> np.ndarray:
        W, m, d = strips.shape
        if m == 1:
            directions, change = np.empty((W, 0, d), np.float32), np.empty((W, 1, 0), np.float32)
            if self.whitening is not None:
                directions, change = self.whitening.directions, self.whitening.change
            arguments, out = (strips[:, 0], mean, directions, change[:, 0]), np.empty_like(mean)
            _convert_image(*map(np.ascontiguousarray, arguments), out)
            return out[:, None]
        centered = strips - mean[:, None]
        centered[~strips.any(axis=2)] = 0
        normalize(centered)
        return centered if self.whitening is None else normalize(self.whitening(centered))

    def next_query(self, strips: np.ndarray) -> np.ndarray:
        """
        Return the next image's features less the query's running mean, it included, whitened.

        :param strips: shape (W, d); the same is returned.
        """
        W, d = self.mean.shape
        require_shape('strips', strips, f'{W} {d}')
        self._before = self._sum, self._count
        if self._centering:
            self._sum = self._sum + strips
            self._count += 1
        mean = (self._sum / self._count).astype(np.float32)
        return self._convert(strips[:, None], mean)[:, 0]

    def note_standstill(self, is_standing: bool) -> None:
        """
        Count the newest image as one of a standstill, or end that.

        Of a standstill, ``PRIOR`` images count: else its place would be the mean.
        """
        self._standing = self._standing + 1 if is_standing else 0
        if self._standing > PRIOR:
            self._sum, self._count = self._before


def evenly(n: int, count: int) -> np.ndarray:
    """Return at most ``count`` places of n, evenly spaced, int64."""
    return np.unique(np.linspace(0, max(n - 1, 0), min(n, count)).astype(np.int64))


def evenly_weighted(weights: np.ndarray, count: int) -> np.ndarray:
    """Return at most ``count`` places, evenly spaced by their weights, 1 at most, int64."""
    sums = weights.cumsum()
    return np.unique(np.searchsorted(sums, evenly(int(sums[-1]), count) + 0.5))


def unit_norm(strips: np.ndarray) -> np.ndarray:
    """Return features (..., d) with unit norm; zero ones stay zero."""
    return normalize(strips.copy())


def normalize(strips: np.ndarray) -> np.ndarray:
    """Give features (..., d) unit norm, in place, and return them; zero ones stay zero."""
    strips /= norms_of(strips)[..., None].clip(1e-12)
    return strips


def norms_of(strips: np.ndarray) -> np.ndarray:
    """Return the norms of features (..., d), shape (...)."""
    return np.sqrt(np.einsum('...d,...d->...', strips, strips))


@reassociating_kernel
def _convert_image(
    strips: np.ndarray,
    mean: np.ndarray,
    directions: np.ndarray,
    change: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write an image (W, d) less a mean, whitened (W, rank, d), (W, rank), of unit norm."""
    for j in range(len(strips)):
        x, y = strips[j], out[j]
        alive = np.float32(x.any())
        for t in range(len(y)):
            y[t] = alive * (x[t] - mean[j, t])
        parts = np.empty(directions.shape[1], np.float32)
        for i in range(len(parts)):
            direction, part = directions[j, i], np.float32(0)
            for t in range(len(y)):
                part += direction[t] * y[t]
            parts[i] = part * change[j, i]
        for i in range(len(parts)):
            direction, part = directions[j, i], parts[i]
            for t in range(len(y)):
                y[t] += part * direction[t]
        squares = np.float32(0)
        for t in range(len(y)):
            squares += y[t] * y[t]
        norm = max(np.sqrt(squares), np.float32(1e-12))
        for t in range(len(y)):
            y[t] /= norm


# ------------------------------------------------ distances


def z_normalized(
    row: np.ndarray,
    around: int = 0,
    counted: np.ndarray | None = None,
    firsts: np.ndarray = ONE_SESSION,
) -> np.ndarray:
    """
    Return a row with mean 0 and deviation 1 of its finite entries, shape (n,), float32.

    :param around: subtract the mean of so many places to either side as well, in which no place
        counts for less than -1, so that the right one counts little. Images of one light are
        nearer to each other than to all others, wherever they were taken. 0 = no.
    :param counted: places whose entries count for mean and deviation, (n,), bool; None = all.
    :param firsts: first places of parts that are normalized each by itself, (m,), int64.
    """
    z = np.empty(len(row), np.float32)
    counted = np.ones(len(row), bool) if counted is None else counted
    require_shape('counted', counted, f'{len(row)}', 'bool')
    _z_normalize(row, counted, firsts, z)
    if not around:
        return z
    from scipy.ndimage import uniform_filter1d

    clipped = np.where(np.isfinite(z), np.maximum(z, -1), np.float32(0))
    for part in np.split(clipped, firsts[1:]):
        part[:] = uniform_filter1d(part, 2 * around + 1, mode='nearest')
    return z - clipped


@reassociating_kernel
def _z_normalize(row: np.ndarray, counted: np.ndarray, firsts: np.ndarray, z: np.ndarray) -> None:
    """Write parts with mean 0 and deviation 1 of finite entries, in float64 until then."""
    for part in range(len(firsts)):
        end = firsts[part + 1] if part + 1 < len(firsts) else len(row)
        # slices: loops over them are vectorized
        x, own = row[firsts[part] : end], counted[firsts[part] : end]
        total, squares, count = 0.0, 0.0, 0
        for i in range(len(x)):
            counts = own[i] & np.isfinite(x[i])
            total += x[i] if counts else 0.0
            count += counts
        mean = total / max(count, 1)
        for i in range(len(x)):
            off = x[i] - mean
            squares += off * off if own[i] & np.isfinite(x[i]) else 0.0
        scale = np.float32(1 / max(np.sqrt(squares / max(count, 1)), MIN_DEVIATION))
        out = z[firsts[part] : end]
        for i in range(len(x)):
            out[i] = (x[i] - np.float32(mean)) * scale
