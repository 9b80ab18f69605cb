# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of parameters: files generated from it, and the settings built from it."""

from dataclasses import fields
from pathlib import Path
import re

from parameter_files import configuration_yaml, documentation_markdown
import pytest
from stavpr_ros.devices import BACKENDS
from stavpr_ros.errors import MapFileError, SettingsError
from stavpr_ros.method.settings import MODES
from stavpr_ros.method.verification import METHODS
from stavpr_ros.parameters import BY_NAME, PARAMETERS
from stavpr_ros.pipeline import node_settings, NodeSettings, OPERATIONS, PipelineSettings, read_map
from stavpr_ros.prepare.matcher import PRECISIONS
from stavpr_ros.relative_pose.estimator import METHODS as EDGE_METHODS
import yaml

ROOT = Path(__file__).resolve().parents[1]
REMEDY = 'generate it: python3 tools/parameter_files.py'
DEFAULTS = {row.name: row.default for row in PARAMETERS}
PAPER = {'mode': 'paper', 'min_probability': 0.9}


def test_files_are_generated_from_table():
    written = (ROOT / 'config' / 'stavpr.yaml').read_text()
    assert written == configuration_yaml(), REMEDY
    assert (ROOT / 'docs' / 'parameters.md').read_text() == documentation_markdown(), REMEDY
    values = yaml.safe_load(written)['/**']['ros__parameters']
    assert values == DEFAULTS
    assert [type(value) for value in values.values()] == [type(row.default) for row in PARAMETERS]


def test_rows_are_consistent():
    assert len(BY_NAME) == len(PARAMETERS)
    for row in PARAMETERS:
        assert re.match(
            r'((localization|loop_closure|Mode paper): )?\w+s .*\.$', row.sentence, re.I
        ), f'{row.name}: expected a sentence that begins with what the parameter does'
        assert not row.bounds or row.bounds[0] <= row.default <= row.bounds[1], row.name
        assert not row.choices or row.default in row.choices, row.name


def test_choices_are_those_of_library():
    """The table is imported by launch files and names them once more."""
    library = {
        'operation': OPERATIONS,
        'mode': tuple(MODES),
        'geometric_check': ('none', *METHODS),
        'relative_pose': EDGE_METHODS,
        'backend': BACKENDS,
        'precision': ('auto', *PRECISIONS),
    }
    assert {name: BY_NAME[name].choices for name in library} == library


def test_default_values_give_default_settings():
    settings = node_settings(DEFAULTS)
    expected = PipelineSettings()
    assert settings.pipeline.keyframes.change == DEFAULTS['keyframe_change']
    for field in fields(PipelineSettings):
        if field.name != 'keyframes':  # the library takes every image by default
            assert getattr(settings.pipeline, field.name) == getattr(expected, field.name)
    for field in fields(NodeSettings):
        if field.name != 'pipeline':
            assert getattr(settings, field.name) == DEFAULTS[field.name]


@pytest.mark.parametrize(
    ('values', 'attribute', 'expected'),
    [
        ({'sequence_length': 7}, 'sequence.length', 7),
        ({'min_probability': 0.25}, 'applied_threshold', 0.75),
        ({'max_error': 0.05, 'min_probability': 0.75}, 'applied_threshold', 0.25),
        (PAPER | {'threshold': 0.25}, 'applied_threshold', 0.25),
        (PAPER | {'threshold': -1.0}, 'applied_threshold', None),
        ({'keyframe_interval': 1.5}, 'keyframes.interval', 1.5),
        ({'keyframe_distance': 2.5}, 'keyframes.distance', 2.5),
        ({'keyframe_angle_deg': 3.5}, 'keyframes.angle', 3.5),
        ({'geometric_check': 'sift'}, 'geometric.method', 'sift'),
    ],
)
def test_node_settings_of_values_contain_them(values, attribute, expected):
    setting = node_settings(DEFAULTS | values).pipeline
    for part in attribute.split('.'):
        setting = getattr(setting, part)
    assert setting == expected


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'precision': 'int4'}, "precision = 'int4' is unknown: take one of auto"),
        ({'mode': 'paper', 'threshold': 0.0}, 'threshold = 0.0 must be above 0'),
        (
            {'threshold': 0.8},
            'threshold = 0.8 applies to mode paper: .* min_probability = 0.5; set min_prob',
        ),
        ({'camera_transform': 'x'}, "camera_transform = 'x': expected x y z roll pitch yaw"),
        ({'min_probability': 0.0}, 'min_probability = 0.0 must be above 0 and below 1'),
        ({'min_probability': 1.0}, 'min_probability = 1.0 must be above 0 and below 1'),
        ({'max_error': 0.001}, 'max_error = 0.001: expected 0 = off, or 0.005 to below 1'),
        ({'operation': 'loop_closure', 'max_places': 100}, 'take at least 103'),
        (
            {'operation': 'mapping', 'geometric_check': 'orb', 'thumbnail_width': 0},
            'geometric_check = orb with thumbnail_width = 0',
        ),
    ],
)
def test_invalid_values_are_rejected_by_name(values, words):
    with pytest.raises(SettingsError, match=words):
        node_settings(DEFAULTS | values)


def test_paths_are_absolute_and_expanded(environ, working_folder):
    environ['HOME'] = '/home/robot'
    options = {'map_path': '~/a.stavpr', 'save_path': 'b.stavpr', 'model_path': '~/net.onnx'}
    settings = node_settings(DEFAULTS | options)
    assert settings.map_path == '/home/robot/a.stavpr'
    assert settings.save_path == str(working_folder / 'b.stavpr')
    assert settings.pipeline.model_path == '/home/robot/net.onnx'
    assert node_settings(DEFAULTS | {'model_path': 'download'}).pipeline.model_path == 'download'


@pytest.mark.parametrize(
    ('file', 'reason'), [('a.stavpr', 'a.stavpr'), ('a.png', 'without maps: build a map')]
)
def test_read_map_of_a_folder_without_sound_maps_names_the_reason(tmp_path, file, reason):
    (tmp_path / file).touch()
    with pytest.raises(MapFileError, match=reason):
        read_map(str(tmp_path), PipelineSettings())


@pytest.mark.parametrize(
    ('values', 'missing'),
    [
        ({}, 'model and layer missing'),
        ({'feature_settings': '{"layer": "relu"}'}, 'model missing'),
        ({'model_path': 'net.onnx'}, 'layer missing'),
    ],
)
def test_network_without_its_settings_is_rejected_by_name(values, missing):
    with pytest.raises(SettingsError, match=f'features onnx are invalid .{missing}.*model_path'):
        PipelineSettings(features='onnx', **values).extractor()
    layer = '{"layer": "relu"}'  # with a path, the file is read later
    PipelineSettings(features='onnx', feature_settings=layer, model_path='/nowhere/net.onnx')
