# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_ros node``: the place-recognition node."""

import sys
from typing import TYPE_CHECKING

from stavpr_ros.errors import StavprError
from stavpr_ros.parameters import PARAMETERS
from stavpr_ros.signals import end_process, interrupted, obey_signals
from stavpr_ros.threads import wait_passively

if TYPE_CHECKING:
    from stavpr_ros.ros.node import PlaceRecognitionNode

HELP = """usage: node [--ros-args -p map_path:=FILE [-p NAME:=VALUE ...] [-r image:=TOPIC]]

A lifecycle node that configures and activates itself. It recognizes the places of the images on
the topic `image` (sensor_msgs/Image) on the route of a map (operation localization), records a map
(mapping), or recognizes places that the route has passed before (loop_closure), with poses from
`odom`.

It publishes one ~/match (stavpr_msgs/PlaceMatch) for every image received, with a status; for
accepted matches also ~/place_index, ~/distance, ~/pose and ~/loop_closure; ~/candidates,
~/match_image, ~/map_info and /diagnostics. Services: ~/load_map, ~/save_map, ~/reset,
~/relocalize, ~/set_operation.

Build a map with `build_map`. Without a map (in mode paper: or a threshold) the node publishes the
status NOT_READY with the reason; set them later by ~/load_map and the parameter threshold.

parameters:
{parameters}
exit codes: 0 stopped by a signal; 1 an invalid parameter, the backend is not available, or a
recorded map could not be saved at the end
"""


def _help() -> str:
    rows = []
    for row in PARAMETERS:
        unit = f' [{row.unit}]' if row.unit else ''
        rows.append(f'  {row.name} (default {row.default!r})\n      {row.sentence}{unit}\n')
    return HELP.format(parameters=''.join(rows))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    arguments = sys.argv[1:] if args is None else args
    if arguments[:1] in (['-h'], ['--help']):
        print(_help())
        return 0
    obey_signals()
    wait_passively()
    nodes: list[PlaceRecognitionNode] = []
    try:
        if code := _run(args, nodes):
            return code
    except KeyboardInterrupt:
        pass
    except Exception:  # an interrupt inside a foreign library may be raised as another exception
        if not interrupted():
            raise
    code = int(any(node.failed for node in nodes))
    if interrupted():
        end_process(code)
    return code


def _run(args: list[str] | None, nodes: 'list[PlaceRecognitionNode]') -> int:
    from rclpy.exceptions import ParameterException
    from rclpy.logging import get_logger
    from stavpr_ros.ros.node import PlaceRecognitionNode
    from stavpr_ros.ros.process import ros_node, spin_until

    def make() -> PlaceRecognitionNode:
        nodes.append(PlaceRecognitionNode())
        return nodes[0]

    try:
        with ros_node(make, args) as node:
            spin_until(node, threads=node.THREADS)
    except (StavprError, ParameterException) as error:
        get_logger('stavpr').fatal(f'cannot start: {error}')
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
