"""A made-up street and two drives along it: the demonstration's world, and test data without data."""

from stavpr_ros.demonstration.street.traverses import (
    GOOD_LIGHT,
    RAINY_DUSK,
    Conditions,
    Drive,
    Route,
    World,
    WorldFrame,
    first_drive,
    ground_truth,
    second_drive,
)

__all__ = [
    'GOOD_LIGHT',
    'RAINY_DUSK',
    'Conditions',
    'Drive',
    'Route',
    'World',
    'WorldFrame',
    'first_drive',
    'ground_truth',
    'second_drive',
]
