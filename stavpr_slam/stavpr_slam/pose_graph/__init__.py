# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Loop closures and odometry become one trajectory: a pose graph."""

from stavpr_slam.pose_graph.alignment import align_maps
from stavpr_slam.pose_graph.closures import Closure
from stavpr_slam.pose_graph.graph import GraphEdge, GraphSettings, optimize, PoseGraph
from stavpr_slam.pose_graph.keyframes import ChainSettings
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.transforms import body_covariance

__all__ = [
    'ChainSettings',
    'Closure',
    'GraphEdge',
    'GraphSettings',
    'OdometryNoise',
    'PoseGraph',
    'align_maps',
    'body_covariance',
    'optimize',
]
