# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Addresses of maps that are not files, ``SCHEME:...``, and the store of each scheme."""

from collections.abc import Callable
from dataclasses import dataclass

from stavpr_ros import plugins
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.mapping.place_map import Map

FLEET = ('faiss', 'qdrant', 'qdrant+https')
"""Schemes of the package stavpr_fleet, for the message where it is missing."""


@dataclass(frozen=True)
class Store:
    """
    What is behind a scheme; an entry point of the group ``stavpr.stores``, named by the scheme.

    :param open_map: opens the map at an address, whose places are fetched on use; such a map is
        ``partial``, and its ``recognizer(settings)`` returns a ``SequenceRecognizer``.
    :param upload: writes a map to an address; its third argument permits to replace one.
    """

    open_map: Callable[[str], Map]
    upload: Callable[[Map, str, bool], None]


def schemes() -> list[str]:
    """Return the schemes that have a store, and the schemes of stavpr_fleet."""
    return sorted({*FLEET, *plugins.load(plugins.STORES)})


def is_address(path: str) -> bool:
    """Return whether this is the address of a map in a store, not a file: docs/fleet.md."""
    scheme, colon, _ = path.partition(':')
    return bool(colon) and (scheme in FLEET or scheme in schemes())


def store_of(address: str) -> Store:
    """
    Return the store of an address; imports its module.

    :raises SettingsError: no store has this scheme.
    :raises UnavailableError: stavpr_fleet has it, and is not installed.
    """
    if not is_address(address):
        names = ', '.join(f'{name}:' for name in schemes())
        raise SettingsError(f'{address} is no address: expected one that begins with {names}')
    scheme = address.partition(':')[0]
    stores = plugins.load(plugins.STORES)
    if scheme not in stores:
        raise UnavailableError(
            f'{address} needs the package stavpr_fleet, which is not installed: build it, or '
            "`pip install '.[fleet]'` in the repository"
        )
    return stores[scheme]
