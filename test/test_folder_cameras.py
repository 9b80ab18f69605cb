# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Folders with the images of several cameras: one is read, and never two as one route."""

from itertools import chain
from pathlib import Path

from evaluation_commands import write_images
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.errors import SourceError
from stavpr_ros.sources import open_source
from stavpr_ros.sources.cameras import of_one_camera

TOP, COUNT = Path('/drive'), range(24)


def files(pattern, *cameras, step=1, first=0, lag=0):
    """Return the files of cameras; each has its images ``lag`` later than the one before."""
    return [
        TOP / pattern.format(camera, first + step * i + lag * number)
        for number, camera in enumerate(cameras)
        for i in COUNT
    ]


CAMERAS = {
    'euroc': files('mav0/{}/data/{}.png', 'cam0', 'cam1', step=50_000_000, first=1403636 * 10**12),
    'kitti': files('04/{}/{:06d}.png', 'image_0', 'image_1', 'image_2', 'image_3'),
    'prefix': files('{}{:04d}.png', 'left', 'right'),
    'lost images': files('{}{:04d}.png', 'left', 'right')[:-1],
    'dashcam': files('20300506_{1:06d}_{0}.jpg', 'F', 'R'),
    'scan': files('frame-{1:06d}.{0}.png', 'color', 'depth'),
    'tum': files('{}/1305031102.{:06d}.png', 'depth', 'rgb', step=33_000, lag=10_000),
    'robotcar': files('{}/{}.png', 'left', 'mono_left', step=62_500, first=14 * 10**14, lag=777),
    'nuscenes': files('CAM_{0}/n015__CAM_{0}__{1}.jpg', 'BACK', 'FRONT', first=1532 * 10**12),
    'masks': files('{}/{:04d}.png', 'frames', 'masks'),
    'number': files('cam{}_{:04d}.jpg', '0', '1'),
    'no word, but the same time': files('{}/{}.png', 'A', 'B', first=1305031102),
}


@pytest.mark.parametrize('name', CAMERAS)
def test_cameras_of_one_drive_are_listed_and_chosen(name):
    with pytest.raises(SourceError, match='choose it, --camera NAME') as caught:
        of_one_camera(CAMERAS[name], TOP)
    listed = str(caught.value).partition('cameras, ')[2].partition(': expected')[0].split(', ')
    chosen = [of_one_camera(CAMERAS[name], TOP, text.partition(' (')[0]) for text in listed]
    assert sorted(chain(*chosen)) == sorted(CAMERAS[name])
    assert len(chosen[0]) == len(COUNT)
    with pytest.raises(SourceError, match="no camera 'none': expected one of "):
        of_one_camera(CAMERAS[name], TOP, 'none')


@pytest.mark.parametrize(('drive', 'warnings'), [
    (files('{}MEDIA/DJI_{:04d}.JPG', 100, 101), 0),
    (files('frame_{:.0s}{:x}.jpg', ''), 0),
    (files('cam_{:.0s}{}.jpg', ''), 0),
    (files('front_{:.0s}{:04d}.jpg', '') + files('rear_{:.0s}{:04d}.jpg', '', first=24), 0),
    (files('{}/{:04d}.jpg', 'monday', 'tuesday'), 1),
    (files('hall_{}_{:04d}.jpg', 'left', 'right')[:-3], 1),
    (files('{}_{:04d}.jpg', 'hall_left', 'hall_right', 'stairs', 'lift'), 1),
    (files('{}_{:04d}.jpg', 'stairs_back', 'lift'), 1),
])  # fmt: skip
def test_parts_of_one_drive_are_no_cameras(drive, warnings, caplog):
    """Two kinds of names with the same numbers may be two drives: a line states it."""
    assert of_one_camera(drive, TOP) == drive
    assert len(caplog.records) == warnings
    assert all('of the same numbers' in record.getMessage() for record in caplog.records)


def test_data_sets_of_one_camera_are_read(data_folder):
    for folder in {file.parent for file in data_folder.rglob('*.jpg')}:
        assert len(open_source(folder).files) == len(list(folder.glob('*.jpg')))


def test_commands_choose_a_camera(tmp_path, capsys, route):
    for camera in ('cam0', 'cam1'):
        write_images(tmp_path / camera, route[:4])
    options = ['--input', str(tmp_path), '--output', str(tmp_path / 'map.stavpr')]
    assert build_map.main(options) == 1
    assert 'has images of 2 cameras, cam0 (4), cam1 (4)' in capsys.readouterr().err
    assert build_map.main([*options, '--camera', 'CAM1']) == 0
    assert '4 of 4 images became places' in capsys.readouterr().out
    (tmp_path / 'drive.mp4').write_bytes(b'')
    for name, reason in (('cam0', "no camera 'cam1': leave it out"), ('drive.mp4', 'no folder')):
        with pytest.raises(SourceError, match=reason):
            open_source(tmp_path / name, camera='cam1')
