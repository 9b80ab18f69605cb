# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The commands of this package, and their table."""

from stavpr_ros.commands import Command

COMMANDS = {
    'teach': Command('stavpr_nav.commands.teach', 'record the velocities of a taught run', True),
    'repeat': Command('stavpr_nav.commands.repeat', 'drive along a taught route', True),
}
