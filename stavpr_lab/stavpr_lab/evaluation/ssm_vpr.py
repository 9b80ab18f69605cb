# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
SSM-VPR, a baseline, and its second stage as a re-ranker of any candidates.

L. G. Camara, L. Preucil, "Visual Place Recognition by Spatial Matching of High-level CNN
Features", Robotics and Autonomous Systems 133, 2020. Two feature maps of one network (in the
paper conv5_2, 14 x 14, and conv4_2, 28 x 28, of a VGG16 trained on Places365):

1. All cubes of 9 x 9 cells of the first map, PCA whitened to 125 dimensions; each cube of the
   query votes for the images of its 50 nearest cubes of the map; the 50 images with most votes
   are the candidates.
2. Cubes of 3 x 3 cells of the second map, PCA whitened to 100 dimensions. Each cube of a candidate
   is matched with the nearest one of the query. The score counts the pairs of cubes at most 9
   cells apart that are displaced equally, over the count of an image with itself: 1 for equal
   images.
3. Candidates near the last two answers weigh more (frame correlation).

Where the paper is silent, this is as the authors' program, except: nearest in stage 2 is by
cosine, so that an image matches itself; displacements are compared in two coordinates, not as
numbers of cells, which run on from row to row.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.prepare.centering import evenly
import torch
from torch.nn.functional import normalize

SAMPLE = 1000  # cubes that a whitening is learned from


@dataclass(frozen=True)
class SsmVprSettings:
    """
    The paper's parameters.

    :param large, small: cells along a side of the cubes of stage 1 and 2.
    :param large_dimension, small_dimension: dimensions of the whitened cubes.
    :param neighbors: cubes of the map that a cube of the query votes for.
    :param candidates: images that stage 2 compares.
    :param memory: last answers that frame correlation uses.
    :param gain: most additional weight of a candidate.
    :param reach: places from an answer at which that weight is 0.
    """

    large: int = 9
    small: int = 3
    large_dimension: int = 125
    small_dimension: int = 100
    neighbors: int = 50
    candidates: int = 50
    memory: int = 2
    gain: float = 0.4
    reach: int = 15


def cubes(maps: torch.Tensor, side: int) -> torch.Tensor:
    """
    Cut feature maps into overlapping cubes, each column of channels of unit norm.

    :param maps: shape (n, C, H, Wf).
    :returns: shape (n, P, side * side * C), the P = (H - side + 1) (Wf - side + 1) cubes row by
        row.
    :raises InputError: maps smaller than a cube.
    """
    if maps.ndim != 4 or min(maps.shape[2:]) < side:
        raise InputError(
            f'feature maps have shape {tuple(maps.shape)}: expected (n, C, H, W) of at least '
            f'{side} x {side} cells'
        )
    columns = normalize(maps.float(), dim=1)
    windows = columns.unfold(2, side, 1).unfold(3, side, 1)  # (n, C, H', W', side, side)
    return windows.permute(0, 2, 3, 4, 5, 1).flatten(1, 2).flatten(2)


class PcaWhitening:
    """
    PCA whitening, learned from samples.

    :param samples: shape (m, D).
    :param dimension: dimensions of the result, at most; fewer where the samples have fewer.
    """

    def __init__(self, samples: torch.Tensor, dimension: int) -> None:
        self._mean = samples.mean(dim=0)
        centered = samples - self._mean
        values, vectors = torch.linalg.eigh((centered @ centered.T).double())
        rank = min(dimension, int((values > values[-1] * 1e-9).sum()))
        values, vectors = values[-rank:].flip(0), vectors[:, -rank:].flip(1)
        axes = centered.T @ (vectors / values.sqrt()).float()  # unit norm, (D, kept)
        self._matrix = axes / (values / (len(samples) - 1)).sqrt().float()

    def __call__(self, vectors: torch.Tensor) -> torch.Tensor:
        """Return vectors (..., D) whitened, (..., dimension)."""
        return (vectors - self._mean) @ self._matrix


def learn_whitening(maps: torch.Tensor, side: int, dimension: int) -> PcaWhitening:
    """Learn the whitening of cubes from samples, spread over all images and places."""
    n = len(maps)
    per_image = -(-SAMPLE // n)
    rng = np.random.default_rng(0)
    samples = []
    for i in evenly(n, SAMPLE):
        vectors = cubes(maps[i : i + 1], side)[0]
        indices = rng.choice(len(vectors), min(per_image, len(vectors)), replace=False)
        samples.append(vectors[torch.from_numpy(indices)])
    return PcaWhitening(torch.cat(samples), dimension)


class SpatialReranker:
    """
    Stage 2: how many anchors of two images are displaced equally.

    :param maps: feature maps of the map's images, shape (n, C, S, S).
    """

    def __init__(self, maps: torch.Tensor, settings: SsmVprSettings | None = None) -> None:
        self._settings = settings = settings or SsmVprSettings()
        self._whitening = learn_whitening(maps, settings.small, settings.small_dimension)
        self._places = torch.stack([self._anchors(feature_map) for feature_map in maps])
        self.side = maps.shape[2] - settings.small + 1
        if maps.shape[2] != maps.shape[3]:
            raise InputError(f'feature maps have shape {tuple(maps.shape)}: expected square ones')
        patch = int(self.side * 0.75)
        self.reach = (patch - 1 + patch % 2) // 2  # 9 of 26 cells
        self._own = self.agreement(np.arange(self.side**2)[None])[0]

    def _anchors(self, one: torch.Tensor) -> torch.Tensor:
        vectors = self._whitening(cubes(one[None], self._settings.small)[0])
        return normalize(vectors, dim=1)

    def scores(self, query: torch.Tensor, candidates: np.ndarray) -> np.ndarray:
        """
        Score candidates against a query image.

        :param query: its map, shape (C, S, S).
        :param candidates: places, shape (K,).
        :returns: shape (K,), 1 for equal images, float64.
        """
        anchors = self._anchors(query)
        places = self._places[torch.from_numpy(candidates)]
        nearest = (places @ anchors.T).argmax(dim=2)  # (K, P): the query's cube
        return self.agreement(nearest.numpy()) / self._own

    def agreement(self, nearest: np.ndarray) -> np.ndarray:
        """
        Count pairs of cubes near each other that are displaced equally, each cube with itself too.

        :param nearest: number of the matched cube of each cube, shape (K, P).
        :returns: shape (K,).
        """
        side, reach = self.side, self.reach
        rows, columns = np.divmod(nearest.reshape(-1, side, side), side)
        down = rows - np.arange(side)[:, None]
        right = columns - np.arange(side)
        # one number a displacement; their range is -side .. side
        displacement = (down * (4 * side) + right).astype(np.int32)
        total = np.zeros(len(displacement), np.int64)
        for u in range(reach + 1):
            for v in range(-reach if u else 0, reach + 1):
                one = displacement[:, : side - u, max(0, -v) : side - max(0, v)]
                other = displacement[:, u:, max(0, v) : side - max(0, -v)]
                equal = (one == other).sum(axis=(1, 2))
                total += equal if u == v == 0 else 2 * equal  # the pair counts in both orders
        return total


@dataclass
class SsmVpr:
    """
    The whole method: places of query images, one after the other.

    :param first: maps of stage 1 of the map's images, shape (n, C, H, W).
    :param second: maps of stage 2, shape (n, C, S, S).
    """

    first: torch.Tensor
    second: torch.Tensor
    settings: SsmVprSettings = field(default_factory=SsmVprSettings)

    def __post_init__(self) -> None:
        settings = self.settings
        self.reranker = SpatialReranker(self.second, settings)
        self._whitening = learn_whitening(self.first, settings.large, settings.large_dimension)
        vectors = [self._whitening(cubes(maps[None], settings.large)[0]) for maps in self.first]
        self._image = np.repeat(np.arange(len(vectors)), len(vectors[0]))
        self._cubes = torch.cat(vectors)
        self._answers: deque[tuple[int, float]] = deque(maxlen=settings.memory)

    def candidates(self, query: torch.Tensor) -> np.ndarray:
        """
        Stage 1: the images with most votes, most first; of equal ones the lower number.

        :param query: its map, shape (C, H, W).
        """
        own = self._whitening(cubes(query[None], self.settings.large)[0])
        count = min(self.settings.neighbors, len(self._cubes))
        nearest = torch.cdist(own, self._cubes).topk(count, largest=False).indices.numpy()
        votes = np.bincount(self._image[nearest.ravel()], minlength=len(self.first))
        return np.argsort(-votes, kind='stable')[: self.settings.candidates]

    def recognize(
        self, first: torch.Tensor, second: torch.Tensor
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Match the next image.

        :param first, second: its two maps, shapes (C, H, W) and (C, S, S).
        :returns: candidates, best first, and their scores, shape (K,) each.
        """
        places = self.candidates(first)
        scores = self.reranker.scores(second, places) * self.weights(places)
        order = np.argsort(-scores, kind='stable')
        self._answers.append((int(places[order[0]]), float(scores[order[0]])))
        return places[order], scores[order]

    def weights(self, places: np.ndarray) -> np.ndarray:
        """Return the weight of each place by the last answers, at least 1, shape (K,)."""
        settings, best = self.settings, np.zeros(len(places))
        if len(self._answers) < settings.memory:
            return 1 + best
        strongest = max(score for _, score in self._answers)
        for answer, score in self._answers:
            strength = score / strongest if strongest > 0 else 1.0
            near = np.clip(settings.reach - abs(places - answer), 0, None) / settings.reach
            best = np.maximum(best, strength * settings.gain * near)
        return 1 + best
