# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features of a map in int8, one byte a value."""

from collections.abc import Callable
from dataclasses import dataclass

from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.recognition.robust import blocks
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
    features: LocalFeatures, convert: Callable[[LocalFeatures], LocalFeatures]
) -> Int8Features:
    """Return features rounded to int8: one block after the other, converted before."""
    W, n = features.weights.shape
    strips = Int8Strips(W, n, features.dimension)
    for places, some in blocks(features):
        strips.write(places.start, convert(some).strips.cpu().contiguous())
    return Int8Features(strips, features.weights, features.settings, features.cells)
