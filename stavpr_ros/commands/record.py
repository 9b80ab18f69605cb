# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``record``: write matches, or loop closures, to a file, one JSON object per line."""

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
import json
import math
import os
import sys
import time
from typing import Any, TYPE_CHECKING

import numpy as np
from stavpr_ros.commands.program import make_parser, run_program, say
from stavpr_ros.errors import OutputError
from stavpr_ros.output_file import atomic_output, RECORDING
from stavpr_ros.units import SECOND, WRAP

if TYPE_CHECKING:
    from stavpr_msgs.msg import LoopClosure, PlaceMatch

# The constants of stavpr_msgs/PlaceMatch in the order of their values. recognition.Status has the
# same names, but its package imports numba.
STATUSES = (
    *('WARMING_UP', 'NO_MATCH', 'MATCH', 'INVALID_IMAGE'),
    *('NOT_READY', 'DROPPED', 'SKIPPED', 'MAPPED'),
)
MATCHES, LOOP_CLOSURES = 'matches', 'loop closures'
TOPICS = {MATCHES: 'stavpr/match', LOOP_CLOSURES: 'stavpr/loop_closure'}
LAST_SECONDS = 0.3  # without a message after a signal: then none is to come

EPILOG = """
The keys are the fields of stavpr_msgs/PlaceMatch, the status by its name, or with --loop-closures
those of stavpr_msgs/LoopClosure; nested messages are objects with the names of their fields.
Stamps are in nanoseconds; missing numbers, and poses without odometry, are null. received is the
time of arrival (ns, system clock).

exit codes: 0 stopped by a signal, 1 the file cannot be written, 2 usage, 130 stopped by a signal
before the start
"""


def message_record(message: 'PlaceMatch | LoopClosure') -> dict[str, Any]:
    """Return a match or a loop closure as plain values for JSON, with the fields of its header."""
    fields: dict[str, Any] = _plain(message)
    if 'status' in fields:
        fields['status'] = STATUSES[fields['status']]
    elif not fields['has_poses']:
        fields |= dict.fromkeys(('query_pose', 'place_pose'))
    return fields.pop('header') | fields


def _plain(value: Any) -> Any:
    """Return stamps as nanoseconds, other messages as their fields by name, NaN as None."""
    if hasattr(value, 'nanosec'):
        return int(value.sec) % WRAP * SECOND + int(value.nanosec)
    if hasattr(value, 'get_fields_and_field_types'):
        return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, np.ndarray | Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def main(args: list[str] | None = None) -> int:
    """Run the command."""
    return run_program('record', lambda: _run(sys.argv[1:] if args is None else args))


def _run(args: list[str]) -> None:
    from stavpr_ros.ros.process import own_arguments

    arguments = _parser().parse_args(own_arguments(args))
    name, is_shown = arguments.output, arguments.output == '-'
    stdout = nullcontext(sys.stdout.buffer)
    with stdout if is_shown else atomic_output(name, RECORDING, arguments.force) as file:
        recorder = Recorder(file, arguments.output, arguments.kind)
        _record_messages(recorder, arguments.kind, args)
        recorder.finish()


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(
        'record', 'Write matches, or loop closures, to a file, one JSON object per line.', EPILOG
    )
    parser.add_argument(
        '--output', required=True, metavar='FILE', help='file of JSON lines; -: shows them'
    )
    parser.add_argument(
        '--force', action='store_true', help='replace an existing recording, at the first message'
    )
    parser.add_argument(
        '--loop-closures',
        dest='kind',
        action='store_const',
        const=LOOP_CLOSURES,
        default=MATCHES,
        help='loop closures (of operation loop_closure) instead of matches',
    )
    return parser


class Recorder:
    """
    Writes messages to a file, one JSON object per line; ``count`` of them.

    :param file: of :func:`atomic_output`, of this name, or the standard output.
    :param kind: matches or loop closures.
    """

    def __init__(self, file: Any, name: str, kind: str = MATCHES) -> None:
        self._file, self._name, self._kind, self.count = file, name, kind, 0

    def write(self, message: Any) -> None:
        """
        Write a message.

        :raises OutputError: it cannot be written; earlier ones stay.
        """
        file = self._file
        line = json.dumps(message_record(message) | {'received': time.time_ns()}) + '\n'
        size = os.fstat(file.fileno()).st_size
        try:
            file.write(line.encode())
            file.flush() if self._name == '-' or file.committed else file.commit()
        except OSError as error:
            if self._name == '-':
                raise
            os.ftruncate(file.fileno(), size)
            content = f'it has {self.count} {self._kind}, all of them whole'
            raise OutputError(
                f'{self._name} cannot be written ({error.strerror}); '
                f'{content if file.committed else "what was there is untouched"}: free space, and '
                'record again'
            ) from error
        self.count += 1

    def finish(self) -> None:
        """Keep an earlier recording where there is no message to replace it by."""
        if not self.count and self._name != '-' and os.path.exists(self._name):
            self._file.abandon()
        say(f'{self.count} {self._kind} written to {self._name}', sys.stderr)


def _record_messages(recorder: Recorder, kind: str, ros_arguments: list[str]) -> None:
    """Write messages until a signal, and the ones that have arrived before it."""
    import rclpy
    from rclpy.qos import QoSProfile
    from stavpr_msgs.msg import LoopClosure, PlaceMatch
    from stavpr_ros.ros.process import Discovery, ros_node, spin_until
    from stavpr_ros.ros.subscriber_progress import READY, RECORDER
    from std_msgs.msg import Empty

    message_type = PlaceMatch if kind == MATCHES else LoopClosure
    with ros_node(lambda: rclpy.create_node(RECORDER), ros_arguments) as node:
        subscription = node.create_subscription(
            message_type, TOPICS[kind], recorder.write, QoSProfile(depth=1000)
        )
        topic = subscription.topic_name
        discovery = Discovery(node, lambda: node.get_publishers_info_by_topic(topic))
        try:
            say(f'waiting for a publisher of {topic}', sys.stderr)
            spin_until(node, lambda: subscription.get_publisher_count() > 0)
            spin_until(node, discovery.done)
            node.create_publisher(Empty, f'~/{READY}', 1)  # replay --lossless waits for it
            say(f'recording {topic}', sys.stderr)  # no message is missed from now on
            spin_until(node)
        except KeyboardInterrupt:  # the usual end
            count = -1
            while count < recorder.count:
                count = recorder.count
                rclpy.spin_once(node, timeout_sec=LAST_SECONDS)
