# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A drive that is given again teaches a map nothing: by another name, or encoded again."""

import cv2
from evaluation_commands import write_images
from fixtures import route_images
import numpy as np
import pytest
from stavpr_ros.commands.map import main
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.maintenance.same_drive import earlier_drive, rows_of
from stavpr_ros.mapping import build_map, load_map, open_map, save_map
from stavpr_ros.mapping.versions import current_version
from stavpr_ros.sources import open_source
from test_upkeep import build

pytestmark = pytest.mark.usefixtures('one_thread')
ROUTE, OTHER = route_images(150), route_images(60, 5)


def darker(images):
    """Return images of another drive: another crop, another light, noise."""
    dice = np.random.default_rng(3)
    moved = [cv2.resize(image[6:, 6:] // 2, image.shape[1::-1]) for image in images]
    return [np.uint8(np.clip(image + dice.normal(0, 9, image.shape), 0, 255)) for image in moved]


def coarse(image):
    """Return an image that was encoded again."""
    encoded = cv2.imencode('.jpg', image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    return cv2.imdecode(encoded, cv2.IMREAD_COLOR)[..., ::-1]


@pytest.fixture
def path(tmp_path):
    frames = open_source(write_images(tmp_path / 'monday', ROUTE))
    extractor = FeatureExtractor('gradient')
    save_map(build_map(frames, extractor, progress=False), tmp_path / 'route.stavpr')
    return str(tmp_path / 'route.stavpr')


def test_a_drive_that_is_given_again_is_taken_once(path, tmp_path, capsys):
    drive = darker([*ROUTE[:50], *OTHER, *ROUTE[110:]])
    assert main(['update', path, str(write_images(tmp_path / 'tuesday', drive))]) == 0
    once, version = open_map(path), current_version(path)
    assert len(once) == 2 * len(ROUTE)
    again = [
        tmp_path / 'tuesday',
        write_images(tmp_path / 'wednesday', drive),
        write_images(tmp_path / 'encoded', map(coarse, drive)),
    ]
    capsys.readouterr()
    for name in again:
        assert main(['update', path, str(name)]) == 0
        assert 'has the same images as tuesday' in capsys.readouterr().out
        assert (load_map(path).map_id, current_version(path)) == (once.map_id, version)


def test_the_map_itself_is_no_drive(path, tmp_path, capsys):
    before = open_map(path).map_id
    for drive in (path, str(tmp_path / 'monday')):
        assert main(['update', path, drive]) == 0
        shown = capsys.readouterr().out
        assert 'has the same images as the map' in shown
        assert f'150 places, id {before}, was {before}' in shown


def row(images, day=0, name='monday'):
    return rows_of(build(images, day), name)[0]


def test_drives_of_other_times_or_more_images_are_other_drives(data_folder):
    assert earlier_drive(row(ROUTE), [row(ROUTE)]) == 'monday'
    assert not earlier_drive(row(ROUTE, day=1), [row(ROUTE)])  # of another date
    assert not earlier_drive(row([*ROUTE, *OTHER]), [row(ROUTE)])  # longer
    left, right = (  # in one light
        row([frame.image for frame in open_source(data_folder / 'gardens_point' / name)])
        for name in ('day_left', 'day_right')
    )
    assert not earlier_drive(right, [left])
