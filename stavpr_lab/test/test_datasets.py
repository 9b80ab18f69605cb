# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The paper's data sets: found under their usual names, or not found with the reason."""

import cv2
import numpy as np
import pytest
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.paper.datasets import open_dataset
from stavpr_ros.errors import SettingsError, SourceError


def fill(folder, count, value=0):
    folder.mkdir(parents=True)
    for i in range(count):
        cv2.imwrite(str(folder / f'Image{i}.png'), np.full((4, 10), value + i, np.uint8))


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


def test_open_dataset_with_text_and_array_reads_the_text(tmp_path):
    fill(tmp_path / 'ref', 3)
    fill(tmp_path / 'query', 2)
    rows = np.empty((1, 2), object)
    rows[0] = [0, [1, 2]]
    np.save(tmp_path / 'ground_truth_new.npy', rows, allow_pickle=True)
    with pytest.raises(SourceError, match='contains Python objects'):
        open_dataset('berlin_a100', tmp_path)
    (tmp_path / 'ground_truth.csv').write_text('0,1\n1,2\n')
    assert open_dataset('berlin_a100', tmp_path, 0).ground_truth.pairs.tolist() == [[0, 1], [1, 2]]
    (tmp_path / 'gt.csv').write_text('0,1\n')
    with pytest.raises(SourceError, match=r'several ground truths: ground_truth\.csv, gt\.csv'):
        open_dataset('berlin_a100', tmp_path)


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
    with pytest.raises(SourceError, match='holds no images'):
        open_dataset('nordland', tmp_path)
    with pytest.raises(SettingsError, match='take one of nordland, gardens_point'):
        open_dataset('alderley', tmp_path)


def test_open_dataset_found_twice_raises(tmp_path):
    for folder in ('nordland', 'Nordland3584'):
        fill(tmp_path / folder / 'summer', 1)
        fill(tmp_path / folder / 'winter', 1)
    with pytest.raises(SourceError, match=r'more than once.*name one'):
        open_dataset('nordland', tmp_path)
    fill(tmp_path / 'nordland' / 'Winter_images', 1)
    with pytest.raises(SourceError, match=r'several folders .*: Winter_images, winter'):
        open_dataset('nordland', tmp_path / 'nordland')


@pytest.mark.parametrize(('name', 'count'), [('gardens_point', 200), ('nordland', 1788)])
def test_open_dataset_of_real_data_has_the_known_length(data_folder, name, count):
    dataset = open_dataset(name, data_folder)
    assert len(dataset.map) == len(dataset.query) == count
    assert dataset.ground_truth.accepts(np.arange(count)).all()
    with pytest.raises(SourceError, match='nightright'):
        open_dataset('gardens_point_night', data_folder)
