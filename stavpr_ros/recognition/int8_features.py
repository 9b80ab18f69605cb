# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features of a map in int8, one byte a value."""

from collections.abc import Callable
from dataclasses import dataclass

from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.recognition.blocks import converted_blocks
import torch


@dataclass(frozen=True)
class Int8Features:
    """
    See :class:`stavpr_ros.features.LocalFeatures`.

    :param strips: the features, rounded.
    """

    strips: Int8Strips
    weights: torch.Tensor
    settings: FeatureSettings
    cells: tuple[int, int] | None = None

    def __len__(self) -> int:
        return self.strips.shape[1]


def rounded(
    features: LocalFeatures,
    convert: Callable[[LocalFeatures], LocalFeatures],
    see: Callable[[torch.Tensor], None] = lambda strips: None,
) -> Int8Features:
    """
    Return features rounded to int8: one block after the other, converted before.

    :param see: called with the strips of each block, before they are rounded.
    """
    W, n = features.weights.shape
    strips = Int8Strips(W, n, features.dimension)
    for places, some in converted_blocks(features, lambda some: convert(some).strips.cpu()):
        see(some)
        strips.write(places.start, some.contiguous())
    return Int8Features(strips, features.weights, features.settings, features.cells)
