# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags: written, recorded by others, damaged; see also test_sources.py."""

import hashlib
import shutil
import sqlite3

from bags import records, write_images, writing
import numpy as np
import pytest
from stavpr_ros.errors import ImageError, OutputError, SettingsError
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag_messages import read_messages
from stavpr_ros.sources.bag_writer import write_bag


def test_parts_of_a_split_ros1_bag_are_read_by_time(tmp_path):
    whole = list(records(9))
    times = [each.time_ns for each in whole]
    for first in (6, 0, 3):
        with writing(tmp_path / f'drive_{first}.bag', ros1=True) as bag:
            write_images(bag, whole[first : first + 3])
    assert [each.time_ns for each in open_source(tmp_path).records(0.4, 0.3)] == times[4:7]
    assert [each.time_ns for each in read_messages(tmp_path, ['/text'])] == times


def test_bag_is_written_by_one_writer_and_over_what_a_killed_one_left(tmp_path):
    path = tmp_path / 'drive'

    def others():
        with pytest.raises(OutputError, match='is being written'):
            write_bag(path, '/image', records())
        yield from records()
        assert not path.exists()

    stale = tmp_path / '.stavpr-0123456789ab'
    (stale / 'drive').mkdir(parents=True)  # a killed writer left it
    (stale / 'drive' / 'drive.db3').write_bytes(b'old')
    assert write_bag(path, '/image', others()) == 5
    assert [file.name for file in tmp_path.iterdir()] == ['drive']
    assert sorted(file.name for file in path.iterdir()) == ['drive.db3', 'metadata.yaml']


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_records_of_a_bag_are_those_that_were_written(tmp_path, storage):
    assert write_bag(tmp_path / 'bag', '/camera/image', records(), storage) == 5
    source = open_source(tmp_path / 'bag')
    assert source.topic == '/camera/image'
    for original, read in zip(records(), source.records(), strict=True):
        assert vars(read) | {'data': 0} == vars(original) | {'data': 0}
        np.testing.assert_array_equal(read.data, original.data)


def listing(folder):
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}


def test_bag_with_write_ahead_log_is_read_and_unchanged(tmp_path):
    write_bag(tmp_path / 'made', '/image', records())
    folder = tmp_path / 'odd #name%41?'
    folder.mkdir()
    file = folder / 'made#%.db3'
    shutil.copy(tmp_path / 'made' / 'made.db3', file)
    database = sqlite3.connect(file)
    database.execute('PRAGMA journal_mode=WAL')
    database.execute('PRAGMA wal_autocheckpoint=0')
    database.execute(
        'INSERT INTO messages SELECT 99, topic_id, timestamp + 1000000000, data FROM messages '
        'WHERE id=1'
    )
    database.commit()
    before = listing(folder)
    assert f'{file.name}-wal' in before
    assert len(list(open_source(file))) == 6
    assert listing(folder) == before
    database.close()


def test_write_bag_never_overwrites_nor_leaves_parts(tmp_path):
    def broken():
        yield from records(2)
        raise ImageError('the third one')

    with pytest.raises(ImageError, match='the third one'):
        write_bag(tmp_path / 'bag', '/image', broken())
    assert not list(tmp_path.iterdir())
    write_bag(tmp_path / 'bag', '/image', records())
    with pytest.raises(OutputError, match='exists already'):
        write_bag(tmp_path / 'bag', '/image', records())
    with pytest.raises(SettingsError, match="'zip' is unknown: take one of sqlite3, mcap"):
        write_bag(tmp_path / 'other', '/image', records(), 'zip')


def test_bag_of_2019_is_read(data_folder):
    path = data_folder / 'bags' / 'klintan_rosbag2js_sample.db3'
    before = sorted(path.parent.iterdir())
    for topic in ('/image', '/image/compressed'):
        (record,), (frame,) = open_source(path, topic).records(), open_source(path, topic)
        assert frame.image.shape == (480, 640, 3)
        assert (record.stamp_ns, frame.stamp) == (0, record.time_ns)
    assert sorted(path.parent.iterdir()) == before


def test_bag_of_ros1_is_read(data_folder):
    path = data_folder / 'bags' / 'kapture_t265_trimmed_locoffice.bag'
    for camera in (1, 2):
        topic = f'/camera/fisheye{camera}/image_raw'
        frames = list(open_source(path, topic))
        assert [frame.image.shape for frame in frames] == [(800, 848, 3)] * 3
        assert [round(gap / 1e6) for gap in np.diff([frame.stamp for frame in frames])] == [33, 33]
        assert all(np.ptp(frame.image) > 100 for frame in frames)
