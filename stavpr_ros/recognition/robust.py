# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Mode robust: options beyond the paper, each a switch against one failure mode.

Everything is causal: only images that have arrived count. The probability of a match has memory,
and successive ones are correlated.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from stavpr_ros.checks import require_choice
from stavpr_ros.compilation import reassociating_kernel
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping.map_statistics import MapStatistics
from stavpr_ros.recognition.blocks import blocks, converted, converted_blocks, PlaceChanges

MODES = ('paper', 'robust')
MIN_PROBABILITY = 0.5  # above which mode robust matches a window
PRIOR = 20  # images that the map's mean counts for in the query's, and at most a standstill
RANK = 64  # directions that whitening shrinks, at most
SAMPLE = 256  # places that whitening is learned from
STRENGTH = 1.5  # of whitening: c in the gains of its directions
LARGE = 0.97  # quantile of changes from place to place
NOISE, SLOW = 0.02, 0.1  # shares of it: of a camera at rest at most, and of a slow one
LEAST_DISTINCT = 5  # places: fewer have no meaningful mean and deviation
MIN_DEVIATION = 1e-3  # standard deviation of a row below which it carries no information


@dataclass(frozen=True)
class RobustOptions:
    """
    Failure modes of the paper's method and their mitigations.

    :param mean_centering: subtract the mean of the map's features from its features, and the
        running mean of the query from the query's: the part shared by all images distinguishes no
        places.
    :param whitening: shrink the directions in which the map's places vary most
        (:class:`Whitening`): a direction that many places share distinguishes few of them.
    :param query_znorm: z-normalize the distances of an image to all places (:func:`z_normalized`):
        certain images are far from all places.
    :param place_filter: follow place and speed with a Bayes filter with a state off the
        map (:mod:`stavpr_ros.recognition.place_filter`) instead of matching each window by LM-DTW,
        where one place may absorb a window.
    """

    mean_centering: bool = True
    whitening: bool = True
    query_znorm: bool = True
    place_filter: bool = True

    @property
    def any(self) -> bool:
        """At least one is on."""
        return any(getattr(self, field.name) for field in fields(self))

    def without(self, *names: str) -> 'RobustOptions':
        """
        Return these options without those of certain names.

        :raises SettingsError: no option of that name.
        """
        known = [field.name for field in fields(self)]
        for name in names:
            require_choice('option', name, known)
        return replace(self, **dict.fromkeys(names, False))


PAPER = RobustOptions(False, False, False, False)
ROBUST = RobustOptions()


def options_of(mode: str) -> RobustOptions:
    """
    Return the options of a mode.

    :raises SettingsError: no such mode.
    """
    require_choice('mode', mode, MODES)
    return ROBUST if mode == 'robust' else PAPER


@dataclass(frozen=True)
class FilterSettings:
    """
    Model of the filter; tuned on the data sets named in docs/robust_mode.md.

    :param speeds: places that the query passes an image; between two, a path costs evidence.
    :param levels: mean z-normalized distance of right places, from bad to good conditions.
    :param weight: alpha of an image that differs from the one before as neighboring places of the
        map do.
    :param most_change, least_change: limits of the change, over that of neighboring places, that
        alpha is multiplied by.
    :param standstill: change, over that of neighboring places, below which the camera is at rest.
    :param keep_level: probability of keeping the level.
    :param keep_speed: probability of keeping the speed.
    :param spread: probability of one place more than the speed's, and of one less.
    :param leave: probability of leaving the map at an image, and enter: of returning to it.
    :param start: probability of starting on the map.
    :param change_deviation: of the logarithm of the change at one speed.
    :param speed_weight: exponent of the likelihood of a speed. Below 1, since successive changes,
        means of five, are not independent.
    """

    speeds: tuple[float, ...] = (0.0, 0.25, 0.33, 0.5, 0.75, 1.0, 1.33, 2.0, 3.0, 4.5)
    levels: tuple[float, ...] = (-1.4, -2.3, -3.4)
    weight: float = 0.28
    most_change: float = 2.0
    least_change: float = 0.2
    standstill: float = 0.1
    keep_level: float = 0.9995
    keep_speed: float = 0.98
    spread: float = 0.05
    leave: float = 0.01
    enter: float = 0.006
    start: float = 0.9
    change_deviation: float = 0.5
    speed_weight: float = 0.25

    def level_changes(self) -> np.ndarray:
        """Return the probability of each level by the one before, (K, K), float32."""
        K = len(self.levels)
        changes = np.zeros((K, K), np.float32)
        for k in range(K):
            neighbors = [j for j in (k - 1, k + 1) if 0 <= j < K]
            changes[k, k] = self.keep_level if neighbors else 1
            changes[k, neighbors] = (1 - changes[k, k]) / max(len(neighbors), 1)
        return changes

    def speed_changes(
        self, weights: np.ndarray, likelihoods: np.ndarray | float = 1.0
    ) -> np.ndarray:
        """
        Return the factors of the speeds for the kernels, (5, V), float32.

        To stay, from the speed below, from the one above, of all by the speed after, and from any
        by the speed before. They include the likelihood of the speed after.

        :param weights: relative probability of each speed for this image, (V,).
        :param likelihoods: of each speed by the latest images relative to that off the map, (V,).
        """
        V = len(self.speeds)
        near, far = (1 - self.keep_speed) * 0.4, (1 - self.keep_speed) * 0.2 / V
        total = self.keep_speed * weights + far * weights.sum()
        total[1:] += near * weights[:-1]
        total[:-1] += near * weights[1:]
        changes = np.zeros((5, V), np.float32)
        changes[0], changes[3], changes[4] = (
            self.keep_speed * weights / total,
            weights,
            far / total,
        )
        changes[1, 1:] = near * weights[1:] / total[:-1]
        changes[2, :-1] = near * weights[:-1] / total[1:]
        changes[:4] *= likelihoods
        return changes


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
    def learned(strips: np.ndarray) -> 'Whitening':
        """Learn from unit-norm features of places, (W, m, d), m > 0."""
        found = [_principal_directions(strip) for strip in strips]  # one by one: less memory
        directions, gains = zip(*found, strict=True)
        return Whitening(np.stack(directions), np.stack(gains))

    def __call__(self, strips: np.ndarray) -> np.ndarray:
        """Return features (W, n, d) with the directions shrunk, of less than unit norm."""
        return self._scaled(strips, self.change)

    def inverse(self, strips: np.ndarray) -> np.ndarray:
        """Return the features that became these."""
        return self._scaled(strips, self._inverse)

    def _scaled(self, strips: np.ndarray, change: np.ndarray) -> np.ndarray:
        parts = strips @ self.directions.transpose(0, 2, 1)
        parts *= change
        scaled: np.ndarray = parts @ self.directions
        scaled += strips
        return scaled


def _principal_directions(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return those of (m, d), at most ``RANK``, (rank, d), float32, and their gains (rank,)."""
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

    :param features: those of the map, strips (W, n, d).
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
        for _, strips in converted_blocks(features, lambda block: block.strips):
            changes.add(strips)
            total += strips.sum(axis=1, dtype=np.float64)
        weights = change_weights(changes.changes[0])
        for places, block in blocks(features) if weights.min(initial=1) < 1 else ():
            total -= (block.strips * (1 - weights[places])[:, None]).sum(axis=1)
        mean = total / max(weights.sum(), 1) * self._centering
        self.mean = mean.astype(np.float32)  # (W, d)
        if whitening and len(features):
            centered = self.places(features[evenly_weighted(weights, SAMPLE)]).strips
            self.whitening = Whitening.learned(centered)

    def reset(self) -> None:
        """Drop the images of the query."""
        # float64: in float32, the images of a long traverse would be rounded away
        self._before = self._sum, self._count = self.mean.astype(np.float64) * PRIOR, PRIOR
        self._standing = 0  # images

    def places(
        self,
        features: LocalFeatures,
        visit: Callable[[np.ndarray], None] = lambda strips: None,
    ) -> LocalFeatures:
        """
        Return features of the map, or of single images, less the map's mean, whitened.

        :param visit: called with the strips of each block.
        """
        return converted(features, lambda strips: self._converted(strips, self.mean), visit)

    def _converted(self, strips: np.ndarray, mean: np.ndarray) -> np.ndarray:
        if strips.shape[1] == 1:
            return self._converted_image(strips[:, 0], mean)[:, None]
        centered = strips - mean[:, None]
        centered[~strips.any(axis=2)] = 0
        normalize(centered)
        return centered if self.whitening is None else normalize(self.whitening(centered))

    def _converted_image(self, strips: np.ndarray, mean: np.ndarray) -> np.ndarray:
        W, d = strips.shape
        directions, change = np.empty((W, 0, d), np.float32), np.empty((W, 1, 0), np.float32)
        if self.whitening is not None:
            directions, change = self.whitening.directions, self.whitening.change
        out: np.ndarray = np.empty((W, d), np.float32)
        arguments = strips, mean, directions, change[:, 0]
        _convert_image(*map(np.ascontiguousarray, arguments), out)
        return out

    def next_query(self, strips: np.ndarray) -> np.ndarray:
        """
        Return the next image's features less the query's running mean, it included, whitened.

        :param strips: shape (W, d); the same is returned.
        """
        self._before = self._sum, self._count
        if self._centering:
            self._sum = self._sum + strips
            self._count += 1
        mean = (self._sum / self._count).astype(np.float32)
        return self._converted(strips[:, None], mean)[:, 0]

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
    norms: np.ndarray = np.sqrt(np.einsum('...d,...d->...', strips, strips))
    return norms


def z_normalized(
    row: np.ndarray, around: int = 0, counted: np.ndarray | None = None
) -> np.ndarray:
    """
    Return a row with mean 0 and deviation 1 of its finite entries, shape (n,), float32.

    :param around: subtract the mean of so many places to either side as well, in which no place
        counts for less than -1, so that the right one counts little. Images of one light are
        nearer to each other than to all others, wherever they were taken. 0 = no.
    :param counted: places whose entries count for mean and deviation, (n,), bool; None = all.
    """
    z = np.empty(len(row), np.float32)
    _z_normalize(row, np.ones(len(row), bool) if counted is None else counted, z)
    if not around:
        return z
    from scipy.ndimage import uniform_filter1d

    clipped = np.where(np.isfinite(z), np.maximum(z, -1), np.float32(0))
    return z - uniform_filter1d(clipped, 2 * around + 1, mode='nearest')


def change_weights(changes: np.ndarray) -> np.ndarray:
    """
    Return how much each place counts, (n,): less where the camera was at rest or slow.

    Nothing below a change from the place before of ``NOISE``, fully above ``SLOW`` of the large
    changes, and in proportion between; the largest, from one drive to another, do not matter.

    :param changes: of each place from the one before, (n,); that of the first does not matter.
    """
    large = float(np.quantile(changes, LARGE, method='lower')) if len(changes) else 0.0
    if not large:
        return np.ones(len(changes))
    weights: np.ndarray = np.clip((changes / large - NOISE) / (SLOW - NOISE), 0, 1)
    weights[:1] = 1
    return weights


# ------------------------------------------------ kernels of one image


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


@reassociating_kernel
def _z_normalize(row: np.ndarray, counted: np.ndarray, z: np.ndarray) -> None:
    """Write a row with mean 0 and deviation 1 of its finite entries, in float64 until then."""
    total, squares, count = 0.0, 0.0, 0
    for i in range(len(row)):
        known = counted[i] & np.isfinite(row[i])
        total += row[i] if known else 0.0
        count += known
    mean = total / max(count, 1)
    for i in range(len(row)):
        off = row[i] - mean
        squares += off * off if counted[i] & np.isfinite(row[i]) else 0.0
    scale = np.float32(1 / max(np.sqrt(squares / max(count, 1)), MIN_DEVIATION))
    for i in range(len(row)):
        z[i] = (row[i] - np.float32(mean)) * scale
