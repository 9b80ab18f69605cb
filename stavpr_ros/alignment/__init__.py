# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's mathematics: distances of two images, and of a window to every place of a map."""

from stavpr_ros.alignment.lm_dtw import (
    aligned_index,
    best_match,
    match_sequence,
    SequenceDistances,
    SequenceMatch,
)
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings, STRATEGIES
from stavpr_ros.alignment.spatial import image_distances, strip_distances

__all__ = [
    'STRATEGIES',
    'SequenceDistances',
    'SequenceMatch',
    'SequenceSettings',
    'SpatialSettings',
    'aligned_index',
    'best_match',
    'image_distances',
    'match_sequence',
    'strip_distances',
]
