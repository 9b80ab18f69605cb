# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Record a map: ros2 launch stavpr_ros mapping.launch.py image:=/camera/image_raw save_path:=FILE.

With map_path, a map is extended. The service save_map saves the map at any time, save_path at the
end.
"""

from launch import LaunchDescription
from launch.actions import LogInfo
from launch.substitutions import LaunchConfiguration
from stavpr_ros.ros.launching import node_launch


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation mapping."""
    how_to_save = LogInfo(
        msg=[
            'to save the map before the end (save_path saves it at the end): ros2 service call ',
            LaunchConfiguration('namespace'),
            '/stavpr/save_map stavpr_msgs/srv/SaveMap "{path: FILE}"',
        ]
    )
    return node_launch(how_to_save, operation='mapping')
