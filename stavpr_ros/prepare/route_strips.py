# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Strips of a route that grows by one place at a time.

They are an array (W, room, d), float32, or of the class below, int8. Both return
``strips[:, places]`` as float32 of unit norm.
"""

import numpy as np
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.memory import aligned_empty
from stavpr_ros.simd import LANES

PIECE = 256  # places rounded at a time


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


RouteStrips = np.ndarray | Int8Route


def grown(values: np.ndarray, room: int) -> np.ndarray:
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


def rounded_strips(strips: RouteStrips, count: int) -> Int8Route:
    """Return float32 strips (W, room, d), of which ``count`` places are known, in int8."""
    rounded = Int8Route(*strips.shape)
    for low in range(0, count, PIECE):
        places = slice(low, min(low + PIECE, count))
        rounded[:, places] = strips[:, places]
    return rounded
