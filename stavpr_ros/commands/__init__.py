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


TEXTS = {
    'build_map': 'build a reference map from images, a video or a bag',
    'map': 'show, check, compact, merge and recover maps',
    'node': 'run the place-recognition node',
    'replay': 'publish a bag, a video or images to the node',
    'record': 'write matches or loop closures to a JSON Lines file',
    'warm': 'compile the kernels into their cache, once',
}
WITH_ROS = {'node', 'replay', 'record'}
COMMANDS = {
    name: Command(f'stavpr_ros.commands.{name}', text, name in WITH_ROS)
    for name, text in TEXTS.items()
}
