# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A drive that is given again teaches a map nothing: by another name, or encoded again."""

import cv2
from fixtures import route_images
import numpy as np
import pytest
from stavpr_ros.commands.map import main
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, load_map, open_map, save_map, versions
from stavpr_ros.mapping.versions import current_version
from stavpr_ros.recognition.same_drive import drive_hash, earlier_drive
from stavpr_ros.sources import open_source
from stavpr_ros.sources.frame import Frame
from test_upkeep import built

pytestmark = pytest.mark.usefixtures('one_thread')
ROUTE, OTHER = route_images(150), route_images(60, 5)
REBUILT = [*ROUTE[:50], *OTHER, *ROUTE[110:]]


def darker(images):
    """Return images of another drive: another crop, another light, noise."""
    dice = np.random.default_rng(3)
    shapes = [(image.shape[1::-1], image[6:, 6:] // 2) for image in images]
    moved = [cv2.resize(image, size).astype(float) for size, image in shapes]
    return [
        np.clip(image + 9 * dice.standard_normal(image.shape), 0, 255).astype(np.uint8)
        for image in moved
    ]


def written(folder, images, suffix='.png', *options):
    folder.mkdir()
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / f'{i:04}{suffix}'), image[..., ::-1], options)
    return str(folder)


@pytest.fixture
def path(tmp_path):
    frames = open_source(written(tmp_path / 'monday', ROUTE))
    save_map(build_map(frames, FeatureExtractor(), progress=False), tmp_path / 'route.stavpr')
    return str(tmp_path / 'route.stavpr')


@pytest.mark.parametrize(('images', 'places'), [(REBUILT, 160), (ROUTE, 150)])
def test_a_drive_that_is_given_again_is_taken_once(path, tmp_path, capsys, images, places):
    drive, first = darker(images), open_map(path).map_id
    assert main(['update', path, written(tmp_path / 'tuesday', drive)]) == 0
    once, version = open_map(path), current_version(path)
    assert (len(once) > len(ROUTE)) is (places > 150)
    assert (once.map_id == first) is (places == 150)
    assert ('nothing is added' in str(version.changes)) is (places == 150)
    assert len(versions.versions(path)) == 1 + (places > 150)
    again = [
        str(tmp_path / 'tuesday'),
        written(tmp_path / 'wednesday', drive),
        written(tmp_path / 'encoded', drive, '.jpg', cv2.IMWRITE_JPEG_QUALITY, 60),
    ]
    capsys.readouterr()
    for name in again:
        assert main(['update', path, name]) == 0
        assert 'has the images of tuesday, taken already' in capsys.readouterr().out
        assert load_map(path).map_id == once.map_id
        assert current_version(path) == version


def test_the_map_itself_is_no_drive(path, tmp_path, capsys):
    before = open_map(path).map_id
    for drive in (path, str(tmp_path / 'monday')):
        assert main(['update', path, drive]) == 0
        shown = capsys.readouterr().out
        assert 'has the images of the map, taken already' in shown
        assert f'150 places, id {before}, was {before}' in shown
    assert open_map(path).map_id == before


def test_merge_names_a_map_whose_images_another_one_has(path, tmp_path, capsys):
    copy, small, tuesday = (str(tmp_path / f'{name}.stavpr') for name in ('copy', 'half', 'tue'))
    assert main(['compact', path, small]) == 0
    save_map(load_map(path), copy)
    save_map(build_map([Frame(image, 0, '') for image in darker(ROUTE)], FeatureExtractor(),
                       progress=False), tuesday)  # fmt: skip
    both, twice = str(tmp_path / 'both.stavpr'), str(tmp_path / 'twice.stavpr')
    assert main(['merge', both, path, tuesday]) == 0
    assert 'has the images' not in capsys.readouterr().err
    assert main(['merge', twice, both, path, copy, small, '--different-routes']) == 0
    assert capsys.readouterr().err.count(f'has the images of {both}, which teach nothing') == 3
    assert main(['merge', twice, path, path, '--different-routes', '--force']) == 0
    assert f'{path} has the images of {path}, which' in capsys.readouterr().err


def test_drives_of_other_times_or_more_images_are_other_drives():
    first = built(ROUTE)
    known = [drive_hash('monday', first)]
    assert earlier_drive(built(ROUTE), known) == known[0]
    assert earlier_drive(built(ROUTE, day=1), known) is None  # of another time
    assert earlier_drive(built([*ROUTE, *OTHER]), known) is None  # longer


def test_real_drives_in_one_light_are_two_drives(data_folder):
    left, right = (
        build_map(open_source(data_folder / 'gardens_point' / name), FeatureExtractor(),
                  thumbnails=False, progress=False)
        for name in ('day_left', 'day_right')
    )  # fmt: skip
    assert earlier_drive(right, [drive_hash('left', left)]) is None
    assert earlier_drive(left, [drive_hash('left', left)]).name == 'left'
