# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Data sets in their usual layouts: found, with their ground truth, or the reason why not."""

import cv2
import numpy as np
import pytest
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.paper.datasets import open_dataset
from stavpr_ros.errors import SettingsError, SourceError


def fill(folder, names, value=0):
    """Write small images whose gray level is ``value`` plus the position in ``names``."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f'Image{i}.png' for i in range(names)] if isinstance(names, int) else names
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((4, 10), value + i, np.uint8))


def table(path, header, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [header, *(','.join(map(str, row)) for row in rows)]
    path.write_text('\n'.join(lines) + '\n')


def values(source):
    return [int(frame.image[0, 0, 0]) for frame in source]


@pytest.mark.parametrize(
    ('name', 'map_folder', 'query_folder', 'tolerance'),
    [
        ('nordland', 'summer', 'winter', 3),
        ('nordland', 'Nordland3584/Summer', 'Nordland3584/Winter', 3),
        ('nordland', 'nordland/test/summer_images_test', 'nordland/test/winter_images_test', 3),
        ('nordland', 'nordland_summer_images', 'nordland_winter_images', 3),
        ('gardens_point', 'Gardens Point/day_left', 'Gardens Point/day_right', 2),
        ('gardens_point', 'GardensPointWalking/Day-Left', 'GardensPointWalking/DayRight', 2),
        ('gardens_point_night', 'Garden/day_left', 'Garden/night_right', 2),
        ('ua', 'UA/day', 'UA/evening', 3),
    ],
)
def test_open_dataset_of_equally_many_images_accepts_the_same_index(
    tmp_path, name, map_folder, query_folder, tolerance
):
    fill(tmp_path / map_folder, 12, 0)
    fill(tmp_path / query_folder, 12, 100)
    (tmp_path / 'notes').mkdir()
    dataset = open_dataset(name, tmp_path)
    assert values(dataset.map) == list(range(12))  # natural order
    assert values(dataset.query) == list(range(100, 112))
    assert dataset.tolerance == tolerance
    expected = GroundTruth.identity(12, 12, tolerance)
    np.testing.assert_array_equal(dataset.ground_truth.pairs, expected.pairs)
    narrow = open_dataset(name, tmp_path, tolerance=0)
    assert (narrow.tolerance, len(narrow.ground_truth.pairs)) == (0, 12)


@pytest.mark.parametrize(
    ('map_folder', 'query_folder', 'truth'),
    [
        ('BerlinA100/Reference', 'BerlinA100/Live', 'BerlinA100/GroundTruth.csv'),
        ('berlin_A100/berlin_A100_2', 'berlin_A100/berlin_A100_1', 'berlin_A100/gt.txt'),
        ('ref', 'query', 'ground_truth.csv'),
    ],
)
def test_open_dataset_berlin_reads_its_ground_truth_file(
    tmp_path, map_folder, query_folder, truth
):
    fill(tmp_path / map_folder, 5)
    fill(tmp_path / query_folder, 3, 100)
    with pytest.raises(SourceError, match='3 query images for 5 places and no ground truth'):
        open_dataset('berlin_a100', tmp_path)
    (tmp_path / truth).write_text('Live,Reference\n0,0\n1,4\n')
    dataset = open_dataset('berlin_a100', tmp_path, tolerance=1)
    assert (values(dataset.map)[0], values(dataset.query)[0]) == (0, 100)
    assert dataset.ground_truth.pairs.tolist() == [[0, 0], [0, 1], [1, 3], [1, 4]]
    assert open_dataset('berlin_a100', tmp_path).tolerance == 2


def test_open_dataset_synth_crops_both_traverses(tmp_path):
    fill(tmp_path / 'summer', 5)
    fill(tmp_path / 'winter', 5, 100)
    for folder, first in (('summer', 0), ('winter', 100)):
        ramp = np.broadcast_to(first + np.arange(10, dtype=np.uint8), (4, 10))
        cv2.imwrite(str(tmp_path / folder / 'Image0.png'), ramp)
    dataset = open_dataset('synth_nordland', tmp_path)
    first_place, first_query = next(iter(dataset.map)), next(iter(dataset.query))
    assert first_place.image[0, :, 0].tolist() == list(range(7))
    assert first_query.image[0, :, 0].tolist() == list(range(101, 110))
    assert len(dataset.map) == len(dataset.query) == dataset.ground_truth.N == 5
    assert dataset.tolerance == 3


def test_open_dataset_not_found_names_the_searched_folders(tmp_path):
    (tmp_path / 'Nordland' / 'spring').mkdir(parents=True)
    (tmp_path / 'Nordland' / 'summer').mkdir()
    with pytest.raises(SourceError, match=r"not in .*the query, 'winter', and found .*spring"):
        open_dataset('nordland', tmp_path)
    with pytest.raises(SourceError, match='cannot be listed'):
        open_dataset('nordland', tmp_path / 'missing')
    (tmp_path / 'Nordland' / 'winter').mkdir()
    with pytest.raises(SourceError, match='has no images'):
        open_dataset('nordland', tmp_path)
    with pytest.raises(SettingsError, match='take one of nordland, gardens_point'):
        open_dataset('alderley', tmp_path)


@pytest.mark.parametrize(('name', 'count'), [('gardens_point', 200), ('nordland', 1788)])
def test_open_dataset_of_real_data_has_the_known_length(data_folder, name, count):
    dataset = open_dataset(name, data_folder)
    assert len(dataset.map) == len(dataset.query) == count
    assert dataset.ground_truth.accepts(np.arange(count)).all()
    with pytest.raises(SourceError, match='nightright'):
        open_dataset('gardens_point_night', data_folder)


def test_nordland_keeps_the_listed_images(tmp_path):
    names = [f'images-{i:05d}.png' for i in range(1, 41)]
    for season, value in (('summer', 0), ('fall', 150)):
        fill(tmp_path / 'nordland' / season, names, value)
    (tmp_path / 'nordland/cleanImageNames.txt').write_text('\n'.join(names[3:30]))
    dataset = open_dataset('nordland_fall', tmp_path)
    assert values(dataset.map) == list(range(3, 30))
    assert values(dataset.query) == [150 + i for i in range(3, 30)]
    assert dataset.ground_truth.accepted(13).tolist() == list(range(3, 24))
    (tmp_path / 'nordland/cleanImageNames.txt').write_text('other.png')
    with pytest.raises(SourceError, match='none of the images that'):
        open_dataset('nordland_fall', tmp_path)


@pytest.mark.parametrize(('name', 'root'), [('st_lucia', ''), ('utm', 'st_lucia/images/test')])
def test_names_with_utm_coordinates_are_places_within_25_m(tmp_path, name, root):
    folder = tmp_path / 'st_lucia/images/test'
    row = '@{:.2f}@6961453.31@56@J@-027.5@0153.0@190809_{:05d}@@@@@@@@.jpg'
    # sorted by coordinates, the images would be in the opposite order
    fill(folder / 'database', [row.format(508400 - 10 * i, 5 * i) for i in range(12)])
    fill(folder / 'queries', [row.format(508396 - 30 * i, 9 * i) for i in range(4)], 100)
    dataset = open_dataset(name, tmp_path / root)
    assert (values(dataset.map), values(dataset.query)) == ([*range(12)], [*range(100, 104)])
    assert dataset.ground_truth.accepted(1).tolist() == [1, 2, 3, 4, 5]  # 24 to 16 m
    fill(folder / 'queries', ['plain.jpg'])
    with pytest.raises(SourceError, match='queries is not in its published layout'):
        open_dataset(name, tmp_path / root)


def test_msls_orders_images_by_its_tables_and_counts_those_of_the_task(tmp_path):
    city = tmp_path / 'mapillary_sls/train_val/cph'
    traverses = {  # key, easting, compass angle, panorama, task
        'database': [(key, x, angle, False, True) for key, x, angle in
                     (('z', 0, 10), ('y', 20, 350), ('x', 40, 200), ('w', 60, 0))],
        'query': [('b', 19, 5, False, True), ('p', 20, 5, True, True), ('a', 41, 5, False, False),
                  ('c', 41, 5, False, True)],
    }  # fmt: skip
    for name, rows in traverses.items():
        raw = [(i, row[0], 12.5, 55.6, row[2], '2019-01-01', row[3]) for i, row in enumerate(rows)]
        table(city / name / 'raw.csv', ',key,lon,lat,ca,captured_at,pano', raw)
        derived = [(i, row[0], row[1], 100.0) for i, row in enumerate(rows)]
        table(city / name / 'postprocessed.csv', ',key,easting,northing', derived)
        tasks = [(i, row[0], row[4]) for i, row in enumerate(rows)]
        table(city / name / 'subtask_index.csv', ',key,all', tasks)
        fill(city / name / 'images', [f'{row[0]}.jpg' for row in rows])
    dataset = open_dataset('msls_cph', tmp_path)
    assert (values(dataset.map), values(dataset.query)) == ([0, 1, 2, 3], [0, 2, 3])
    # the panorama is left out, a is not of the task, x looks in another direction
    assert dataset.ground_truth.pairs.tolist() == [[0, 0], [0, 1], [2, 1], [2, 3]]
    (city / 'query/raw.csv').unlink()
    with pytest.raises(SourceError, match=r'published layout.*raw\.csv'):
        open_dataset('msls_cph', tmp_path)


def test_robotcar_interpolates_positions_and_keeps_an_image_every_two_meters(tmp_path):
    for date, value in (('2015-03-17-11-08-44', 0), ('2014-12-16-18-44-24', 100)):
        folder = tmp_path / 'oxford_robotcar' / date
        rows = [(1000 * i, 5735000, 620000 + 10 * i) for i in range(1, 6)]
        table(folder / 'gps/ins.csv', 'timestamp,northing,easting', rows)
        fill(folder / 'stereo/left', [f'{t}.png' for t in range(900, 5100, 100)], value)
        cv2.imwrite(str(folder / 'stereo/left/1000.png'), np.full((4, 10, 3), (value, 2, 1)))
    dataset = open_dataset('robotcar', tmp_path)
    # a meter between stamps; 900 is before the first position, 1000 is in color
    assert values(dataset.map) == list(range(1, 42, 2))
    assert values(dataset.query)[1:] == list(range(103, 142, 2))
    assert dataset.ground_truth.accepted(0).tolist() == list(range(13))  # 0, 2 ... 24 m


def test_ground_truth_of_vpr_tutorial_has_places_as_rows(tmp_path):
    for folder in ('dry', 'jan'):
        fill(tmp_path / 'SFU' / folder, 3)
    hard, soft = np.eye(3, dtype=bool), np.eye(3, dtype=bool)
    soft[2, 0] = True  # place 2 for query 0
    np.savez(tmp_path / 'SFU/GT.npz', GThard=hard, GTsoft=soft)
    truth = open_dataset('sfu', tmp_path).ground_truth
    assert truth.pairs.tolist() == [[0, 0], [0, 2], [1, 1], [2, 2]]
