# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs and exports of evaluate: descriptors, several queries, options of maps, other formats."""

from glob import glob
import json
import os

from evaluation_commands import read_json, write_images
import numpy as np
import pytest
from stavpr_lab.commands import build_descriptor_map, evaluate
from stavpr_lab.features.descriptors import read_descriptors
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import load_map, merge_maps, save_map


@pytest.fixture(scope='module')
def vectors():
    """Return a curve of 40 vectors, not of unit norm; the sixth is zero."""
    curve = np.cumsum(np.random.default_rng(0).standard_normal((40, 24)), axis=0)
    curve[5] = 0
    return curve.astype(np.float32)


@pytest.fixture
def run(runner):
    return runner(evaluate)


@pytest.fixture
def pair(tmp_path, vectors):
    """Write descriptors of a map and a query, with noise; return the options."""
    np.save(tmp_path / 'map.npy', vectors)
    noise = np.random.default_rng(3).normal(0, 0.5, vectors.shape)
    np.savez(tmp_path / 'query.npz', query=vectors + noise)
    paths = ['--map', tmp_path / 'map.npy', '--query', f'{tmp_path}/query.npz:query']
    return [*paths, '--sequence-length', 5, '--truth', 'identity']


def test_evaluate_of_descriptors_and_of_exported_ones_are_equal(run, pair, tmp_path):
    first, second, exported = (tmp_path / name for name in ('1.json', '2.json', 'arrays'))
    assert run(*pair, '--json', first, '--export', exported)[0] == 0
    again = ['--map', exported / 'map.npy', '--query', exported / 'query.npy', *pair[4:]]
    assert run(*again, '--json', second)[0] == 0
    numbers = [json.loads(path.read_text()) for path in (first, second)]
    assert numbers[0]['sequence']['f1'] == pytest.approx(numbers[1]['sequence']['f1'])
    assert numbers[0]['single']['recall_at_1'] > 0.9
    run.fails(1, 'exists already', *pair, '--json', tmp_path / '3.json', '--export', exported)


def test_evaluate_names_a_result_that_cannot_be_wrong(run, pair, tmp_path):
    twice = [*pair[:3], pair[1], *pair[4:]]
    texts = 'accepts 100% of the 40 places', 'map and query are the same images'
    for options, shown in (([*pair, '--tolerance', 40], 0), (twice, 1), (pair, None)):
        code, _, errors = run(*options, '--json', tmp_path / 'a.json', '--force')
        assert (code, [text in errors for text in texts]) == (0, [shown == 0, shown == 1])


def test_evaluate_names_the_time_of_several_sessions(run, small_map, route, tmp_path):
    save_map(merge_maps([small_map, small_map], 'ab'), tmp_path / 'both.stavpr')
    both = ['--map', tmp_path / 'both.stavpr', '--query', write_images(tmp_path / 'query', route)]
    code, shown, _ = run(*both, '--json', tmp_path / 'a.json')
    assert (code, '2 sessions: an image takes up to 2 times the time of one' in shown) == (0, True)


def test_evaluate_exports_strips_of_images(run, route, tmp_path):
    folder = write_images(tmp_path / 'images', route[:24])
    both = ['--map', folder, '--query', folder, '--sequence-length', 5]
    both += ['--features', 'gradient']
    assert run(*both, '--json', tmp_path / 'a.json', '--export', tmp_path)[0] == 0
    array = np.load(tmp_path / 'map.npy')
    features = FeatureExtractor('gradient').extract(route[:24])
    assert array.shape == (24, 7, 224)
    again = read_descriptors(str(tmp_path / 'map.npy'))
    np.testing.assert_allclose(again.strips, features.strips, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(again.weights, features.weights, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ('options', 'word'),
    [
        (['--strips', 7], '--strips'),
        (['--projection', 8], '--projection'),
        (['--features', 'onnx'], '--features'),
        (['--gradient-cell', 32], '--gradient-cell'),
        (['--crop-map', 0.2], 'saved map or an array'),
    ],
)
def test_evaluate_of_descriptors_rejects_options_of_images(run, pair, options, word):
    run.fails(2, word, *pair, *options)


def test_map_of_descriptors_takes_descriptors_only(run, pair, route, tmp_path, runner):
    build = runner(build_descriptor_map)
    saved = tmp_path / 'route.stavpr'
    source = ['--descriptors-source', 'netvlad']
    poses = tmp_path / 'poses.csv'
    poses.write_text(''.join(f'{i},0,0\n' for i in range(40)))
    code, output, _ = build('--input', pair[1], '--output', saved, *source, '--poses', poses)
    assert (code, '1 strips of 24 dimensions' in output) == (0, True)
    place_map = load_map(saved)
    assert place_map.pose(39)[0] == 39
    with pytest.raises(UnavailableError, match='not from images'):
        place_map.extractor()
    query = ['--query', *pair[3:], '--json', tmp_path / 'a.json', '--force']
    assert run('--map', saved, *query)[0] == 0
    run.fails(1, 'megaloc', '--map', saved, *query, '--descriptors-source', 'megaloc')
    images = write_images(tmp_path / 'images', route[:24])
    run.fails(1, 'not from images', '--map', saved, '--query', images)


def test_map_of_bits_takes_bits_without_the_option(run, pair, vectors, tmp_path, runner):
    """The map has the setting; a query of numbers is rejected."""
    path, saved = tmp_path / 'bits.npy', tmp_path / 'bits.stavpr'
    np.save(path, np.packbits(vectors > 0, axis=1))
    build = runner(build_descriptor_map)
    build.fails(1, 'with --descriptors-bits true', '--input', path, '--output', saved)
    code, output, _ = build('--input', path, '--output', saved, '--descriptors-bits', 'true')
    assert (code, '1 strips of 24 dimensions' in output) == (0, True)
    options = ['--map', saved, *pair[4:], '--json', tmp_path / 'a.json', '--force', '--query']
    assert run(*options, path)[0] == 0
    run.fails(1, 'expected uint8 for bits', *options, pair[3])


@pytest.mark.long
def test_evaluate_of_several_queries_equals_each(run, pair, vectors, tmp_path):
    np.save(tmp_path / 'other.npy', vectors[::-1])
    options, query = ['--map', pair[1], *pair[4:]], pair[3]
    several = ['--query', query, tmp_path / 'other.npy', '--output', tmp_path / 'out']
    assert run(*options, *several, '--processes', 2)[0] == 0
    assert run(*options, '--query', query, '--json', tmp_path / 'a.json')[0] == 0
    both = (tmp_path / 'a.json', *(tmp_path / 'out').glob('query*.json'))
    one, other = (json.loads(file.read_text()) for file in both)
    for name in ('sequence', 'single', 'decision', 'calibration', 'map_id'):
        assert one[name] == other[name]
    assert (tmp_path / 'out' / 'other' / 'report.html').is_file()


N = 24


@pytest.fixture
def export(runner, tmp_path, route):
    """Run evaluate on the same images as map and query with an export; return the outcome."""
    for name in ('map', 'query'):
        write_images(tmp_path / name, route[:N])
    command = runner(evaluate)
    folders = ['--map', tmp_path / 'map', '--query', tmp_path / 'query', '--sequence-length', 5]

    def export(name, *options):
        form = ['--export', tmp_path / 'out', '--export-format', name]
        return command(*folders, *form, '--json', tmp_path / 'numbers.json', *options)

    return export


def test_export_vpr_methods_evaluation_has_positions_in_the_names(export, tmp_path):
    options = ['--truth', 'identity', '--tolerance', 2, '--features', 'gradient']
    assert export('vpr_methods_evaluation', *options)[0] == 0
    out, positions, rows = tmp_path / 'out', [], []
    for side in ('database', 'queries'):
        paths = (out / f'{side}_images_paths.txt').read_text().splitlines()
        assert sorted(paths) == sorted(os.path.basename(p) for p in glob(f'{out}/{side}/*'))
        assert all((out / side / path).is_file() for path in paths)
        positions.append(np.array([path.split('@')[1:3] for path in paths]).astype(float))
        rows.append(np.load(out / f'{side}_descriptors.npy'))
    assert rows[0].dtype == np.float32
    assert rows[0].shape == (N, 7 * 224)
    np.testing.assert_allclose(np.linalg.norm(rows[0], axis=1), 1, rtol=1e-5)
    assert (rows[1] @ rows[0].T).argmax(axis=1).tolist() == list(range(N))
    distances = np.linalg.norm(positions[1][:, None] - positions[0], axis=2)
    index = np.arange(N)
    np.testing.assert_array_equal(distances <= 25, abs(index[:, None] - index) <= 2)


def test_export_vpr_methods_evaluation_takes_positions_from_poses(export, tmp_path):
    poses = tmp_path / 'poses.csv'
    poses.write_text(''.join(f'{i},{-i},7\n' for i in range(N)))
    options = ['--truth', 'poses', '--query-poses', poses, '--map-poses', poses, '--reverse']
    assert export('vpr_methods_evaluation', *options)[0] == 0
    paths = (tmp_path / 'out/queries_images_paths.txt').read_text().splitlines()
    assert [path.split('@')[1:3] for path in paths] == [
        [f'{i:.2f}', f'{-i:.2f}'] for i in reversed(range(N))
    ]
    shown = os.readlink(tmp_path / 'out/queries' / paths[0])
    assert shown == str(max((tmp_path / 'query').iterdir()))


def test_export_vpr_tutorial_gives_its_metrics_our_numbers(export, tmp_path):
    assert export('vpr_tutorial', '--truth', 'identity', '--tolerance', 1)[0] == 0
    S, truth = np.load(tmp_path / 'out/S.npy'), np.load(tmp_path / 'out/GT.npz')
    assert S.shape == truth['GThard'].shape == truth['GTsoft'].shape == (N, N)
    recall = truth['GTsoft'][S.argmax(axis=0), np.arange(N)].mean()
    single = read_json((tmp_path / 'numbers.json').read_text())['single']
    assert recall == pytest.approx(single['recall_at_1'])


def test_export_hloc_names_images_below_one_folder(export, tmp_path):
    assert export('hloc')[0] == 0
    pairs = [line.split() for line in (tmp_path / 'out/pairs.txt').read_text().splitlines()]
    assert all((tmp_path / name).is_file() for pair in pairs for name in pair)
    best = {}
    for query, place in pairs:
        best.setdefault(query, place)
    assert [place.removeprefix('map/') for place in best.values()] == [
        query.removeprefix('query/') for query in best
    ]
    (tmp_path / 'a place').symlink_to(tmp_path / 'map')
    code, _, errors = export('hloc', '--map', tmp_path / 'a place', '--force')
    assert (code, 'has a space' in errors) == (1, True)
    np.save(tmp_path / 'v.npy', np.eye(N))
    arrays = ['--map', tmp_path / 'v.npy', '--query', tmp_path / 'v.npy', '--force']
    code, _, errors = export('hloc', *arrays)
    assert (code, 'give --map and --query as folders' in errors) == (1, True)
