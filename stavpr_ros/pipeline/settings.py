# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the pipeline and of the node, built from the values of the parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
import os
from pathlib import Path
from typing import Any

from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.checks import require_choice
from stavpr_ros.devices import choose_backend, why_no_cuda
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import AUTO, kinds, settings_class, settings_from_json
from stavpr_ros.mapping.camera import mount_of
from stavpr_ros.mapping.keyframes import KeyframeSettings
from stavpr_ros.mapping.stores import is_address
from stavpr_ros.method import RecognizerSettings
from stavpr_ros.method.loop_closer import least_limit
from stavpr_ros.method.verification import GeometricSettings
from stavpr_ros.parameters import BY_NAME, default
from stavpr_ros.pipeline.maps_folder import maps_folder

OPERATIONS = BY_NAME['operation'].choices


@dataclass(frozen=True)
class PipelineSettings(RecognizerSettings):
    """
    Settings of the pipeline, which extend the settings of its recognizer.

    Fields that are not explained here are parameters (:mod:`stavpr_ros.parameters`).

    :param features: kind of the features of a route that starts without a map, or ``auto``.
    :param feature_settings: settings of that kind as a JSON object, '' = its defaults.
    :param candidates: nearest places that every match lists.
    :param geometric: the geometric check of matches, None = off.
    :raises SettingsError: a value out of range, or values that exclude each other.
    """

    backend: str = default('backend')
    precision: str = default('precision')
    model_path: str = default('model_path')
    features: str = default('features')
    feature_settings: str = default('feature_settings')
    exclude_places: int = default('exclude_places')
    exclude_seconds: float = default('exclude_seconds')
    max_places: int = default('max_places')
    thumbnail_width: int = default('thumbnail_width')
    candidates: int = default('candidates')
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)
    geometric: GeometricSettings | None = None
    update_map: bool = default('update_map')

    def __post_init__(self) -> None:
        if self.feature_settings:
            settings_from_json(self.features, self.feature_settings, self.model_path)
        elif self.features != AUTO:
            settings_class(self.features)  # rejects an unknown kind
        super().__post_init__()

    def require_operation(self, operation: str) -> None:
        """Raise SettingsError if these settings exclude an operation."""
        require_choice('operation', operation, OPERATIONS)
        if self.geometric is not None and operation != 'localization' and not self.thumbnail_width:
            raise SettingsError(
                f'geometric_check = {self.geometric.method} with thumbnail_width = 0 and '
                f'operation {operation}: the check compares images with thumbnails'
            )
        if self.direction != 'forward' and operation != 'localization':
            raise SettingsError(
                f'direction = {self.direction} with operation {operation}: a route that grows is '
                'recognized along it; take operation localization, or forward'
            )
        min_places = least_limit(self.exclude_places, self.sequence.length)
        if operation == 'loop_closure' and self.max_places < min_places:
            raise SettingsError(
                f'max_places = {self.max_places} leaves too few beyond exclude_places = '
                f'{self.exclude_places}: take at least {min_places}'
            )

    def matching_backend(self, operation: str) -> str:
        """
        Return the backend of the image distances: ``cuda``, or ``cpu``, always for loop closure.

        :raises UnavailableError: ``cuda`` is set and not available.
        """
        backend = str(choose_backend(self.backend))
        return 'cpu' if operation == 'loop_closure' else backend

    def backend_summary(self, operation: str) -> str:
        """Return one line for the log: the device of each stage, and why."""
        why = f' ({why_no_cuda() or "torch has a CUDA device"})' if self.backend == 'auto' else ''
        summary = f'backend {self.backend}{why}: networks on {choose_backend(self.backend)}'
        if operation == 'mapping':
            return summary
        matching = self.matching_backend(operation)
        precision = self.precision
        if precision == 'auto':
            rounds = matching == 'cpu' and operation == 'localization' and self.mode == 'robust'
            precision = 'int8 from 2,000 places on' if rounds else 'float32'
        if self.precision == 'int8' and matching == 'cpu':
            from stavpr_ros.alignment.cpu.int8 import INSTRUCTION

            precision = f'int8, {INSTRUCTION} kernel'
        return f'{summary}, image distances on {matching} ({precision}), sequences on {matching}'

    def extractor(self) -> FeatureExtractor:
        """
        Make the extractor of a route that starts without a map.

        :raises StavprError: invalid settings of the features, or a missing model file.
        """
        backbone = None
        if self.features != AUTO:
            backbone = settings_from_json(
                self.features, self.feature_settings or '{}', self.model_path
            )
        elif self.model_path:
            raise SettingsError(
                f'model_path {self.model_path!r} with features {AUTO}: name the kind of that '
                'network, such as features hybrid, or leave it out'
            )
        return FeatureExtractor(self.features, backbone, device=self.extraction_device)

    @property
    def extraction_device(self) -> str:
        """Return the requested device of the features; ``auto`` takes the backend's."""
        return 'cpu' if choose_backend(self.backend) == 'cpu' else self.backend


@dataclass(frozen=True, kw_only=True)
class NodeSettings:
    """
    Settings of the node, parameters of these names.

    :raises SettingsError: the operation and the settings of the pipeline exclude each other.
    """

    operation: str
    map_path: str
    maps_folder: str
    autostart: bool
    bond_heartbeat_period: float
    image_transport: str
    queue_size: int
    max_rate: float
    max_stamp_gap: float
    odometry_timeout: float
    save_path: str
    map_frame: str
    robot_id: str
    diagnostics_period: float
    verbosity: str
    threads: int
    publish_tf: bool
    transform_tolerance: float
    publish_initialpose: bool
    localized_probability: float
    lost_images: int
    lost_distance: float
    subgoal_distance: float
    subgoal_width: int
    relative_pose: str
    camera_transform: str
    pipeline: PipelineSettings

    def __post_init__(self) -> None:
        self.pipeline.require_operation(self.operation)
        mount_of(self.camera_transform)  # rejects an invalid one

    @property
    def maps_path(self) -> Path:
        """Return the folder of the maps that services and late parameters name."""
        return maps_folder(self.maps_folder)

    @property
    def needs_odometry(self) -> bool:
        """Return whether poses are used: for keyframes, a growing map, or the transform."""
        used = self.pipeline.keyframes.needs_poses or self.publish_tf
        return used or self.operation != 'localization'

    def unmet(self, has_poses: bool, has_thumbnails: bool) -> str:
        """Return which parameters require of a map in localization what it lacks, '' = none."""
        rows = (
            ('publish_tf', self.publish_tf, 'poses', has_poses),
            ('publish_initialpose', self.publish_initialpose, 'poses', has_poses),
            ('relative_pose pnp', self.relative_pose == 'pnp', 'poses', has_poses),
            ('relative_pose pnp', self.relative_pose == 'pnp', 'thumbnails', has_thumbnails),
            ('geometric_check', self.pipeline.geometric is not None, 'thumbnails', has_thumbnails),
        )
        unmet = [f'{name} requires {what}' for name, is_set, what, has in rows if is_set > has]
        if not unmet or self.operation != 'localization':
            return ''
        remedy = 'record it with odometry on odom and a thumbnail_width, or leave these out'
        return f'the map does not fit: {", ".join(unmet)}; {remedy}'


def node_settings(values: Mapping[str, Any]) -> NodeSettings:
    """
    Build the settings from the values of all parameters.

    :raises SettingsError: a value out of range, or values that exclude each other.
    :raises UnavailableError: the backend is not available.
    """
    for name, value in values.items():
        choices = (AUTO, *kinds()) if name == 'features' else BY_NAME[name].choices
        if choices:
            require_choice(name, value, choices)
    values = {**values, 'threshold': None if values['threshold'] < 0 else values['threshold']}
    for name in ('map_path', 'save_path'):  # a file, '' = none, or the address of a fleet's map
        if (path := values[name]) and not is_address(path):
            values[name] = os.path.abspath(os.path.expanduser(path))
    values['model_path'] = os.path.expanduser(values['model_path'])  # or a word: cached, download
    method = values['geometric_check']
    pipeline = PipelineSettings(
        sequence=SequenceSettings(values['sequence_length']),
        keyframes=KeyframeSettings(
            values['keyframe_interval'],
            values['keyframe_distance'],
            values['keyframe_angle_deg'],
            values['keyframe_change'],
        ),
        geometric=None if method == 'none' else GeometricSettings(method, values['min_inliers']),
        **_parameters_of(PipelineSettings, values),
    )
    choose_backend(pipeline.backend)
    return NodeSettings(pipeline=pipeline, **_parameters_of(NodeSettings, values))


def _parameters_of(settings: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the parameters that are fields of these settings."""
    names = (row.name for row in fields(settings))
    return {name: values[name] for name in names if name in values}
