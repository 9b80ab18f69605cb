"""The node's parameters: one table, from which declaration, documentation and configuration follow."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from stavpr_ros.alignment.settings import STRATEGIES
from stavpr_ros.devices import BACKENDS
from stavpr_ros.recognition.cures import MODES
from stavpr_ros.recognition.matcher import PRECISIONS

TABLE_HEAD = '| parameter | default | unit | live | what it does |'


@dataclass(frozen=True)
class NodeParameter:
    """
    One row of the table.

    :param default: its type is the parameter's type.
    :param bounds: smallest and largest value, or None.
    :param choices: the values allowed, for strings.
    :param live: can be set while the node runs.
    """

    name: str
    default: Any
    unit: str
    sentence: str
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """Return the row as ROS knows it."""
        descriptor = ParameterDescriptor(
            name=self.name,
            description=self.sentence + (f' [{self.unit}]' if self.unit else ''),
            read_only=not self.live,
        )
        if self.choices:
            descriptor.additional_constraints = 'one of: ' + ', '.join(self.choices)
        if self.bounds is not None:
            low, high = self.bounds
            if isinstance(self.default, int):
                descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=low, to_value=high, step=0.0)
                ]
        return descriptor


PARAMETERS = (
    NodeParameter(
        'map_path', '', '', 'Map file made by build_map; the node waits until it is set.', live=True
    ),
    NodeParameter(
        'threshold',
        -1.0,
        'distance',
        'A window is matched when its distance is below this; negative = 1 in mode robust, where 1 is as '
        'near as unknown places come; in mode paper the node waits until it is set.',
        bounds=(-1.0, 1e6),
        live=True,
    ),
    NodeParameter(
        'mode',
        'robust',
        '',
        'How places are recognised: paper is STA-VPR as published; robust goes beyond it.',
        choices=MODES,
    ),
    NodeParameter(
        'backend',
        'auto',
        '',
        'Where images are matched; auto takes cuda if it is there and says what it took.',
        choices=BACKENDS,
    ),
    NodeParameter(
        'precision',
        'float32',
        '',
        "How the map's features are kept; float16 takes half the memory and, on large maps, half the time.",
        choices=PRECISIONS,
    ),
    NodeParameter(
        'strategy',
        'adaptive',
        '',
        'How the strips of two images are aligned.',
        choices=STRATEGIES,
    ),
    NodeParameter(
        'sigma', 1.0, '', 'How strongly a viewpoint change penalises diagonal steps.', bounds=(0.0, 100.0)
    ),
    NodeParameter(
        'xi',
        0,
        'strips',
        'Restricted alignment: strips this far apart are never aligned; 0 = no restriction.',
        bounds=(0, 1000),
    ),
    NodeParameter(
        'vertical',
        False,
        '',
        'Align the cells of two strips from top to bottom first, for cameras that rise and sink; slow.',
    ),
    NodeParameter('sequence_length', 20, 'images', 'Images in the query window, l.', bounds=(2, 1000)),
    NodeParameter(
        'beta',
        2.0,
        '',
        'Map images considered per query image, above 1 (mode paper).',
        (1.01, 20.0),
    ),
    NodeParameter(
        'neighbourhood',
        20,
        'places',
        'The runner-up is more than so many places from the nearest.',
        bounds=(0, 1000000),
    ),
    NodeParameter(
        'model_path',
        '',
        '',
        "File of the network, for maps made with one, if it is not where the map's maker had it.",
    ),
    NodeParameter(
        'queue_size',
        4,
        'images',
        'Images that may wait; when one more comes, the oldest is dropped.',
        bounds=(1, 1000),
    ),
    NodeParameter('threads', 0, 'threads', 'Processor threads for the numerics; 0 = all.', bounds=(0, 1024)),
)


def declare_parameters(node: Node) -> dict[str, Any]:
    """Declare the whole table on a node and return the values, name to value."""
    return {
        row.name: node.declare_parameter(row.name, row.default, row.descriptor()).value for row in PARAMETERS
    }


def configuration_yaml() -> str:
    """Return the table as a parameter file for ``--params-file``, with the defaults."""
    lines = ['# The parameters of the node with their defaults. Generated from stavpr_ros/ros/parameters.py;']
    lines += ['# a test fails when they differ.', '/**:', '  ros__parameters:']
    for row in PARAMETERS:
        lines.append(f'    # {row.descriptor().description}')
        default = f"'{row.default}'" if isinstance(row.default, str) else row.default
        lines.append(f'    {row.name}: {default}')
    return '\n'.join(lines) + '\n'


def documentation_markdown() -> str:
    """Return the table as Markdown for the README."""
    lines = [TABLE_HEAD, '|---|---|---|---|---|']
    for row in PARAMETERS:
        default = f"`'{row.default}'`" if isinstance(row.default, str) else f'`{row.default}`'
        sentence = row.sentence + (f' ({", ".join(row.choices)})' if row.choices else '')
        lines.append(
            f'| `{row.name}` | {default} | {row.unit} | {"yes" if row.live else "no"} | {sentence} |'
        )
    return '\n'.join(lines) + '\n'


def _write_documentation() -> None:
    """Write the table into the configuration file and the README of the checkout in the current folder."""
    Path('config/stavpr.yaml').write_text(configuration_yaml())
    readme = Path('README.md')
    before, _, rest = readme.read_text().partition(TABLE_HEAD)
    after = rest.partition('\n\n')[2]
    readme.write_text(f'{before}{documentation_markdown()}\n{after}')


if __name__ == '__main__':
    _write_documentation()
