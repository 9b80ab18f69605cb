"""The paper's mathematics: the distance of two images, and of a window of images to every place of a map."""

from stavpr_ros.alignment.path import Alignment, aligned_index
from stavpr_ros.alignment.settings import STRATEGIES, SequenceSettings, SpatialSettings, SpeedSettings
from stavpr_ros.alignment.similarity import holistic_distances, strip_distances
from stavpr_ros.alignment.spatial import align_images, image_distances
from stavpr_ros.alignment.speeds import SpeedMatches, best_speed_match, match_speeds, trace_speed
from stavpr_ros.alignment.temporal import (
    SequenceDistances,
    SequenceMatch,
    align_sequence,
    best_match,
    match_sequence,
)

__all__ = [
    'STRATEGIES',
    'Alignment',
    'SequenceDistances',
    'SequenceMatch',
    'SequenceSettings',
    'SpatialSettings',
    'SpeedMatches',
    'SpeedSettings',
    'align_images',
    'align_sequence',
    'aligned_index',
    'best_match',
    'best_speed_match',
    'holistic_distances',
    'image_distances',
    'match_sequence',
    'match_speeds',
    'strip_distances',
    'trace_speed',
]
