# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Addresses of maps: ``faiss:FILE``, ``qdrant:FOLDER``, ``qdrant://HOST:PORT/COLLECTION``."""

from stavpr_fleet.faiss_store import FaissStore, upload_to_faiss
from stavpr_fleet.qdrant_store import (
    EdgePoints,
    Points,
    QdrantStore,
    server_points,
    upload_to_qdrant,
)
from stavpr_fleet.recognizer import FleetMap
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.stores import Store


def open_city_map(address: str) -> FleetMap:
    """
    Open the map at an address; places are fetched on use.

    :raises StavprError: no map there, it cannot be reached, or a package is missing.
    """
    scheme, _, rest = address.partition(':')
    return FleetMap.of(FaissStore(rest) if scheme == 'faiss' else QdrantStore(_points(address)))


def upload(place_map: Map, address: str, force: bool = False) -> None:
    """
    Write a map to an address.

    :param force: replace what is there.
    :raises StavprError: it cannot be written, something is there, or a package is missing.
    """
    scheme, _, rest = address.partition(':')
    if scheme == 'faiss':
        upload_to_faiss(place_map, rest, force)
    else:
        upload_to_qdrant(place_map, _points(address), force)


def _points(address: str) -> Points:
    return server_points(address) if '://' in address else EdgePoints(address.partition(':')[2])


STORE = Store(open_city_map, upload)
