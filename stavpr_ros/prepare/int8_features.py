# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features of a map in int8, one byte a value."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.prepare.blocks import converted_blocks


@dataclass(frozen=True)
class Int8Features:
    """
    See :class:`stavpr_ros.features.LocalFeatures`.

    :param strips: the features, rounded.
    """

    strips: Int8Strips
    weights: np.ndarray
    settings: FeatureSettings
    cells: tuple[int, int] | None = None

    def __len__(self) -> int:
        return self.strips.shape[1]


def rounded(
    features: LocalFeatures,
    convert: Callable[[LocalFeatures], LocalFeatures],
    visit: Callable[[np.ndarray], None] = lambda strips: None,
) -> Int8Features:
    """
    Return features, converted and rounded to int8 block by block.

    :param visit: called with the strips of each block, before they are rounded.
    """
    W, n = features.weights.shape
    strips = Int8Strips(W, n, features.dimension)
    for places, block in converted_blocks(features, lambda block: convert(block).strips):
        visit(block)
        strips.write(places.start, np.ascontiguousarray(block))
    return Int8Features(strips, features.weights, features.settings, features.cells)
