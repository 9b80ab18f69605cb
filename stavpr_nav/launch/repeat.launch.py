# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Repeat a route: ros2 launch stavpr_nav repeat.launch.py image:=TOPIC map_path:=MAP run_path:=CSV.

Then press the dead-man switch (std_msgs/Bool on `deadman`), and send a goal to `repeat`.
"""

from launch import LaunchDescription
from stavpr_nav.parameters import REPEAT
from stavpr_ros.ros.launching import node_launch, other_node

NOT_HERE = 'match_topic'  # of the recognition node that is started


def generate_launch_description() -> LaunchDescription:
    """Describe the node in operation localization, and the node that drives."""
    table = {name: row for name, row in REPEAT.items() if name != NOT_HERE}
    driver = other_node('stavpr_nav', 'repeat', 'repeat', table)
    return node_launch(*driver, operation='localization')
