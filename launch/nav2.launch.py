# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start the node under the lifecycle manager of Nav2, which configures and activates it.

ros2 launch stavpr_ros nav2.launch.py map_path:=FILE image:=TOPIC

To use the manager of your own Nav2 launch files, start the node with autostart:=false, and add
its name to node_names there. The bond requires the package bond, which Nav2 has, too.
"""

from launch import LaunchDescription
from stavpr_ros.ros.launching import node_launch, other_node


def generate_launch_description() -> LaunchDescription:
    """Describe the node and its manager."""
    manager = other_node(
        'nav2_lifecycle_manager',
        'lifecycle_manager',
        'lifecycle_manager_stavpr',
        fixed={'autostart': True, 'node_names': ['stavpr'], 'bond_timeout': 4.0},
    )
    return node_launch(*manager, needs='nav2_lifecycle_manager', autostart=False)
