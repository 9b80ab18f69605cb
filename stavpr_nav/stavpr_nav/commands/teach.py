# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_nav teach``."""

import sys

from stavpr_ros.commands.program import run_node_program

HELP = """usage: teach --ros-args -p run_path:=FILE [-p source:=cmd_vel]

A node that records velocities on `odom` or `cmd_vel` while the recognition node records the map
(operation mapping) in the same drive. A map with poses needs no such file.

parameters:
{parameters}
exit codes: 0 stopped by a signal; 1 an invalid parameter or file
"""


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    return run_node_program(HELP, 'stavpr_nav.ros.teach_node', 'TeachNode', args)


if __name__ == '__main__':
    sys.exit(main())
