# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Addresses of maps that are not files, ``SCHEME:...``, and the store of each scheme."""

from collections.abc import Callable
from dataclasses import dataclass

from stavpr_ros import plugins
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.place_map import PlaceMap

FLEET = 'stavpr_ros.fleet.addresses:STORE'
BUILT_IN = {'faiss': FLEET, 'qdrant': FLEET, 'qdrant+https': FLEET}
"""Schemes and their stores as MODULE:NAME, found without entry points and imported on use."""


@dataclass(frozen=True)
class Store:
    """
    What is behind a scheme; an entry point of the group ``stavpr.stores``, named by the scheme.

    :param open_map: opens the map at an address, whose places are fetched on use; such a map is
        ``partial``, and its ``recognizer(settings)`` returns a ``SequenceRecognizer``.
    :param upload: writes a map to an address; its third argument permits to replace one.
    """

    open_map: Callable[[str], PlaceMap]
    upload: Callable[[PlaceMap, str, bool], None]


def schemes() -> list[str]:
    """Return the schemes that have a store."""
    return list(BUILT_IN | plugins.load(plugins.STORES))


def is_address(path: str) -> bool:
    """Return whether this is the address of a map in a store, not a file: docs/fleet.md."""
    scheme, colon, _ = path.partition(':')
    return bool(colon) and (scheme in BUILT_IN or scheme in schemes())


def store_of(address: str) -> Store:
    """
    Return the store of an address; imports its module.

    :raises SettingsError: no store has this scheme.
    """
    if not is_address(address):
        known = ', '.join(f'{name}:' for name in schemes())
        raise SettingsError(f'{address} is no address: expected one that begins with {known}')
    scheme = address.partition(':')[0]
    target = BUILT_IN.get(scheme)
    store: Store = plugins.resolve(target) if target else plugins.load(plugins.STORES)[scheme]
    return store
