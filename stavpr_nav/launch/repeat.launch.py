# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Repeat a route: ros2 launch stavpr_nav repeat.launch.py image:=TOPIC map_path:=MAP run_path:=CSV.

Then press the dead-man switch (std_msgs/Bool on `deadman`), and send a goal to `repeat`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from stavpr_nav.parameters import REPEAT
from stavpr_ros.ros.launching import node_launch

SHARED = 'map_path', 'image_transport'  # arguments of the recognition node
NOT_HERE = 'match_topic'


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation localization, and the node that drives."""
    names = [name for name in REPEAT if name != NOT_HERE]
    own = [
        DeclareLaunchArgument(
            name, default_value=str(REPEAT[name][0]), description=REPEAT[name][1]
        )
        for name in names
        if name not in SHARED
    ]
    values = {
        name: ParameterValue(LaunchConfiguration(name), value_type=type(REPEAT[name][0]))
        for name in names
    }
    driver = Node(
        package='stavpr_nav',
        executable='repeat',
        name='repeat',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        remappings=[
            ('image', LaunchConfiguration('image')),
            ('image/compressed', [LaunchConfiguration('image'), '/compressed']),
        ],
        parameters=[values],
    )
    return node_launch(*own, driver, operation='localization')
