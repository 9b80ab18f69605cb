# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands of this package, one in each module, and their table."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """
    A command of ``stavpr``.

    :param module: full name; its ``main(arguments)`` returns the exit code.
    :param summary: one line for ``stavpr --help``.
    :param needs_ros: whether it imports ROS.
    """

    module: str
    summary: str
    needs_ros: bool = False


COMMANDS = {
    'build_map': Command(
        'stavpr_ros.commands.build_map', 'build a reference map from images, a video or a bag'
    ),
    'map': Command('stavpr_ros.commands.map', 'show, check, compact, merge and recover maps'),
    'node': Command('stavpr_ros.commands.node', 'run the place-recognition node', True),
    'replay': Command(
        'stavpr_ros.commands.replay', 'publish a bag, a video or images to the node', True
    ),
    'record': Command(
        'stavpr_ros.commands.record', 'write matches or loop closures to a JSON Lines file', True
    ),
    'warm': Command('stavpr_ros.commands.warm', 'compile the kernels into their cache, once'),
}
