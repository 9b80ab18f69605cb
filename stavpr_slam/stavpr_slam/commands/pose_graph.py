# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_slam pose_graph``: the pose-graph node."""

import sys

from stavpr_ros.signals import run_until_signal

HELP = """usage: pose_graph [--ros-args -p NAME:=VALUE ... -r odom:=TOPIC]

A lifecycle node that configures and activates itself. It corrects the odometry on the topic `odom`
(nav_msgs/Odometry) by the loop closures of recognition nodes: ~/path_before and ~/path
(nav_msgs/Path), ~/odometry in the map frame, ~/map_to_odom, ~/edges (visualization_msgs/
MarkerArray: accepted green, rejected red), /diagnostics. Services: ~/save (stavpr_msgs/SaveMap, a
file .g2o, .tum or .kitti in the maps folder), ~/reset. The graph is in a process of its own.

parameters:
{parameters}
exit codes: 0 stopped by a signal; 1 an invalid parameter
"""


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    arguments = sys.argv[1:] if args is None else args
    if arguments[:1] in (['-h'], ['--help']):
        from stavpr_slam.ros.graph_node import PARAMETERS

        rows = (
            f'  {name} (default {default!r})\n      {sentence}\n'
            for name, (default, sentence) in PARAMETERS.items()
        )
        print(HELP.format(parameters=''.join(rows)))
        return 0
    return run_until_signal(lambda: _run(args))


def _run(args: list[str] | None) -> int:
    from stavpr_ros.ros.process import run_node
    from stavpr_slam.ros.graph_node import PARAMETERS, PoseGraphNode

    return run_node(PoseGraphNode, args, PARAMETERS)


if __name__ == '__main__':
    sys.exit(main())
