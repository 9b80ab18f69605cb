# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``stavpr COMMAND``: all executables of the package behind one name on the PATH."""

import importlib
import importlib.util
import sys

import stavpr_ros
from stavpr_ros import plugins
from stavpr_ros.commands import Command, COMMANDS
from stavpr_ros.commands.program import run_program, suggestion

ROS_MODULES = ('rclpy', 'ament_index_python', 'stavpr_msgs')

_BY_PACKAGE = {
    'stavpr_lab': 'weights export_model build_descriptor_map evaluate experiments demo monitor',
    'stavpr_slam': 'pose_graph optimize_graph bridge',
    'stavpr_nav': 'teach repeat',
}
PACKAGES = {name: package for package, names in _BY_PACKAGE.items() for name in names.split()}
"""Packages of the commands that are not in this one, for the message where one is missing."""


def all_commands() -> dict[str, Command]:
    """Return the commands of this package and of all others that are installed."""
    commands = dict(COMMANDS)
    for table in plugins.load(plugins.COMMANDS).values():
        for name, command in table.items():
            commands.setdefault(name, command)
    return commands


def usage() -> str:
    """Return the help text."""
    commands = all_commands()
    width = max(map(len, commands)) + 2
    rows = ''.join(
        f'  {name:<{width}}{row.summary}{" (ROS 2)" * row.needs_ros}\n'
        for name, row in commands.items()
    )
    return (
        'usage: stavpr COMMAND [OPTION ...]\n'
        '       stavpr COMMAND --help | --help | --version\n\n'
        f'commands:\n{rows}\n'
        'In a sourced ROS 2 workspace, `ros2 run PACKAGE COMMAND` runs the same commands.'
    )


def forget_requirements() -> None:
    """
    Keep ``pkg_resources`` from checking the requirements of this distribution.

    It does so when a library imports it in a script that setuptools generated for colcon, and
    fails where a Debian package provides a requirement under another distribution name.
    """
    vars(sys.modules['__main__']).pop('__requires__', None)


def main(args: list[str] | None = None) -> int:
    """Run a command; return its exit code, 2 for a usage error or a missing ROS installation."""
    forget_requirements()
    return run_program('stavpr', lambda: _main(sys.argv[1:] if args is None else args))


def _main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ('-h', '--help'):
        print(usage(), file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name, rest = arguments[0], arguments[1:]
    if name == '--version':
        print(f'stavpr {stavpr_ros.__version__}')
        return 0
    command = COMMANDS.get(name) or all_commands().get(name)
    if command is None:
        names = all_commands()
        reason = f'unknown command {name!r}; choose from {", ".join(names)}'
        reason += suggestion(name, names)
        if name in PACKAGES:
            reason = f'{name} is in the package {PACKAGES[name]}, which is not installed'
        print(f'stavpr: {reason}', file=sys.stderr)
        return 2
    missing = [module for module in ROS_MODULES if importlib.util.find_spec(module) is None]
    if missing and command.needs_ros:
        print(
            f'stavpr {name}: needs ROS 2, but Python finds no {", ".join(missing)}: source '
            '/opt/ros/jazzy/setup.bash and the install/setup.bash of the workspace that colcon '
            'built, or, without a ROS installation, run `make shell` in the repository',
            file=sys.stderr,
        )
        return 2
    return importlib.import_module(command.module).main(rest)
