# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where in a city the camera may be: votes of the latest images, along the speeds."""

from collections import deque
from collections.abc import Iterable

import numpy as np

BIN = 8  # places whose votes count together
RANKED = 10  # the place of rank r of an image has 1 / (RANKED + r) votes


class Votes:
    """
    The places nearest to each of the latest images, and what they agree on.

    :param images: latest images that vote.
    :param speeds: places an image.
    """

    def __init__(self, images: int, speeds: Iterable[float]) -> None:
        self._nearest: deque[tuple[int, np.ndarray]] = deque(maxlen=images)
        self._speeds = tuple(speeds)

    def add(self, image: int, places: np.ndarray) -> None:
        """
        Let an image vote.

        :param image: its number.
        :param places: places, nearest first, int64; negative ones do not count.
        """
        self._nearest.append((image, places))

    def best(self, count: int) -> np.ndarray:
        """
        Return where the newest image may be, best first, at most ``count`` places.

        With the place p of an image t images ago, it is at p + v t at speed v. Each image has one
        vote in a bin of ``BIN`` places, for its nearest place there.
        """
        if not self._nearest:
            return np.empty(0, np.int64)
        newest = self._nearest[-1][0]
        places = np.concatenate([near for _, near in self._nearest])
        ages = np.concatenate([np.full(len(near), newest - i) for i, near in self._nearest])
        votes = np.concatenate([1 / (RANKED + np.arange(len(near))) for _, near in self._nearest])
        is_place = places >= 0
        places, ages, votes = places[is_place], ages[is_place], votes[is_place]
        scores: dict[int, float] = {}
        for speed in self._speeds:
            bins = (places + np.rint(speed * ages).astype(np.int64)) // BIN
            _, firsts = np.unique(np.stack([ages, bins]), axis=1, return_index=True)
            numbers, of_bin = np.unique(bins[firsts], return_inverse=True)
            sums = np.bincount(of_bin, votes[firsts])
            for i in np.argsort(-sums, kind='stable')[:count].tolist():
                scores[int(numbers[i])] = max(scores.get(int(numbers[i]), 0), sums[i])
        best = sorted(scores, key=lambda one: (-scores[one], one))[:count]
        return np.array(best, np.int64) * BIN + BIN // 2
