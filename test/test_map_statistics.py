# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What recognition learns from a map, kept in its file: the same answers, and never wrong ones."""

import dataclasses
import hashlib
from unittest.mock import patch

from evaluation_commands import write_images
from fixtures import route_images
from map_examples import example_map
from map_files import alter
import numpy as np
import pytest
from stavpr_ros.commands.build_map import main as build_map_main
from stavpr_ros.commands.map import main as map_main
from stavpr_ros.errors import MapFileError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import load_map, open_map, save_map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.prepare import prepared_map
from stavpr_ros.prepare.centering import MeanCentering
from stavpr_ros.prepare.prepared_map import METHOD, statistics_of_map
from stavpr_ros.threads import limit_threads

SETTINGS = RecognizerSettings(mode='robust')


@pytest.fixture(autouse=True)
def small_maps(set_constants):
    """Keep the statistics of small maps, too."""
    set_constants(prepared_map, MIN_PLACES=1)


@pytest.fixture(scope='module')
def place_map():
    """Return a map of 600 places in two sessions: several blocks."""
    small = example_map()
    rng = np.random.default_rng(5)
    walk = rng.normal(size=(2, 610, 32)).cumsum(1).astype(np.float32)
    strips = walk[:, 10:] - walk[:, :-10]
    strips[1, 7] = 0
    strips /= np.linalg.norm(strips, axis=2, keepdims=True).clip(1e-9)
    features = LocalFeatures(
        strips, np.full((2, 600), 0.5, np.float32), small.settings, small.features.cells
    )
    return dataclasses.replace(
        small, features=features, stamps=np.zeros(600, np.int64), ids=('',) * 600, poses=None,
        thumbnails=(), session_index=np.repeat(np.arange(2, dtype=np.int32), 300),
    )  # fmt: skip


def save(place_map, path, storage='float32'):
    save_map(place_map, path, storage, True, statistics_of_map(place_map, storage))
    return path


def answers(place_map, precision):
    recognizer = PlaceRecognizer(place_map, SETTINGS, 'cpu', precision)
    result = []
    for i in range(40):
        match = recognizer.update(place_map.features[i + 100 : i + 101])
        result += [
            recognizer.newest_row().tobytes(),
            match.probability,
            match.path.pairs.tobytes(),
        ]
        result.append(match.path)
    return repr(result), recognizer.start_notes


@pytest.mark.parametrize('storage', ['float32', 'float16'])
@pytest.mark.parametrize('precision', ['float32', 'int8'])
def test_answers_with_statistics_are_those_without_bit_for_bit(
    place_map, tmp_path, storage, precision
):
    path = save(place_map, tmp_path / 'with', storage)
    save_map(place_map, tmp_path / 'without', storage)
    assert open_map(tmp_path / 'without').features.statistics is None
    with patch.object(MeanCentering, '_learn', side_effect=AssertionError):
        result = answers(open_map(path), precision)
    assert result == answers(open_map(tmp_path / 'without'), precision)
    assert result[1] == '2 sessions: an image takes up to 2 times the time of one'


def test_several_threads_learn_the_same_as_one(place_map):
    result = []
    for threads in (2, 1):  # the fixture ends with all again
        limit_threads(threads)
        result.append(statistics_of_map(place_map).parts())
    for name, array in result[0].items():
        np.testing.assert_array_equal(array, result[1][name])


def test_small_map_keeps_none(place_map, set_constants):
    set_constants(prepared_map, MIN_PLACES=601)
    assert statistics_of_map(place_map) is None


def change_file(path, change=lambda section: None, **parts):
    """Change the section, and its parts; None drops a part."""
    named = {
        name if name == 'strips' else f'statistics/{name}': array for name, array in parts.items()
    }
    path.write_bytes(
        alter(path.read_bytes(), lambda m: change(m['sections']['statistics']), **named)
    )


def test_statistics_of_other_features_are_learned_again_and_logged(place_map, tmp_path):
    path = save(place_map, tmp_path / 'map')
    other = place_map.features.strips[:, ::-1]
    change_file(path, strips=other)
    opened = open_map(path)
    result, note = answers(opened, 'float32')
    assert f'the statistics in {path} are of other features: learned again' in note
    assert 'map compact' in note
    reversed_map = load_map(path)
    assert result == answers(reversed_map, 'float32')[0]
    # a map that is written again has statistics of its own features
    save(opened, tmp_path / 'again')
    assert open_map(tmp_path / 'again').features.statistics is not None


def test_statistics_of_another_method_are_learned_again_and_logged(place_map, tmp_path):
    path = save(place_map, tmp_path / 'map')
    change_file(path, lambda section: section['data'].update(method='by\nguess'))
    opened = open_map(path)
    result, note = answers(opened, 'float32')
    assert r"learned by another version ('by\nguess')" in note
    assert result == answers(load_map(path), 'float32')[0]
    assert statistics_of_map(opened).method == METHOD


def test_statistics_of_a_later_version_of_the_section_are_not_looked_at(place_map, tmp_path):
    path = save(place_map, tmp_path / 'map')
    change_file(path, lambda section: section.update(version=2, data=None), gains=np.zeros(3))
    opened = open_map(path)
    assert opened.features.statistics is None
    assert answers(opened, 'float32') == answers(load_map(path), 'float32')


def test_reader_written_from_the_documentation_finds_the_statistics(place_map, tmp_path):
    from map_reader import read

    path = save(place_map, tmp_path / 'map', 'float16')
    manifest, arrays = read(path)
    data = manifest['sections']['statistics']['data']
    hashes = ''.join(manifest['parts']['strips']['sha256'])
    assert data == {'method': METHOD, 'features': hashlib.sha256(hashes.encode()).hexdigest()}
    mean = arrays['strips'].astype(float).mean(axis=1)
    np.testing.assert_allclose(arrays['statistics/mean'], mean, atol=1e-6)
    assert arrays['statistics/directions'].shape == (2, 64, 32)
    assert arrays['statistics/gains'].shape == (2, 64)


def test_commands_write_statistics(place_map, tmp_path, capsys):
    old = tmp_path / 'old'
    save_map(place_map, old)
    for action, *files in (('compact', old), ('merge', old, old)):
        output = tmp_path / action
        paths = (files[0], output) if action != 'merge' else (output, *files)
        options = ['--different-routes'] if action == 'merge' else []
        assert map_main([action, *map(str, paths), *options]) == 0
        result = open_map(output).features.statistics
        assert result.changes.shape[1] == (600 if action != 'merge' else 1200)
        assert not open_map(output).features.has_stale_statistics
    assert map_main(['info', str(tmp_path / 'compact')]) == 0
    assert 'stored for a fast start' in capsys.readouterr().out


@pytest.mark.parametrize('storage', ['float32', 'float16'])
def test_answers_of_codes_are_those_of_features_bit_for_bit(place_map, tmp_path, storage):
    save_map(place_map, tmp_path / 'old', storage)
    files = [str(tmp_path / name) for name in ('old', 'codes')]
    assert map_main(['compact', *files, '--codes', '--storage', storage]) == 0
    opened = open_map(files[1])
    result = []
    with patch.object(type(opened.features), '_read', side_effect=AssertionError):
        recognizer = PlaceRecognizer(opened, SETTINGS, 'cpu', 'int8')
    query = place_map.features
    for one in (recognizer, PlaceRecognizer(open_map(files[0]), SETTINGS, 'cpu', 'int8')):
        matches = [one.update(query[i : i + 1]) for i in range(130, 160)]
        result.append(
            [one.newest_row().tobytes(), [(m.probability, repr(m.path)) for m in matches]]
        )
    assert result[0] == result[1]
    # other precisions take the features
    assert answers(opened, 'float32') == answers(open_map(files[0]), 'float32')


@pytest.mark.parametrize(
    ('codes', 'text'),
    [
        (np.full((2, 600, 32), 127, np.int8), 'codes of strip 0, from place 0 on, have length'),
        (np.zeros((2, 600, 31), np.int8), 'statistics/codes has shape'),
        (np.zeros((2, 600, 32), np.uint8), 'statistics/codes is U8'),
    ],
)
def test_hand_made_codes_are_rejected_by_name(place_map, tmp_path, codes, text):
    """Longer ones would overflow the sums of the kernels."""
    path = save(place_map, tmp_path / 'map')
    change_file(path, codes=codes)
    with pytest.raises(MapFileError, match=text):
        PlaceRecognizer(open_map(path), SETTINGS, 'cpu', 'int8')


def test_build_map_writes_statistics(tmp_path):
    images = write_images(tmp_path / 'images', route_images(12))
    output = tmp_path / 'map'
    assert build_map_main(['--input', str(images), '--output', str(output)]) == 0
    result = open_map(output)
    learned = statistics_of_map(load_map(output)).parts()
    for name, array in result.features.statistics.parts().items():
        np.testing.assert_array_equal(array, learned[name])
