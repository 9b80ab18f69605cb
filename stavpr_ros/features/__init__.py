"""Images to local features: one file a kind, vertical strips, random projection."""

from stavpr_ros.features.extractor import FeatureExtractor, FeatureSettings, LocalFeatures
from stavpr_ros.features.projection import Projection
from stavpr_ros.features.registry import KINDS

__all__ = ['KINDS', 'FeatureExtractor', 'FeatureSettings', 'LocalFeatures', 'Projection']
