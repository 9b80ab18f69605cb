# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_nav repeat``."""

import sys

from stavpr_ros.commands.program import run_node_program

HELP = """usage: repeat --ros-args -p map_path:=FILE [-p run_path:=FILE] [-r image:=TOPIC]

A node that drives along a taught route. It subscribes to `image`, `camera_info`, `deadman`
(std_msgs/Bool) and the matches of the recognition node on the same map; it serves the action
`repeat` (stavpr_msgs/Repeat), and publishes `cmd_vel` while there is a goal, ~/offset
(stavpr_msgs/Offset) and /diagnostics. Where the images show no motion, it waits for a new press of
the switch, or ~/start (std_srvs/Trigger). It avoids no collisions.

parameters:
{parameters}
exit codes: 0 stopped by a signal; 1 an invalid parameter or file
"""


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    return run_node_program(HELP, 'stavpr_nav.ros.repeat_node', 'RepeatNode', args)


if __name__ == '__main__':
    sys.exit(main())
