# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The lateral offset in meters: the parallax of an image over the expansion of the map's images.

Where a camera drives d meters forward, the scene at the position u in -1..1 of the image moves
outward by d c u (AHEAD + |u|) half widths, and where it drives t meters to the left, by
2 f t c (DISTANT + |u|) to the right, if c = 1 / (2 f X) for a scene X meters beside the path and
a focal length of f widths. c, the expansion per meter, follows from images of the map and
the distances between them; then the parallax p gives t = p / (f c), without knowing X.
"""

from collections.abc import Callable
from functools import lru_cache
import math

import numpy as np
from stavpr_ros.errors import ImageError
from stavpr_ros.relative_pose.offset import (
    BLOCK_CENTERS,
    block_evidence,
    in_parts,
    Offset,
    PRIOR_H,
    SHIFTS,
    WIDTH,
)  # fmt: skip

# Chosen on street 7; half and double on 21 and 33: benchmarks/results/repeat_constants.md
RATES = np.geomspace(0.004, 1.0, 48)  # expansions, half widths per meter
STEPS = (1, 2, 4, 8)  # places between two compared images
MAX_DISTANCE = 1.2  # meters between them; the next place counts in any case
MIN_DISTANCE = 0.02
RADIUS = 4  # places on both sides whose evidence is summed
MAX_CACHED = 64  # places
AHEAD = 0.13  # DISTANT of the scene that the camera drives towards


class Expansion:
    """
    How far the scene beside the path moves outward per meter, by place of a map.

    :param columns: returns the columns of a place's image, see :func:`describe_columns`; raises
        ImageError for a place without an image, which is left out.
    :param distances: meters along the path, not decreasing, shape (n,).
    """

    def __init__(self, columns: Callable[[int], np.ndarray], distances: np.ndarray) -> None:
        self._columns, self._distances = columns, distances
        self._evidence = lru_cache(MAX_CACHED)(self._evidence_of)

    def lateral(self, offset: Offset, place: int, focal: float) -> tuple[float, float]:
        """
        Return how far the camera is to the left of the path, and the deviation, meters.

        :param offset: offset of an image against the place.
        :param focal: focal length, as a part of the width of the image; NaN = unknown, as is the
            result.
        """
        if math.isnan(focal):
            return math.nan, math.nan
        first, last = max(0, place - RADIUS), min(len(self._distances), place + RADIUS + 1)
        log = np.sum([self._evidence(i) for i in range(first, last)], axis=0)
        share = np.exp(log - log.max())
        share /= share.sum()
        mean = float(share @ np.log(RATES))
        variance = float(share @ (np.log(RATES) - mean) ** 2)
        scale = 1 / (focal * math.exp(mean))
        deviation = math.hypot(offset.parallax_deviation, offset.parallax * math.sqrt(variance))
        return offset.parallax * scale, deviation * scale

    def _evidence_of(self, place: int) -> np.ndarray:
        """Return the evidence (nats) of a place and later ones for each rate."""
        total = np.zeros(len(RATES))
        for step in STEPS:
            if place + step >= len(self._distances):
                break
            distance = float(self._distances[place + step] - self._distances[place])
            if distance > MAX_DISTANCE and step > 1:
                break
            if distance < MIN_DISTANCE:
                continue
            u = BLOCK_CENTERS
            beside = in_parts(RATES[:, None] * u * (AHEAD + abs(u)) * distance)
            try:
                later, columns = self._columns(place + step), self._columns(place)
            except ImageError:
                continue
            evidence, is_covered = block_evidence(later, columns, beside)
            log = np.where(is_covered, evidence - 0.5 * (SHIFTS / (PRIOR_H * WIDTH)) ** 2, -np.inf)
            total += np.maximum(np.logaddexp.reduce(log, axis=1), -1e3)
        return total
