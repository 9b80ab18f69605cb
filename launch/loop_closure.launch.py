# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Close loops: ros2 launch stavpr_ros loop_closure.launch.py image:=/camera/image_raw odom:=/odom.

With map_path, the kind of features is the map's; its places are not compared.
"""

from launch import LaunchDescription
from stavpr_ros.ros.launching import node_launch


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation loop_closure."""
    return node_launch(operation='loop_closure')
