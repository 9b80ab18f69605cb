# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Close loops, and correct the odometry by them; requires stavpr_slam.

ros2 launch stavpr_ros pose_graph.launch.py image:=/camera/image_raw odom:=/odom

The corrected odometry is on /pose_graph/odometry, the correction on /pose_graph/map_to_odom.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from stavpr_ros.ros.launching import node_launch

ARGUMENTS = {
    'max_correction_speed': (0.0, 'm/s at which the corrected pose moves at most; 0: at once'),
    'correct_tf': (False, 'publish map -> odom of the pose graph on /tf; not with publish_tf'),
}


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation loop_closure, and the pose graph."""
    values = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(default))
        for name, (default, _) in ARGUMENTS.items()
    }
    values['publish_tf'] = values.pop('correct_tf')
    graph = Node(
        package='stavpr_slam',
        executable='pose_graph',
        name='pose_graph',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        remappings=[('odom', LaunchConfiguration('odom'))],
        parameters=[values],
    )
    own = [
        DeclareLaunchArgument(name, default_value=str(default).lower(), description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return node_launch(*own, graph, needs='stavpr_slam', operation='loop_closure')
