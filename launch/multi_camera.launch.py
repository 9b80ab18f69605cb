# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start one node for each of several cameras.

ros2 launch stavpr_ros multi_camera.launch.py cameras:=front,rear map_path:=maps/{camera}.stavpr

The node of camera front is /front/stavpr, its images are on /front/image_raw, and {camera} in a
path is its name. All share the odometry on /odom.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from stavpr_ros.ros.launching import node_launch


def generate_launch_description() -> LaunchDescription:
    """Describe a node for each camera."""
    return node_launch(
        DeclareLaunchArgument(
            'cameras', description='names of the cameras, separated by commas: their namespaces'
        ),
        cameras=LaunchConfiguration('cameras'),
        image='image_raw',
        odom='/odom',
    )
