"""Images to local features: one file a kind, vertical strips, random projection."""

from stavpr_ros.features.backbone import KINDS
from stavpr_ros.features.description import Describer, FeatureSettings, LocalFeatures
from stavpr_ros.features.projection import Projection

__all__ = ['KINDS', 'Describer', 'FeatureSettings', 'LocalFeatures', 'Projection']
