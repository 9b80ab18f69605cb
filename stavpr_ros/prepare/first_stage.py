# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A first stage for maps too large to be compared exactly within a time budget.

Every strip of every place is reduced to a few principal components, so that an image is one vector
of ``BYTES`` bytes. The *coarse* distance of two images is 1 less their largest cosine similarity,
when one is shifted against the other by whole strips. It is computed for all places. Exact
distances are computed in chunks of places: where coarse distances are smallest, where the place
filter finds places probable after the images so far, and a fixed sample. Mean and deviation of
the sample scale the coarse distances to exact ones, so that z-normalization, the filter and the
second best have one row with an entry for every place.
"""

from collections.abc import Callable

import numpy as np
from stavpr_ros.alignment.cpu import int8
from stavpr_ros.alignment.cpu.int8 import Int8Strips, TILE
from stavpr_ros.features import LocalFeatures
from stavpr_ros.filter.paths import BLOCK
from stavpr_ros.prepare.blocks import Int8Features
from stavpr_ros.prepare.centering import evenly, normalize
from stavpr_ros.prepare.cpu_matcher import CpuMatcher
from stavpr_ros.prepare.normalization import MIN_DEVIATION

BYTES = 128  # of a place, at most
LEARNED = 2048  # places that the components are learned from
PIECE = 1024  # places reduced at a time
CHUNK = 32  # places compared exactly together; a multiple of all LANES
SAMPLED, NEAREST = 128, 512  # chunks of the sample, and of small coarse distances


class FirstStage:
    """
    A matcher that compares images with few places exactly, see the module.

    :param matcher: compares with the places exactly, strategies that align strips.
    :param features: of the places, as the matcher has them.
    :param probable: returns the first places of the blocks of ``BLOCK`` places that the filter
        finds probable.
    """

    def __init__(
        self,
        matcher: CpuMatcher,
        features: LocalFeatures | Int8Features,
        probable: Callable[[], np.ndarray],
    ) -> None:
        self._matcher, self._probable = matcher, probable
        W, n, d = features.strips.shape
        self.places = n
        learned = features.strips[:, evenly(n, LEARNED)]
        _, vectors = np.linalg.eigh(learned.transpose(0, 2, 1) @ learned)
        self._basis = vectors[..., -min(d, max(1, BYTES // W)) :]  # (W, d, p)
        self._reduced = Int8Strips(1, n, W * self._basis.shape[2])
        for low in range(0, n, PIECE):
            reduced = normalize(features.strips[:, low : low + PIECE] @ self._basis)
            by_place = reduced.transpose(1, 0, 2).reshape(1, reduced.shape[1], -1)  # (1, m, W p)
            self._reduced.write(low, np.ascontiguousarray(by_place))
        self._chunks = -(-n // CHUNK)
        self._sample = evenly(self._chunks, SAMPLED)

    def strips_of(self, places: np.ndarray) -> np.ndarray:
        """Return the strips of places, (W, m, d)."""
        return self._matcher.strips_of(places)

    def distances(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the distances of one image to every place, (n,); exact ones where they count."""
        rows = np.full((self._chunks, CHUNK), np.inf, np.float32)
        out, nearest = rows.ravel()[: self.places], np.empty(self._chunks, np.float32)
        query = int8.tiled(self._shifted(strips)[:, None])
        int8.smallest_distances(self._reduced.kernel_arguments(), query, CHUNK, out, nearest)
        coarse = rows[self._sample]
        chunks = np.union1d(self._sample, self._candidates(nearest))
        exact = self._matcher.distances_at(strips, chunks * CHUNK, CHUNK)
        sampled = exact[np.searchsorted(chunks, self._sample)]
        coarse, sampled = (each[np.isfinite(each)] for each in (coarse, sampled))
        scale = sampled.std() / max(coarse.std(), np.float32(MIN_DEVIATION))
        out *= scale
        out += sampled.mean() - scale * coarse.mean()
        rows[chunks] = exact
        return out

    def distance_matrix(self, strips: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the exact distances of Q images to every place, (Q, n)."""
        return self._matcher.distance_matrix(strips, weights)

    def _candidates(self, nearest: np.ndarray) -> np.ndarray:
        count = min(NEAREST, self._chunks)
        near = np.argpartition(nearest, count - 1)[:count]
        # a camera that moves on leaves its block by a chunk at most
        probable = (self._probable() // CHUNK)[:, None] + np.arange(BLOCK // CHUNK + 1)
        return np.append(near, probable[probable < self._chunks])

    def _shifted(self, strips: np.ndarray) -> np.ndarray:
        """
        Return an image, shifted by up to so many strips that one tile has, reduced as places are.

        :param strips: shape (W, d).
        :returns: shape (shifts, W p).
        """
        W, _, p = self._basis.shape
        most = min(W - 1, TILE // 2)
        rows = np.zeros((2 * most + 1, W, p), np.float32)
        for shift in range(-most, most + 1):
            places = slice(max(0, -shift), min(W, W - shift))  # strips of a place
            shifted = strips[places.start + shift : places.stop + shift, None]
            rows[shift + most, places] = (shifted @ self._basis[places])[:, 0]
        return rows.reshape(len(rows), -1)
