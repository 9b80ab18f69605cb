# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Data sets of the field: small trees in their published layouts, and the table of recall@1."""

import cv2
from evaluation_commands import read_json, runner, write_images
from fixtures import route_images
import numpy as np
import pytest
from stavpr_lab.commands import experiments
from stavpr_lab.evaluation.paper.datasets import FIELD, NAMES, open_dataset
from stavpr_ros.errors import SourceError


def fill(folder, names, value=0):
    """Write small images whose gray level is ``value`` plus the position in ``names``."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((4, 10), value + i, np.uint8))


def values(source):
    return [int(frame.image[0, 0, 0]) for frame in source]


def table(folder, name, header, rows):
    folder.mkdir(parents=True, exist_ok=True)
    lines = [header, *(','.join(map(str, row)) for row in rows)]
    (folder / name).write_text('\n'.join(lines) + '\n')


def test_nordland_keeps_the_listed_images_at_the_tolerance_of_the_field(tmp_path):
    names = [f'images-{i:05d}.png' for i in range(1, 41)]
    for season, value in (('summer', 0), ('winter', 50), ('spring', 100), ('fall', 150)):
        fill(tmp_path / 'nordland' / season, names, value)
    (tmp_path / 'nordland/cleanImageNames.txt').write_text('\n'.join(names[3:30]) + '\n')
    for season, value in (('winter', 50), ('spring', 100), ('fall', 150)):
        dataset = open_dataset(f'nordland_{season}', tmp_path)
        assert values(dataset.map) == list(range(3, 30))
        assert values(dataset.query) == [value + i for i in range(3, 30)]
        assert dataset.ground_truth.accepted(13).tolist() == list(range(3, 24))
    assert open_dataset('nordland_winter_1', tmp_path).criterion == 'identity +-1'
    (tmp_path / 'nordland/cleanImageNames.txt').write_text('other.png\n')
    with pytest.raises(SourceError, match='none of the images that'):
        open_dataset('nordland_winter', tmp_path)


@pytest.mark.parametrize('name', ['st_lucia', 'utm'])
def test_names_with_utm_coordinates_are_places_within_25_m(tmp_path, name):
    folder = tmp_path / 'st_lucia/images/test'
    row = '@{:.2f}@6961453.31@56@J@-027.5@0153.0@190809_{:05d}@@@@@@@@.jpg'
    # sorted by coordinates, the images would come in the opposite order
    fill(folder / 'database', [row.format(508400 - 10 * i, 5 * i) for i in range(12)])
    fill(folder / 'queries', [row.format(508396 - 30 * i, 9 * i) for i in range(4)], 100)
    dataset = open_dataset(name, folder if name == 'utm' else tmp_path)
    assert values(dataset.map) == list(range(12))
    assert values(dataset.query) == list(range(100, 104))
    assert dataset.ground_truth.accepted(1).tolist() == [1, 2, 3, 4, 5]  # 24 to 16 m
    assert dataset.criterion == 'poses within 25 m'
    fill(folder / 'queries', ['plain.jpg'])
    with pytest.raises(SourceError, match=r'queries is not in its published layout'):
        open_dataset(name, folder if name == 'utm' else tmp_path)


def msls_traverse(folder, rows):
    """Write a traverse; ``rows`` are key, easting, compass angle, panorama, subtask all."""
    plain = list(enumerate(rows))
    raw = [
        (i, key, 12.5, 55.6, angle, '2019-01-01', pano) for i, (key, _, angle, pano, _) in plain
    ]
    table(folder, 'raw.csv', ',key,lon,lat,ca,captured_at,pano', raw)
    derived = [(i, row[0], row[1], 100.0, i, False, 'Forward') for i, row in plain]
    header = ',key,easting,northing,unique_cluster,night,view_direction'
    table(folder, 'postprocessed.csv', header, derived)
    table(folder, 'subtask_index.csv', ',key,all,s2w', [(i, r[0], r[4], False) for i, r in plain])
    fill(folder / 'images', [f'{row[0]}.jpg' for row in rows])


def test_msls_orders_images_by_its_tables_and_counts_those_of_the_task(tmp_path):
    city = tmp_path / 'mapillary_sls/train_val/cph'
    places = [('z', 0, 10), ('y', 20, 350), ('x', 40, 200), ('w', 60, 0)]
    msls_traverse(city / 'database', [(*row, False, True) for row in places])
    queries = [('b', 19, 5, False, True), ('p', 20, 5, True, True), ('a', 41, 5, False, False)]
    msls_traverse(city / 'query', [*queries, ('c', 41, 5, False, True)])
    (tmp_path / 'mapillary_sls/train_val/sf/database').mkdir(parents=True)
    dataset = open_dataset('msls_cph', tmp_path)
    assert values(dataset.map) == [0, 1, 2, 3]
    assert values(dataset.query) == [0, 2, 3]  # without the panorama
    truth = dataset.ground_truth
    assert truth.accepted(0).tolist() == [0, 1]  # 19 m and 5 degrees, 1 m and 15 degrees
    assert truth.has_match.tolist() == [True, False, True]  # 'a' is not of the task
    assert truth.accepted(2).tolist() == [1, 3]  # not x, which looks in another direction
    (city / 'query/raw.csv').unlink()
    with pytest.raises(SourceError, match=r'published layout.*raw\.csv'):
        open_dataset('msls_cph', tmp_path)


def test_robotcar_interpolates_positions_and_keeps_an_image_every_two_meters(tmp_path):
    root = tmp_path / 'oxford_robotcar'
    header = 'timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone'
    for date, value in (('2015-03-17-11-08-44', 0), ('2014-12-16-18-44-24', 100)):
        rows = [
            (1000 * i, 'INS_SOLUTION_GOOD', 51, -1, 100, 5735000, 620000 + 10 * i, -100, '30U')
            for i in range(1, 6)
        ]
        table(root / date / 'gps', 'ins.csv', header, rows)
        fill(root / date / 'stereo/left', [f'{t}.png' for t in range(900, 5100, 100)], value)
    dataset = open_dataset('robotcar', tmp_path)
    # a meter each 100: without 900, before the first position, every second one to 5000
    assert values(dataset.map) == list(range(1, 42, 2))
    assert values(dataset.query) == list(range(101, 142, 2))
    assert dataset.ground_truth.accepted(0).tolist() == list(range(13))  # 0, 2 ... 24 m
    colored = root / '2015-03-17-11-08-44/stereo/left/1000.png'
    cv2.imwrite(str(colored), np.full((4, 10, 3), (10, 20, 30), np.uint8))
    assert next(iter(open_dataset('robotcar', root).map)).image[0, 0].tolist() == [30, 20, 10]


@pytest.mark.parametrize(
    ('name', 'folder', 'map_folder', 'query_folder'),
    [
        ('sfu', 'SFU', 'dry', 'jan'),
        ('st_lucia_small', 'StLucia_small', '100909_0845', '180809_1545'),
    ],
)
def test_ground_truth_of_vpr_tutorial_has_places_as_rows(
    tmp_path, name, folder, map_folder, query_folder
):
    names = [f'{i}.jpg' for i in range(3)]
    fill(tmp_path / folder / map_folder, names)
    fill(tmp_path / folder / query_folder, names)
    hard, soft = np.eye(3, dtype=bool), np.eye(3, dtype=bool)
    soft[2, 0] = True  # place 2 for query 0
    np.savez(tmp_path / folder / 'GT.npz', GThard=hard, GTsoft=soft)
    truth = open_dataset(name, tmp_path).ground_truth
    assert truth.pairs.tolist() == [[0, 0], [0, 2], [1, 1], [2, 2]]


def test_experiments_field_prints_recall_at_the_tolerance_of_each_data_set(
    tmp_path, monkeypatch, capsys
):
    for name in ('summer', 'winter'):
        write_images(tmp_path / 'nordland' / name, route_images(24))
    run, out = runner(experiments, monkeypatch, capsys), tmp_path / 'out.json'
    code, text, errors = run('field', '--data', tmp_path, '--json', out, '--gradient-cell', 32)
    assert code == 0, errors
    assert text.splitlines()[0] == 'field: recall_at_1'
    assert 'nordland_winter, identity +-10 ' in text
    assert 'nordland_winter_1, identity +-1 ' in text
    assert 'published' not in text
    first = read_json(out.read_text())[0]['results']
    assert [row['recall_at_1'] for row in first.values()] == [1, 1, 1, 1]
    assert set(FIELD) < set(NAMES)
