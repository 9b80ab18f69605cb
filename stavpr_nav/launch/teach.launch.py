# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Teach a route: ros2 launch stavpr_nav teach.launch.py image:=TOPIC save_path:=MAP run_path:=CSV.

Records the map (saved at the end, or by ~/save_map of the node stavpr) and the velocities of
source:=odom or cmd_vel.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from stavpr_nav.parameters import TEACH
from stavpr_ros.ros.launching import node_launch


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation mapping, and the recorder of velocities."""
    own = [
        DeclareLaunchArgument('run_path', description=TEACH['run_path'][1]),
        DeclareLaunchArgument(
            'source',
            default_value='odom',
            description='velocities of odom, cmd_vel or cmd_vel_stamped',
        ),
    ]
    recorder = Node(
        package='stavpr_nav',
        executable='teach',
        name='teach',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        remappings=[('odom', LaunchConfiguration('odom'))],
        parameters=[{each.name: LaunchConfiguration(each.name) for each in own}],
    )
    return node_launch(*own, recorder, operation='mapping')
