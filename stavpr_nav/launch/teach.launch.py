# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Teach a route: ros2 launch stavpr_nav teach.launch.py image:=TOPIC save_path:=MAP run_path:=CSV.

Records the map (saved at the end, or by ~/save_map of the node stavpr) and the velocities of
source:=odom or cmd_vel.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from stavpr_nav.parameters import TEACH
from stavpr_ros.ros.launching import node_launch, other_node


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation mapping, and the recorder of velocities."""
    run_path = DeclareLaunchArgument('run_path', description=TEACH['run_path'][1])
    _, *recorder = other_node('stavpr_nav', 'teach', 'teach', TEACH)  # run_path is required
    return node_launch(run_path, *recorder, operation='mapping')
