"""``ros2 run stavpr_ros record``: write matches, or loop closures, to a file, one JSON object a line."""

import argparse
import json
import math
import sys
import time
from typing import TYPE_CHECKING, Any, TextIO

from stavpr_ros.errors import SettingsError, StavprError
from stavpr_ros.signals import obey_signals

if TYPE_CHECKING:
    from stavpr_msgs.msg import LoopClosure, PlaceMatch

_STATUSES = (
    'WARMING_UP',
    'NO_MATCH',
    'MATCH',
    'INVALID_IMAGE',
    'NOT_READY',
    'DROPPED',
    'SKIPPED',
    'MAPPED',
)
TOPICS = {'matches': '/stavpr/match', 'loop closures': '/stavpr/loop_closure'}

LISTENING = 'recording {topic}'  # said when no message can be missed any more

EPILOG = """
The keys are the fields of stavpr_msgs/PlaceMatch, the status by its name, or with --loop-closures those
of stavpr_msgs/LoopClosure. Stamps are nanoseconds, numbers that are not there are null; the path is a list
of [query_index, place_index], pairs are [query_index, query_stamp, place_index, place_stamp], a pose is
[x, y, z, qx, qy, qz, qw], null without odometry. received is the time of arrival (ns, system clock).

exit codes: 0 done (--count reached, or stopped by a signal), 1 the file cannot be written, 2 usage,
130 stopped by a signal before it began
"""


def _stamp(time: Any) -> int:
    return int(time.sec) * 10**9 + int(time.nanosec)


def _pose(pose: Any) -> list[float]:
    p, o = pose.position, pose.orientation
    return [p.x, p.y, p.z, o.x, o.y, o.z, o.w]


def _plain(message: 'PlaceMatch | LoopClosure', replaced: dict[str, Any]) -> dict[str, Any]:
    """
    Return a message as plain values for JSON.

    :param replaced: values of fields that are written in another way.
    """
    record: dict[str, Any] = {'stamp': _stamp(message.header.stamp), 'frame_id': message.header.frame_id}
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if name in replaced:
            record[name] = replaced[name]
        elif kind == 'builtin_interfaces/Time':
            record[name] = _stamp(value)
        elif name != 'header':
            record[name] = None if isinstance(value, float) and math.isnan(value) else value
    return record


def match_record(message: 'PlaceMatch') -> dict[str, Any]:
    """Return a match as plain values for JSON."""
    path = [[pair.query_index, pair.place_index] for pair in message.path]
    return _plain(message, {'status': _STATUSES[message.status], 'path': path})


def loop_closure_record(message: 'LoopClosure') -> dict[str, Any]:
    """Return a loop closure as plain values for JSON."""
    pairs = [
        [pair.query_index, _stamp(pair.query_stamp), pair.place_index, _stamp(pair.place_stamp)]
        for pair in message.pairs
    ]
    poses = [_pose(pose) if message.has_poses else None for pose in (message.query_pose, message.place_pose)]
    return _plain(message, {'pairs': pairs, 'query_pose': poses[0], 'place_pose': poses[1]})


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    obey_signals()
    try:
        return _run(sys.argv[1:] if args is None else args)
    except (OSError, StavprError) as error:
        print(f'record: {error}', file=sys.stderr)
        return 2 if isinstance(error, SettingsError) else 1
    except KeyboardInterrupt:
        print('record: interrupted', file=sys.stderr)
        return 130


def _run(given: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog='record',
        description=__doc__,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--output', required=True, metavar='FILE', help='the file to write (JSON lines)')
    parser.add_argument(
        '--loop-closures',
        dest='what',
        action='store_const',
        const='loop closures',
        default='matches',
        help='loop closures (of operation loop_closure) instead of matches',
    )
    parser.add_argument('--topic', help=f'topic of either ({", or ".join(TOPICS.values())})')
    parser.add_argument('--count', type=int, default=0, help='end after so many (0 = go on)')
    from stavpr_ros.ros.process import own_arguments

    arguments = parser.parse_args(own_arguments(given))
    with open(arguments.output, 'w') as file:
        written = _record(arguments, file, given)
    print(f'{written} {arguments.what} written to {arguments.output}')
    return 0


def _record(arguments: argparse.Namespace, file: TextIO, ros_arguments: list[str]) -> int:
    """Write what is heard until a signal or the count; return how many."""
    import rclpy
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.qos import QoSProfile

    from stavpr_msgs.msg import LoopClosure, PlaceMatch
    from stavpr_ros.ros.discovery import Introduction
    from stavpr_ros.ros.process import ros_node, spin_until

    written = 0
    loops = arguments.what == 'loop closures'
    kind, as_record = (LoopClosure, loop_closure_record) if loops else (PlaceMatch, match_record)

    def write(message: Any) -> None:
        nonlocal written
        record = as_record(message) | {'received': time.time_ns()}
        file.write(json.dumps(record) + '\n')
        file.flush()
        written += 1

    def complete() -> bool:
        return 0 < arguments.count <= written

    try:
        with ros_node(lambda: rclpy.create_node('stavpr_record'), ros_arguments) as node:
            subscription = node.create_subscription(
                kind, arguments.topic or TOPICS[arguments.what], write, QoSProfile(depth=1000)
            )
            topic = subscription.topic_name
            introduction = Introduction(node, lambda: node.get_publishers_info_by_topic(topic), timeout=10.0)
            print(f'waiting for a publisher of {topic}', flush=True)
            spin_until(node, lambda: subscription.get_publisher_count() > 0)
            spin_until(node, lambda: introduction.done() or complete())
            print(LISTENING.format(topic=topic), flush=True)
            spin_until(node, complete)
    except InvalidTopicNameException as error:
        raise SettingsError(str(error)) from error
    except KeyboardInterrupt:
        pass  # the usual end
    return written


if __name__ == '__main__':
    sys.exit(main())
