# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Maps of a fleet: larger than the memory of a robot, or shared by many robots.

Optional: only maps that are named by an address (``faiss:FILE``, ``qdrant://HOST:PORT/NAME``)
import this package. docs/fleet.md explains it.
"""

from stavpr_fleet.addresses import open_city_map, upload
from stavpr_fleet.city_map import CityMap
from stavpr_fleet.recognizer import FleetMap, FleetRecognizer
from stavpr_fleet.store import PlaceStore

__all__ = [
    'CityMap',
    'FleetMap',
    'FleetRecognizer',
    'PlaceStore',
    'open_city_map',
    'upload',
]
