"""A synthetic street and two traverses of it, for the demonstration and for tests."""

from stavpr_ros.demonstration.street.traverses import (
    GOOD_LIGHT,
    RAINY_DUSK,
    Conditions,
    Traverse,
    Route,
    World,
    WorldFrame,
    first_traverse,
    ground_truth,
    second_traverse,
)

__all__ = [
    'GOOD_LIGHT',
    'RAINY_DUSK',
    'Conditions',
    'Traverse',
    'Route',
    'World',
    'WorldFrame',
    'first_traverse',
    'ground_truth',
    'second_traverse',
]
