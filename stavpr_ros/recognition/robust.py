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
from scipy.ndimage import uniform_filter1d
from stavpr_ros.checks import require_choice
from stavpr_ros.compilation import reassociating_kernel
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping.map_statistics import MapStatistics
from stavpr_ros.recognition.blocks import (
    blocks,
    converted,
    converted_blocks,
    one_thread,
    PlaceChanges,
)
import torch

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

    :param speeds: places that the query passes an image.
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

    speeds: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0, 1.33, 2.0, 3.0, 4.5)
    levels: tuple[float, ...] = (-1.4, -2.3, -3.4)
    weight: float = 0.28
    most_change: float = 2.0
    least_change: float = 0.2
    standstill: float = 0.1
    keep_level: float = 0.9995
    keep_speed: float = 0.98
    spread: float = 0.05
    leave: float = 0.01
    enter: float = 0.003
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

    def __init__(self, directions: torch.Tensor, gains: torch.Tensor) -> None:
        self.directions, self.gains = directions, gains
        gains = gains[:, None]
        self.change, self._inverse = (gains - 1).float(), (1 / gains - 1).float()

    @staticmethod
    def learned(strips: torch.Tensor) -> 'Whitening':
        """Learn from unit-norm features of places, (W, m, d), m > 0."""
        with one_thread():  # so that the result does not depend on how many there are
            found = [_principal_directions(strip) for strip in strips]  # one by one: less memory
        directions, gains = zip(*found, strict=True)
        return Whitening(torch.stack(directions), torch.stack(gains))

    def __call__(self, strips: torch.Tensor) -> torch.Tensor:
        """Return features (W, n, d) with the directions shrunk, of less than unit norm."""
        return self._scaled(strips, self.change)

    def inverse(self, strips: torch.Tensor) -> torch.Tensor:
        """Return the features that became these."""
        return self._scaled(strips, self._inverse)

    def _scaled(self, strips: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
        if strips.shape[1] == 1 and not strips.is_cuda:  # torch would wake its threads for it
            strip, directions = strips.numpy(), self.directions.numpy()
            parts = (strip @ directions.transpose(0, 2, 1)) * change.numpy()
            return torch.from_numpy(strip + parts @ directions)
        parts = torch.bmm(strips, self.directions.mT) * change
        return torch.baddbmm(strips, parts, self.directions)

    def to(self, device: torch.device) -> 'Whitening':
        """Return this, moved to a device."""
        for name in ('directions', 'change', '_inverse'):
            setattr(self, name, getattr(self, name).to(device))
        return self


def _principal_directions(features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return those of (m, d), at most ``RANK``, (rank, d), float32, and their gains (rank,)."""
    samples = features.double()
    # of the places with each other: there are fewer of them than dimensions
    values, vectors = torch.linalg.eigh(samples @ samples.T)
    shares = values.clamp(min=0) / values.sum().clamp(min=1e-12)
    gains = torch.rsqrt(1 + STRENGTH * shares / (shares**2).sum().clamp(min=1e-12))
    directions = vectors[:, -RANK:].T @ samples
    directions /= directions.norm(dim=1, keepdim=True).clamp_(min=1e-9)
    return directions.float(), gains[-RANK:]


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
            self.mean = torch.from_numpy(statistics.mean)
            found = torch.from_numpy(statistics.directions), torch.from_numpy(statistics.gains)
            self.whitening = Whitening(*found)
        else:
            self._learn(features, whitening)
        self.reset()

    def _learn(self, features: LocalFeatures, whitening: bool) -> None:
        total = torch.zeros((len(features.weights), features.dimension), dtype=torch.float64)
        total = total.to(features.weights.device)
        changes = PlaceChanges(len(features), 1)
        for _, strips in converted_blocks(features, lambda block: block.strips):
            changes.add(strips)
            total += strips.sum(dim=1)
        weights = change_weights(changes.changes[0])
        for places, block in blocks(features) if weights.min(initial=1) < 1 else ():
            less = torch.from_numpy(1 - weights[places]).to(total.device)
            total -= (block.strips * less[:, None]).sum(dim=1)
        self.mean = (total / max(weights.sum(), 1)).float() * self._centering  # (W, d)
        if whitening and len(features):
            centered = self.places(features[evenly_weighted(weights, SAMPLE)]).strips
            self.whitening = Whitening.learned(centered.cpu()).to(centered.device)

    def reset(self) -> None:
        """Drop the images of the query."""
        # float64: in float32, the images of a long traverse would be rounded away
        self._before = self._sum, self._count = self.mean.double() * PRIOR, PRIOR
        self._standing = 0  # images

    def places(
        self,
        features: LocalFeatures,
        visit: Callable[[torch.Tensor], None] = lambda strips: None,
    ) -> LocalFeatures:
        """
        Return features of the map, or of single images, less the map's mean, whitened.

        :param visit: called with the strips of each block.
        """
        return converted(features, lambda strips: self._converted(strips, self.mean), visit)

    def _converted(self, strips: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
        if strips.shape[1] == 1 and not strips.is_cuda:
            return self._converted_image(strips[:, 0], mean)[:, None]
        centered = strips - mean[:, None]
        centered *= strips.any(dim=2, keepdim=True)
        normalize(centered)
        return centered if self.whitening is None else normalize(self.whitening(centered))

    def _converted_image(self, strips: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
        W, d = strips.shape
        directions, change = torch.empty((W, 0, d)), torch.empty((W, 1, 0))
        if self.whitening is not None:
            directions, change = self.whitening.directions, self.whitening.change
        out = np.empty((W, d), np.float32)
        arguments = strips, mean, directions, change[:, 0]
        _convert_image(*(each.contiguous().numpy() for each in arguments), out)
        return torch.from_numpy(out)

    def next_query(self, strips: torch.Tensor) -> torch.Tensor:
        """
        Return the next image's features less the query's running mean, it included, whitened.

        :param strips: shape (W, d); the same is returned.
        """
        strips = strips.to(self.mean.device)
        self._before = self._sum, self._count
        if self._centering:
            self._sum = self._sum + strips
            self._count += 1
        return self._converted(strips[:, None], (self._sum / self._count).float())[:, 0]

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


def unit_norm(strips: torch.Tensor) -> torch.Tensor:
    """Return features (..., d) with unit norm; zero ones stay zero."""
    return normalize(strips.clone())


def normalize(strips: torch.Tensor) -> torch.Tensor:
    """Give features (..., d) unit norm, in place, and return them; zero ones stay zero."""
    strips /= strips.norm(dim=-1, keepdim=True).clamp_(min=1e-12)
    return strips


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
        y[:] = alive * (x - mean[j])
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
        y /= max(np.sqrt(squares), np.float32(1e-12))


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
