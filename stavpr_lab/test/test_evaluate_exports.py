# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Exports of evaluate, read as the other programs read them."""

from glob import glob
import os

from evaluation_commands import read_json, write_images
import numpy as np
import pytest
from stavpr_lab.commands import evaluate

N = 24


@pytest.fixture
def run(runner, tmp_path, route):
    """Run evaluate on the same images as map and query with an export; return the outcome."""
    for name in ('map', 'query'):
        write_images(tmp_path / name, route[:N])
    command = runner(evaluate)
    folders = ['--map', tmp_path / 'map', '--query', tmp_path / 'query', '--sequence-length', 5]

    def run(name, *options):
        export = ['--export', tmp_path / 'out', '--export-format', name]
        return command(*folders, *export, '--json', tmp_path / 'numbers.json', *options)

    return run


def test_export_vpr_methods_evaluation_has_positions_in_the_names(run, tmp_path):
    options = ['--truth', 'identity', '--tolerance', 2, '--features', 'gradient']
    assert run('vpr_methods_evaluation', *options)[0] == 0
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


def test_export_vpr_methods_evaluation_takes_positions_from_poses(run, tmp_path):
    poses = tmp_path / 'poses.csv'
    poses.write_text(''.join(f'{i},{-i},7\n' for i in range(N)))
    options = ['--truth', 'poses', '--query-poses', poses, '--map-poses', poses, '--reverse']
    assert run('vpr_methods_evaluation', *options)[0] == 0
    paths = (tmp_path / 'out/queries_images_paths.txt').read_text().splitlines()
    assert [path.split('@')[1:3] for path in paths] == [
        [f'{i:.2f}', f'{-i:.2f}'] for i in reversed(range(N))
    ]
    shown = os.readlink(tmp_path / 'out/queries' / paths[0])
    assert shown == str(max((tmp_path / 'query').iterdir()))


def test_export_vpr_tutorial_gives_its_metrics_our_numbers(run, tmp_path):
    assert run('vpr_tutorial', '--truth', 'identity', '--tolerance', 1)[0] == 0
    S, truth = np.load(tmp_path / 'out/S.npy'), np.load(tmp_path / 'out/GT.npz')
    assert S.shape == truth['GThard'].shape == truth['GTsoft'].shape == (N, N)
    recall = truth['GTsoft'][S.argmax(axis=0), np.arange(N)].mean()
    single = read_json((tmp_path / 'numbers.json').read_text())['single']
    assert recall == pytest.approx(single['recall_at_1'])


def test_export_hloc_names_images_below_one_folder(run, tmp_path):
    assert run('hloc')[0] == 0
    pairs = [line.split() for line in (tmp_path / 'out/pairs.txt').read_text().splitlines()]
    assert all((tmp_path / name).is_file() for pair in pairs for name in pair)
    best = {}
    for query, place in pairs:
        best.setdefault(query, place)
    assert [place.removeprefix('map/') for place in best.values()] == [
        query.removeprefix('query/') for query in best
    ]
    (tmp_path / 'a place').symlink_to(tmp_path / 'map')
    code, _, errors = run('hloc', '--map', tmp_path / 'a place', '--force')
    assert (code, 'has a space' in errors) == (1, True)
    np.save(tmp_path / 'v.npy', np.eye(N))
    arrays = ['--map', tmp_path / 'v.npy', '--query', tmp_path / 'v.npy', '--force']
    code, _, errors = run('hloc', *arrays)
    assert (code, 'give --map and --query as folders' in errors) == (1, True)
