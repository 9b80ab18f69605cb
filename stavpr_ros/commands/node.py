# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_ros node``: the place-recognition node."""

import sys
from typing import TYPE_CHECKING

from stavpr_ros import parameters
from stavpr_ros.commands.program import run_node_program

if TYPE_CHECKING:
    from stavpr_ros.ros.node import PlaceRecognitionNode

# what numba imports where it is installed: for matrix products in kernels, and to measure tests
NOT_NEEDED = 'scipy', 'coverage'

HELP = """usage: node [--ros-args -p map_path:=FILE [-p NAME:=VALUE ...] [-r image:=TOPIC]]

A lifecycle node that configures and activates itself. It compares the images on the topic `image`
(sensor_msgs/Image) with a map and recognizes their places (operation localization), records a map
(mapping), or recognizes places that the route has passed before (loop_closure). It takes poses
from `odom`.

It publishes one ~/match (stavpr_msgs/PlaceMatch) for every image received, with a status; for
accepted matches also ~/place_index, ~/distance, ~/pose and ~/loop_closure; ~/candidates,
~/match_image, ~/map_info and /diagnostics. Services: ~/load_map, ~/save_map, ~/reset,
~/relocalize, ~/set_operation.

Build a map with `build_map`. Without a map, the status of each match is NOT_READY; load one later
by ~/load_map.

parameters:
{parameters}
exit codes: 0 stopped by a signal; 1 an invalid parameter, the backend is not available, or a
recorded map could not be saved at the end
"""


PARAMETERS = {row.name: (row.default, row.text) for row in parameters.PARAMETERS}


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    return run_node_program(HELP, __name__, 'make_node', args)


def make_node() -> 'PlaceRecognitionNode':
    """Make the node; ROS is initialized."""
    _import_numba()
    from stavpr_ros.ros.node import PlaceRecognitionNode

    return PlaceRecognitionNode()


def _import_numba() -> None:
    """Import numba without what no kernel needs (18 MB, 80 modules), unless it is there."""
    absent = [name for name in NOT_NEEDED if name not in sys.modules]
    # None = it cannot be imported
    sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]
    import numba.np.arraymath  # noqa: F401

    for name in absent:
        del sys.modules[name]
