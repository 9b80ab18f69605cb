# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run stavpr_slam bridge TARGET``: loop closures for other SLAM systems and filters."""

from pkgutil import resolve_name
import sys
from typing import Any

from stavpr_ros.signals import run_until_signal

TARGETS = {
    'rtabmap': ('rtabmap:RtabmapBridge', 'Adds loop closures to RTAB-Map as user closures.'),
    'rtabmap_global_pose': ('rtabmap:GlobalPoseBridge', 'Publishes the pose on a map as '
                            '``global_pose``, a prior of RTAB-Map; without its messages.'),
    'robot_localization': ('poses:RobotLocalizationBridge', 'Publishes ``~/pose`` for a '
                           '``poseN`` of robot_localization, once per relocalization.'),
}  # fmt: skip
HELP = """usage: bridge TARGET [--ros-args -p NAME:=VALUE ... -r stavpr/loop_closure:=TOPIC]
       bridge --help

Passes the loop closures of the recognition node on (stavpr/loop_closure, stavpr_msgs/LoopClosure).
The target rtabmap requires the same odometry as the recognition node on the topic `odom`. Counts
and remedies are in /diagnostics.

targets and their parameters:
{targets}
Only rtabmap requires rtabmap_msgs. For Nav2: parameter publish_initialpose of the recognition
node.

exit codes: 0 stopped by a signal; 1 an invalid parameter, or a missing package; 2 usage
"""


def main(args: list[str] | None = None) -> int:
    """Run a bridge until it is stopped."""
    arguments = sys.argv[1:] if args is None else args
    if {'-h', '--help'} & set(arguments[:2]):
        print(HELP.format(targets=''.join(map(_describe, TARGETS))))
        return 0
    if not arguments or arguments[0] not in TARGETS:
        given = repr(arguments[0]) if arguments else 'nothing'
        print(f'bridge: expected a target ({", ".join(TARGETS)}), got {given}', file=sys.stderr)
        return 2
    return run_until_signal(lambda: _run(arguments[0], arguments[1:]))


def _class(target: str) -> Any:
    return resolve_name(f'stavpr_slam.ros.bridges.{TARGETS[target][0]}')


def _describe(target: str) -> str:
    kind = _class(target)
    rows = [f'  {target}: {TARGETS[target][-1]}\n']
    for name, (default, sentence) in kind.PARAMETERS.items():
        rows.append(f'      {name} (default {default!r}): {sentence}\n')
    return ''.join(rows)


def _run(target: str, arguments: list[str]) -> int:
    from stavpr_ros.ros.process import run_node

    return run_node(_class(target), arguments)


if __name__ == '__main__':
    sys.exit(main())
