# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Declaration of the parameters on a node."""

from collections.abc import Iterable
import difflib
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from stavpr_ros.parameters import BY_NAME, NodeParameter, PARAMETERS

_RCLPY_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


def descriptor(row: NodeParameter) -> ParameterDescriptor:
    """Return the descriptor of a row of the table."""
    result = ParameterDescriptor(
        name=row.name,
        description=row.sentence + (f' [{row.unit}]' if row.unit else ''),
        additional_constraints=row.constraints,
        read_only=row.when == 'start',
    )
    if row.bounds is not None:
        low, high = row.bounds
        if isinstance(row.default, int):
            result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
        else:
            result.floating_point_range = [
                FloatingPointRange(from_value=low, to_value=high, step=0.0)
            ]
    return result


def declare_parameters(node: Node) -> dict[str, Any]:
    """Declare the parameters on a node and return their values, name to value."""
    return {
        row.name: node.declare_parameter(row.name, row.default, descriptor(row)).value
        for row in PARAMETERS
    }


def unknown_parameters(given: Iterable[str]) -> list[str]:
    """Return a warning for each unknown parameter, with the most similar name."""
    warnings = []
    for name in given:
        if name in BY_NAME or name.startswith(_RCLPY_PARAMETERS):
            continue
        near = difflib.get_close_matches(name, BY_NAME, 1)
        hint = f': did you mean {near[0]}?' if near else ': see `ros2 param list`'
        warnings.append(f'parameter {name!r} is unknown{hint}')
    return warnings
