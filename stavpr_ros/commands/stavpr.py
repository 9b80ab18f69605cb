# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr COMMAND``: all executables of the package behind one name on the PATH."""

import importlib
import importlib.util
import sys

import stavpr_ros

ROS_MODULES = ('rclpy', 'ament_index_python', 'stavpr_msgs')


COMMANDS = {
    'build_map': 'build a reference map from a folder of images or a bag',
    'map': 'show, check, convert, export, merge and recover maps',
    'weights': 'download the published weights of a network',
    'export_model': 'make one ONNX file of a network of vectors and maps',
    'evaluate': 'evaluate the recognition of one traverse on the map of another',
    'experiments': "reproduce the paper's tables on local data sets",
    'node': 'run the place-recognition node (ROS 2)',
    'replay': 'publish a bag or a folder of images to the node (ROS 2)',
    'record': 'write matches or loop closures to a JSON Lines file (ROS 2)',
    'monitor': 'show the node in a web browser (ROS 2)',
    'pose_graph': 'correct odometry by loop closures (ROS 2)',
    'bridge': 'pass loop closures on to RTAB-Map and others (ROS 2)',
    'demo': 'build, run and evaluate everything on a synthetic street (ROS 2)',
}
NEED_ROS = ('node', 'replay', 'record', 'monitor', 'pose_graph', 'bridge', 'demo')


def usage() -> str:
    """Return the help text."""
    rows = ''.join(f'  {name:<14}{summary}\n' for name, summary in COMMANDS.items())
    return (
        'usage: stavpr COMMAND [OPTION ...]\n'
        '       stavpr COMMAND --help | --help | --version\n\n'
        f'commands:\n{rows}\n'
        'In a sourced ROS 2 workspace, `ros2 run stavpr_ros COMMAND` runs the same commands.'
    )


def forget_requirements() -> None:
    """
    Keep ``pkg_resources`` from checking the requirements of this distribution.

    It does so when a library imports it in a script that setuptools generated for colcon, and
    fails where a Debian package provides a requirement under another distribution name.
    """
    vars(sys.modules['__main__']).pop('__requires__', None)


def main(args: list[str] | None = None) -> int:
    """
    Run a command.

    :param args: arguments without the program name; None takes those of the process.
    :returns: the command's exit code; 2 for a usage error or a missing ROS installation.
    """
    forget_requirements()
    arguments = sys.argv[1:] if args is None else args
    if not arguments or arguments[0] in ('-h', '--help'):
        print(usage(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name, rest = arguments[0], arguments[1:]
    if name == '--version':
        print(f'stavpr {stavpr_ros.__version__}')
        return 0
    if name not in COMMANDS:
        print(
            f'stavpr: unknown command {name!r}; choose from {", ".join(COMMANDS)}', file=sys.stderr
        )
        return 2
    missing = [module for module in ROS_MODULES if importlib.util.find_spec(module) is None]
    if missing and name in NEED_ROS:
        print(
            f'stavpr {name}: needs ROS 2, but Python finds no {", ".join(missing)}: source '
            '/opt/ros/jazzy/setup.bash and the install/setup.bash of the workspace that colcon '
            'built',
            file=sys.stderr,
        )
        return 2
    exit_code: int = importlib.import_module(f'stavpr_ros.commands.{name}').main(rest)
    return exit_code


if __name__ == '__main__':
    sys.exit(main())
