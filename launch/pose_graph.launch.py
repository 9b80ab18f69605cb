# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Close loops, and correct the odometry by them; requires stavpr_slam.

ros2 launch stavpr_ros pose_graph.launch.py image:=/camera/image_raw odom:=/odom

The corrected odometry is on /pose_graph/odometry, the correction on /pose_graph/map_to_odom.
"""

from launch import LaunchDescription
from stavpr_ros.ros.launching import node_launch, other_node

RENAMED = {'graph_keyframe_distance': 'keyframe_distance', 'correct_tf': 'publish_tf'}
ARGUMENTS = {
    'max_correction_speed': (0.0, 'm/s at which the corrected pose moves at most; 0: at once'),
    'max_odometry_gap': (5.0, 'seconds without odometry that begin a new session, above 0'),
    'appearance_edges': (True, 'closures without a relative pose count as edges'),
    'autostart': (True, 'shared'),
    'map_frame': ('map', 'shared'),
    'maps_folder': ('', 'shared'),
    'graph_keyframe_distance': (1.0, 'meters between keyframes of the pose graph, above 0'),
    'correct_tf': (False, 'publish map -> odom of the pose graph on /tf; not with publish_tf'),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation loop_closure, and the pose graph."""
    graph = other_node('stavpr_slam', 'pose_graph', 'pose_graph', ARGUMENTS, {}, RENAMED)
    return node_launch(*graph, needs='stavpr_slam', operation='loop_closure')
