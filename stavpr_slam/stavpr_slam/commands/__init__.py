# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands of this package, one in each module, and their table."""

from stavpr_ros.commands import Command

COMMANDS = {
    'pose_graph': Command(
        'stavpr_slam.commands.pose_graph', 'correct odometry by loop closures', True
    ),
    'optimize_graph': Command(
        'stavpr_slam.commands.optimize_graph',
        'reject the false closures of a g2o file and solve it',
    ),
    'bridge': Command(
        'stavpr_slam.commands.bridge', 'pass loop closures on to RTAB-Map and others', True
    ),
}
