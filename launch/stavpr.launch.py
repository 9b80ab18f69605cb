# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start the node: ros2 launch stavpr_ros stavpr.launch.py map_path:=FILE image:=TOPIC."""

from launch import LaunchDescription
from stavpr_ros.ros.launching import node_launch


def generate_launch_description() -> LaunchDescription:
    """Describe the node, by default in operation localization."""
    return node_launch()
