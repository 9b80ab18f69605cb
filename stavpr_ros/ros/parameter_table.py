"""One row of the table of parameters, and what follows from a table: descriptors, YAML, Markdown."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

TABLE_HEAD = '| parameter | default | unit | set | what it does |'
When = Literal['live', 'unconfigured', 'start']
_WHEN = {
    'live': 'any time',
    'unconfigured': 'while the node is unconfigured',
    'start': 'at the start only',
}


@dataclass(frozen=True)
class NodeParameter:
    """
    One row of the table.

    :param default: its type is the parameter's type.
    :param unit: of the value, '' = none.
    :param sentence: what it does.
    :param when: it can be set at any time, while the node is unconfigured, or at the start only.
    :param bounds: smallest and largest value, or None.
    :param choices: the values allowed, for strings.
    """

    name: str
    default: Any
    unit: str
    sentence: str
    when: When = 'unconfigured'
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()

    def descriptor(self) -> ParameterDescriptor:
        """Return the row as ROS knows it."""
        constraints = ['one of: ' + ', '.join(self.choices)] if self.choices else []
        constraints.append(f'can be set {_WHEN[self.when]}')
        descriptor = ParameterDescriptor(
            name=self.name,
            description=self.sentence + (f' [{self.unit}]' if self.unit else ''),
            additional_constraints='; '.join(constraints),
            read_only=self.when == 'start',
        )
        if self.bounds is not None:
            low, high = self.bounds
            if isinstance(self.default, int):
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=low, to_value=high, step=0.0)
                ]
        return descriptor

    @property
    def literal(self) -> str:
        """The default as YAML has it."""
        if isinstance(self.default, bool):
            return str(self.default).lower()
        return f"'{self.default}'" if isinstance(self.default, str) else str(self.default)


def declare_parameters(node: Node, table: Sequence[NodeParameter]) -> dict[str, Any]:
    """Declare a table on a node and return the values, name to value."""
    return {row.name: node.declare_parameter(row.name, row.default, row.descriptor()).value for row in table}


def configuration_yaml(table: Sequence[NodeParameter]) -> str:
    """Return a table as a parameter file for ``--params-file``, with the defaults."""
    lines = ['# The parameters of the node with their defaults. Generated from stavpr_ros/ros/parameters.py;']
    lines += ['# a test fails when they differ.', '/**:', '  ros__parameters:']
    for row in table:
        descriptor = row.descriptor()
        lines.append(f'    # {descriptor.description}')
        allowed = f' in {row.bounds[0]:g} ... {row.bounds[1]:g};' if row.bounds else ''
        lines.append(f'    #{allowed} {descriptor.additional_constraints}')
        lines.append(f'    {row.name}: {row.literal}')
    return '\n'.join(lines) + '\n'


def documentation_markdown(table: Sequence[NodeParameter]) -> str:
    """Return a table as Markdown for the README."""
    lines = [TABLE_HEAD, '|---|---|---|---|---|']
    for row in table:
        sentence = row.sentence + (f' ({", ".join(row.choices)})' if row.choices else '')
        lines.append(f'| `{row.name}` | `{row.literal}` | {row.unit} | {row.when} | {sentence} |')
    return '\n'.join(lines) + '\n'
