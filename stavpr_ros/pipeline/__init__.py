"""Processing of one image, without ROS: localization, mapping, loop closure."""

from stavpr_ros.pipeline.pipeline import Pipeline
from stavpr_ros.pipeline.settings import OPERATIONS, PipelineSettings
from stavpr_ros.pipeline.start import read_map

__all__ = ['OPERATIONS', 'Pipeline', 'PipelineSettings', 'read_map']
