# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A synthetic street and two traverses of it, for the demonstration and for tests."""

from stavpr_lab.demonstration.street.traverses import (
    AFTERNOON,
    Conditions,
    first_traverse,
    GOOD_LIGHT,
    nearest_places,
    RAINY_DUSK,
    second_traverse,
    Traverse,
    World,
)

__all__ = [
    'AFTERNOON',
    'GOOD_LIGHT',
    'RAINY_DUSK',
    'Conditions',
    'Traverse',
    'World',
    'first_traverse',
    'nearest_places',
    'second_traverse',
]
