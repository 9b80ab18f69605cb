# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_slam pose_graph``: the pose-graph node."""

import sys

from stavpr_ros.commands.program import run_node_program

HELP = """usage: pose_graph [--ros-args -p NAME:=VALUE ... -r odom:=TOPIC]

A lifecycle node that configures and activates itself. It corrects the odometry on the topic `odom`
(nav_msgs/Odometry) by the loop closures of recognition nodes: ~/path_before and ~/path
(nav_msgs/Path), ~/odometry in the map frame, ~/map_to_odom, ~/edges (visualization_msgs/
MarkerArray: accepted blue, rejected vermilion), /diagnostics. Services: ~/save
(stavpr_msgs/SaveMap, a file .g2o, .tum or .kitti in the maps folder), ~/reset. The graph is in a
process of its own.

parameters:
{parameters}
exit codes: 0 stopped by a signal; 1 an invalid parameter
"""


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    return run_node_program(HELP, 'stavpr_slam.ros.graph_node', 'PoseGraphNode', args)


if __name__ == '__main__':
    sys.exit(main())
