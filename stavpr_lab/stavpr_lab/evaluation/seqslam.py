# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
SeqSLAM, a baseline, implemented from its paper.

M. Milford, G. Wyeth, "SeqSLAM: Visual Route-Based Navigation for Sunny Summer Days and Stormy
Winter Nights", ICRA 2012. Small patch-normalized images, the sum of absolute differences, local
contrast enhancement along the map, straight lines at several speeds through the enhanced
differences.
"""

from collections.abc import Iterable
from dataclasses import dataclass
import math

import cv2
import numpy as np
from scipy.spatial.distance import cdist


@dataclass(frozen=True)
class SeqSlamSettings:
    """
    The paper's parameters.

    :param width: width of the small images, pixels (Rx).
    :param height: height of the small images, pixels (Ry).
    :param patch: side of the squares that are normalized, pixels; divides width and height.
    :param contrast_window: places around each one, half before and half after, whose differences
        normalize its own (R_window); >= 2.
    :param length: images in a window (ds), >= 1.
    :param slowest, fastest: map images per query image (V_min, V_max), 0 < slowest <= fastest.
    :param speed_step: between the speeds of the search (V_step), > 0.
    """

    width: int = 64
    height: int = 32
    patch: int = 8
    contrast_window: int = 10
    length: int = 20
    slowest: float = 0.8
    fastest: float = 1.2
    speed_step: float = 0.1

    @property
    def middle(self) -> int:
        """Position in the window of its middle image: floor((first + last) / 2)."""
        return (self.length - 1) // 2

    @property
    def lines(self) -> np.ndarray:
        """Map images after the start by speed and position in the window, (speeds, length)."""
        count = math.floor((self.fastest - self.slowest) / self.speed_step + 1e-9) + 1
        speeds = self.slowest + self.speed_step * np.arange(count)
        return np.floor(speeds[:, None] * np.arange(self.length) + 0.5 + 1e-9).astype(np.int64)


def seqslam(
    map_images: Iterable[np.ndarray],
    query_images: Iterable[np.ndarray],
    settings: SeqSlamSettings | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Match each query image with the map.

    :param map_images: n images, at least one: uint8, RGB (h, w, 3) or gray (h, w).
    :param query_images: N of the same kind.
    :returns: see :func:`match_differences`.
    """
    settings = settings or SeqSlamSettings()
    places = preprocess(map_images, settings)
    return match_differences(differences(preprocess(query_images, settings), places), settings)


def match_differences(D: np.ndarray, settings: SeqSlamSettings) -> tuple[np.ndarray, np.ndarray]:
    """
    Match each query image with the map from the differences of the images, contrast enhanced.

    :param D: differences, shape (N, n), finite, float32 or float64; row = query image, in order.
    :returns: see :func:`match_lines`.
    """
    return match_lines(enhance_contrast(D, settings.contrast_window), settings)


def match_lines(D: np.ndarray, settings: SeqSlamSettings) -> tuple[np.ndarray, np.ndarray]:
    """
    Match each query image with the map along straight lines through differences.

    A window of ``length`` query images is compared with every straight line through the map; the
    window's middle image takes its place from the best line. The first and last images, which are
    in the middle of no window, take place and score from the line of the first and last window, as
    in the sequences of this package (in the paper they have none).

    :param D: differences, shape (N, n), finite, float32 or float64; row = query image, in order.
    :returns: places, shape (N,), int64, and scores, shape (N,), float64, lower is better; -1 and
        +inf where there are too few images for a window, or too few places for a line.
    """
    N, n = D.shape
    places, scores = np.full(N, -1, np.int64), np.full(N, np.inf)
    windows = N - settings.length + 1
    if windows < 1 or n <= settings.lines[:, -1].min():
        return places, scores
    totals = np.full((len(settings.lines), windows, n), np.inf, D.dtype)
    for total, line in zip(totals, settings.lines, strict=True):
        starts = max(0, n - line[-1])  # starts whose line ends inside the map
        total[:, :starts] = 0
        for position, offset in enumerate(line if starts else ()):
            total[:, :starts] += D[position : position + windows, offset : offset + starts]
    rows, starts = np.arange(windows), totals.min(axis=0).argmin(axis=1)
    speeds = totals[:, rows, starts].argmin(axis=0)  # the slowest on a tie
    lines = settings.lines[speeds] + starts[:, None]
    means = totals[speeds, rows, starts] / settings.length
    middle = settings.middle
    places[middle : middle + windows] = lines[:, middle]
    scores[middle : middle + windows] = means
    places[:middle], scores[:middle] = lines[0, :middle], means[0]
    places[middle + windows :], scores[middle + windows :] = lines[-1, middle + 1 :], means[-1]
    return places, scores


def preprocess(images: Iterable[np.ndarray], settings: SeqSlamSettings) -> np.ndarray:
    """
    Return small patch-normalized images: in every patch the mean is 0 and the deviation 1.

    :returns: shape (images, height * width), float32; a patch of one gray level is 0.
    """
    return np.stack([_normalize_patches(image, settings) for image in images])


def _normalize_patches(image: np.ndarray, settings: SeqSlamSettings) -> np.ndarray:
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    shrinks = gray.shape[0] >= settings.height and gray.shape[1] >= settings.width
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    small = cv2.resize(gray, (settings.width, settings.height), interpolation=method).astype(
        np.float32
    )
    side = settings.patch
    patches = small.reshape(settings.height // side, side, settings.width // side, side)
    patches = patches - patches.mean(axis=(1, 3), keepdims=True)
    deviations = np.sqrt(np.mean(patches**2, axis=(1, 3), keepdims=True))
    return (patches / np.where(deviations > 0, deviations, 1)).reshape(-1)


def differences(queries: np.ndarray, places: np.ndarray) -> np.ndarray:
    """
    Return the mean absolute difference of every query and every place.

    :param queries: shape (N, pixels), float32.
    :param places: shape (n, pixels), float32.
    :returns: D, shape (N, n), float32.
    """
    sums = cdist(queries, places, 'cityblock')
    return (sums / queries.shape[1]).astype(np.float32)


def enhance_contrast(D: np.ndarray, window: int) -> np.ndarray:
    """
    Normalize each difference by the differences of places around it: (D - mean) / deviation.

    :param D: shape (N, n).
    :param window: half of it before the place and half after; less at the map's ends.
    :returns: shape (N, n), of the same type; 0 where all the differences around are equal.
    """
    n = D.shape[1]
    firsts = np.maximum(np.arange(n) - window // 2, 0)
    ends = np.minimum(np.arange(n) + window // 2 + 1, n)
    result = np.empty_like(D)
    for i, row in enumerate(D):  # a row at a time: the sums need float64, the matrix is large
        centered = row.astype(np.float64) - row.mean(dtype=np.float64)
        sums = np.concatenate([[0.0], np.cumsum(centered)])
        squares = np.concatenate([[0.0], np.cumsum(centered**2)])
        count = ends - firsts
        mean = (sums[ends] - sums[firsts]) / count
        variance = (squares[ends] - squares[firsts]) / count - mean**2
        # rounding leaves small variances where all are equal
        flat = variance <= 1e-12 * (squares[-1] / n)
        result[i] = np.where(flat, 0, (centered - mean) / np.sqrt(np.where(flat, 1, variance)))
    return result
