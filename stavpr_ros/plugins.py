# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Imports what other packages add, by the entry points of a group."""

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
import logging
from typing import Any

COMMANDS = 'stavpr.commands'
"""Tables of commands; see :mod:`stavpr_ros.commands`."""

MAP_TOOLS = 'stavpr.map_tools'
"""Functions that ``stavpr map`` calls: ``align``, ``colmap`` and ``plot``."""

FEATURES = 'stavpr.features'
"""Kinds of features; see :class:`stavpr_ros.features.registry.Kind`."""

STORES = 'stavpr.stores'
"""Schemes of addresses of maps; see :class:`stavpr_ros.mapping.stores.Store`."""

KERNELS = 'stavpr.kernels'
"""Functions that compile the kernels of their package, for ``stavpr warm``."""


def resolve(target: str) -> Any:
    """Import and return the object that ``package.module:name`` names."""
    module, name = target.split(':')
    return getattr(import_module(module), name)


def one(group: str, name: str) -> Any:
    """
    Import the object of one entry point of a group; None = no package has it.

    :raises ImportError: its module, or one that it needs, is missing.
    """
    entry = next(iter(entry_points(group=group, name=name)), None)
    return None if entry is None else entry.load()


@cache
def load(group: str) -> dict[str, Any]:
    """
    Import the entry points of a group.

    :param group: one of the constants above.
    :returns: the objects by the names of their entry points; one that cannot be imported is named
        in a warning and skipped.
    """
    objects = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
        try:
            objects[entry.name] = entry.load()
        except Exception as error:  # whatever a module of another package raises
            logging.getLogger('stavpr_ros').warning(
                'skipped the plug-in %s of %s (%s): %s: %s',
                entry.name,
                entry.dist.name if entry.dist else 'an unknown package',
                entry.value,
                type(error).__name__,
                error,
            )
    return objects
