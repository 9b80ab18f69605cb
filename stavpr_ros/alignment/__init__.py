"""The paper's mathematics: the distance of two images, and of a window of images to every place of a map."""

from stavpr_ros.alignment.lm_dtw import (
    SequenceDistances,
    SequenceMatch,
    align_sequence,
    best_match,
    match_sequence,
)
from stavpr_ros.alignment.path import Alignment, aligned_index
from stavpr_ros.alignment.settings import STRATEGIES, SequenceSettings, SpatialSettings, VelocitySettings
from stavpr_ros.alignment.similarity import holistic_distances, strip_distances
from stavpr_ros.alignment.spatial import align_images, image_distances
from stavpr_ros.alignment.velocity import (
    VelocityMatches,
    best_velocity_match,
    match_velocities,
    trace_velocity,
)

__all__ = [
    'STRATEGIES',
    'Alignment',
    'SequenceDistances',
    'SequenceMatch',
    'SequenceSettings',
    'SpatialSettings',
    'VelocityMatches',
    'VelocitySettings',
    'align_images',
    'align_sequence',
    'aligned_index',
    'best_match',
    'best_velocity_match',
    'holistic_distances',
    'image_distances',
    'match_sequence',
    'match_velocities',
    'strip_distances',
    'trace_velocity',
]
