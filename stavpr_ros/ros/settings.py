"""The values of the node's parameters, checked one by one and together."""

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.devices import choose_backend
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping.keyframes import KeyframeSettings
from stavpr_ros.pipeline import PipelineSettings
from stavpr_ros.recognition.loop_closer import least_limit
from stavpr_ros.recognition.verification import GeometricSettings
from stavpr_ros.ros.parameters import BY_NAME

_OF_RCLPY = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


@dataclass(frozen=True)
class NodeSettings:
    """
    The parameters as the node uses them.

    :param values: of all parameters, name to value.
    :param pipeline: those that decide the answers; its backend is chosen.
    """

    values: Mapping[str, Any]
    pipeline: PipelineSettings

    @property
    def wants_odometry(self) -> bool:
        """Poses are asked for: by the keyframes, or for the places of a growing map."""
        return self.pipeline.keyframes.needs_poses or self.operation != 'localization'

    def __getattr__(self, name: str) -> Any:
        """Return the value of a parameter."""
        try:
            return self.values[name]
        except KeyError:
            raise AttributeError(name) from None


def node_settings(values: Mapping[str, Any]) -> NodeSettings:
    """
    Check the values of all parameters together.

    :raises SettingsError: a value that cannot be meant, or values that do not go together.
    :raises UnavailableError: a backend that is not here.
    """
    for name, value in values.items():
        choices = BY_NAME[name].choices
        if choices and value not in choices:
            raise SettingsError(f'{name} = {value!r} is unknown: take one of {", ".join(choices)}')
    operation, spatial = values['operation'], _spatial(values)
    if operation == 'loop_closure' and (spatial.vertical or spatial.strategy not in ('adaptive', 'vanilla')):
        raise SettingsError(
            f'operation loop_closure with strategy {spatial.strategy}, vertical {spatial.vertical}: take '
            'strategy adaptive or vanilla, without vertical alignment'
        )
    least = least_limit(values['exclude_places'], values['sequence_length'])
    if operation == 'loop_closure' and values['max_places'] < least:
        raise SettingsError(
            f'max_places = {values["max_places"]} leaves too few beyond exclude_places = '
            f'{values["exclude_places"]}: take at least {least}'
        )
    method = values['geometric_check']
    if method != 'none' and operation != 'localization' and not values['thumbnail_width']:
        raise SettingsError(
            f'geometric_check = {method} with thumbnail_width = 0: it compares images with those pictures'
        )
    pipeline = PipelineSettings(
        threshold=None if values['threshold'] < 0 else values['threshold'],
        spatial=spatial,
        sequence=SequenceSettings(values['sequence_length'], values['beta']),
        keyframes=KeyframeSettings(
            values['keyframe_interval'],
            values['keyframe_distance'],
            values['keyframe_angle'],
            values['keyframe_change'],
        ),
        geometric=None if method == 'none' else GeometricSettings(method, values['min_inliers']),
        backend=choose_backend(values['backend']),
        **{
            name: values[name]
            for name in (
                'nms_radius',
                'mode',
                'precision',
                'model_path',
                'features',
                'feature_settings',
                'exclude_places',
                'exclude_seconds',
                'max_places',
                'thumbnail_width',
                'candidates',
            )
        },
    )
    return NodeSettings(dict(values), pipeline)


def _spatial(values: Mapping[str, Any]) -> SpatialSettings:
    return SpatialSettings(values['strategy'], values['sigma'], values['xi'] or None, values['vertical'])


def unknown_parameters(given: Iterable[str]) -> list[str]:
    """Say, in words, which of the given parameters the node does not have, and which may have been meant."""
    said = []
    for name in given:
        if name in BY_NAME or name.startswith(_OF_RCLPY):
            continue
        near = difflib.get_close_matches(name, BY_NAME, 1)
        meant = f': was {near[0]} meant?' if near else ': see `ros2 param list`'
        said.append(f'parameter {name!r} is not one of this node{meant}')
    return said
