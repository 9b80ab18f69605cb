# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Processing of one image, without ROS: localization, mapping, loop closure."""

from stavpr_ros.pipeline.pipeline import Pipeline
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.settings import node_settings, NodeSettings, OPERATIONS, PipelineSettings
from stavpr_ros.pipeline.start import LoadedMap, read_map

__all__ = [
    'OPERATIONS',
    'ImageResult',
    'LoadedMap',
    'NodeSettings',
    'Pipeline',
    'PipelineSettings',
    'node_settings',
    'read_map',
]
