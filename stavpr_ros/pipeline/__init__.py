# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Processing of one image, without ROS: localization, mapping, loop closure."""

from stavpr_ros.pipeline.operations import Operation
from stavpr_ros.pipeline.pipeline import LoadedMap, Pipeline, read_map
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.pipeline.settings import node_settings, NodeSettings, OPERATIONS, PipelineSettings

__all__ = [
    'OPERATIONS',
    'ImageResult',
    'LoadedMap',
    'NodeSettings',
    'Operation',
    'Pipeline',
    'PipelineSettings',
    'node_settings',
    'read_map',
]
