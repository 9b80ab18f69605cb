# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``monitor``: a live view of the node in a web browser."""

import argparse
from collections.abc import Sequence
import sys

import rclpy
from stavpr_lab.monitor.node import History, Monitor
from stavpr_lab.monitor.server import MonitorServer
from stavpr_ros.commands.program import make_parser, run_program
from stavpr_ros.ros.process import own_arguments, ros_node, spin_until

MAX_PORT = 65535

EPILOG = """\
The page shows the camera beside the matched place, the probability over time, the position on the
map, the distances of the last minutes and the diagnostics, and starts and stops the node. It needs
nothing from the network.

examples:
  ros2 run stavpr_lab monitor
  ros2 run stavpr_lab monitor --port 8081 --ros-args -r __ns:=/robot
  ssh -L 8080:localhost:8080 robot      then open http://localhost:8080 here

exit codes: 0 stopped by a signal, 1 the port cannot be used, 2 usage
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param arguments: without the program's name; the process's own if None.
    :returns: exit code, see ``--help``.
    """
    args = list(sys.argv[1:] if arguments is None else arguments)
    return run_program('monitor', lambda: _run(_parser().parse_args(own_arguments(args)), args))


def _run(options: argparse.Namespace, ros_arguments: list[str]) -> None:
    history = History()
    with ros_node(lambda: rclpy.create_node('stavpr_monitor'), ros_arguments) as node:
        monitor = Monitor(node, options.node, history)
        server = MonitorServer(options.host, options.port, history, monitor.command)
        server.start()
        print(f'monitor of {node.resolve_topic_name(options.node)}: open {server.url}', flush=True)
        try:
            spin_until(node)
        except KeyboardInterrupt:
            pass  # the usual end
        finally:
            server.stop()


def _parser() -> argparse.ArgumentParser:
    parser = make_parser('monitor', 'A live view of the node in a web browser.', EPILOG)
    parser.add_argument('--port', type=_port, default=8080, help='0 = any free one (%(default)d)')
    parser.add_argument(
        '--host',
        default='127.0.0.1',
        help='address to serve at, by default this machine alone; there is no password, so other '
        'addresses let everybody in the network control the node (%(default)s)',
    )
    parser.add_argument('--node', default='stavpr', help='name of the node (%(default)s)')
    return parser


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > MAX_PORT:
        raise argparse.ArgumentTypeError(f'{text!r}: expected a port, 0 to {MAX_PORT}')
    return int(text)


if __name__ == '__main__':
    sys.exit(main())
