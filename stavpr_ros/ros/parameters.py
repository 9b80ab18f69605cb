# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Declaration of the parameters on a node, and the rules for their changes."""

from collections.abc import Iterable, Mapping
import difflib
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.parameter import Parameter
from stavpr_ros.checks import require_plain
from stavpr_ros.errors import OutputError, SettingsError
from stavpr_ros.output_file import require_room
from stavpr_ros.parameters import (
    BY_NAME,
    EXPECTED,
    NodeParameter,
    PARAMETERS,
    REMOVED,
    RENAMED,
)
from stavpr_ros.pipeline.maps_folder import inside
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.sources.video_topic import FFMPEG, FOXGLOVE

_RCLPY_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
_FILES = ('map_path', 'save_path', 'model_path')
_TEXT = """text; quote a number or a truth value twice: "'2'\""""
_CHANGED_BY_SERVICE = {'map_path': 'load_map', 'operation': 'set_operation'}


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
            result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            result.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return result


def convert_type(parameter: Parameter) -> Parameter:
    """
    Return a parameter with the type of its row; rclpy rejects an integer in place of a double.

    :raises SettingsError: another type, or a text that is too long or has control characters;
        names the parameter.
    """
    row, value = BY_NAME.get(parameter.name), parameter.value
    if isinstance(value, str) and parameter.name != 'feature_settings':  # JSON of any layout
        require_plain(parameter.name, value)
    if row is None or type(value) is type(row.default):
        return parameter
    if isinstance(row.default, float) and type(value) is int:
        return Parameter(row.name, value=float(value))
    raise SettingsError(
        f'{row.name} = {value!r} has the wrong type: '
        f'expected {EXPECTED.get(type(row.default), _TEXT)}'
    )


def declare_parameters(node: ManagedNode) -> dict[str, Any]:
    """
    Declare the parameters on a node and return their values, name to value.

    Earlier names are accepted; of both, the new one counts.

    :raises SettingsError: a parameter was given with the wrong type.
    """
    rows = node.parameter_overrides
    overrides = {RENAMED[name]: row for name, row in rows.items() if name in RENAMED} | rows
    values = {}
    for row in PARAMETERS:
        value = convert_type(overrides[row.name]).value if row.name in overrides else row.default
        node.declare_parameter(row.name, value, descriptor(row), ignore_override=True)
        values[row.name] = value
    return values


def unknown_parameters(names: Iterable[str]) -> list[str]:
    """Return a warning for each unknown parameter, with the most similar name or a remedy."""
    warnings = []
    for name in names:
        if name in BY_NAME or name.startswith(_RCLPY_PARAMETERS):
            continue
        if name in RENAMED:
            warnings.append(renaming_warning(name))
            continue
        if name in REMOVED:
            warnings.append(f'parameter {name!r} was removed in 1.0: {REMOVED[name]}')
            continue
        near = difflib.get_close_matches(name, BY_NAME, 1)
        hint = f': did you mean {near[0]}?' if near else ': see `ros2 param list`'
        warnings.append(f'parameter {name!r} is unknown{hint}')
    return warnings


def renaming_warning(name: str) -> str:
    """Return the warning of an earlier name."""
    return f'parameter {name!r} is {RENAMED[name]} now: the earlier name is accepted until 1.1'


def require_changeable(changes: Mapping[str, Any], state: str) -> None:
    """
    Reject parameters that cannot be changed once the node is configured.

    :param changes: name to value, those that differ from the current values.
    :param state: label of the life-cycle state.
    :raises SettingsError: names the parameters and the remedy.
    """
    for name, service in _CHANGED_BY_SERVICE.items():
        if name in changes:
            raise SettingsError(
                f'{name} is read when the node is configured, it is {state}: call the service '
                f'~/{service}'
            )
    if names := [name for name in changes if BY_NAME[name].when != 'live']:
        raise SettingsError(
            f'{", ".join(names)} can be set only while the node is unconfigured, it is {state}: '
            'clean it up first (`ros2 lifecycle set NODE deactivate`, then cleanup)'
        )


TRANSPORTS = {
    'raw': ('sensor_msgs/msg/Image', ''),
    'compressed': ('sensor_msgs/msg/CompressedImage', '/compressed'),
    'ffmpeg': (FFMPEG, '/ffmpeg'),
    'foxglove': (FOXGLOVE, '/foxglove'),
}
"""As in image_transport: the type of the messages, and what follows the topic ``image``."""


def transport_remedy(node: ManagedNode, topic: str) -> str:
    """
    Return the remedy for images that are published in another transport only, '' = none.

    :param topic: of the images, resolved.
    """
    raw = topic
    for _, ending in TRANSPORTS.values():
        raw = raw.removesuffix(ending)
    for transport, (_, ending) in TRANSPORTS.items():
        if (other := raw + ending) != topic and node.count_publishers(other):
            return f'{other} is published: set image_transport to {transport}'
    return ''


def inside_maps_folder(parameter: Parameter, node: ManagedNode, folder: Path) -> Parameter:
    """
    Return a parameter that is set after the start, with the absolute path of the file it names.

    :raises SettingsError: a file outside the maps folder: anyone on the ROS graph may set
        parameters; names the parameter.
    """
    name, value = parameter.name, parameter.value
    if name not in BY_NAME or not value or value == node.get_parameter(name).value:
        return parameter
    if name == 'feature_settings' and '"model"' in value:
        raise SettingsError(
            'feature_settings: the file of a network is not set after the start by "model", but '
            'by parameter model_path'
        )
    if name not in _FILES:
        return parameter
    try:
        return Parameter(name, value=inside(folder, value))
    except SettingsError as error:
        raise SettingsError(f'{name}: {error}') from error


def require_writable(save_path: str) -> None:
    """Raise SettingsError if a file, '' = none, cannot be written: a map would be lost."""
    try:
        if save_path:
            require_room(save_path)
    except OutputError as error:
        raise SettingsError(f'save_path: {error}') from error
