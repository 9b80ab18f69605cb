# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of every kind: written and read back, real, damaged."""

import hashlib
import json
import os
import re
import shutil
import sqlite3

from bags import Bag, SECOND, TEXT, writing
import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from stavpr_ros.errors import ImageError, OutputError, SettingsError, SourceError
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag import BagSource, COMPRESSED, RAW
from stavpr_ros.sources.bag_file import open_bag
from stavpr_ros.sources.bag_messages import read_messages
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord

T0 = 1_700_000_000_000_000_000
FIELDS = ('time_ns', 'stamp_ns', 'frame_id', 'height', 'width', 'encoding', 'is_bigendian', 'step')


def records(count=5, stamped=True):
    rng = np.random.default_rng(0)
    for i in range(count):
        image = rng.integers(0, 256, (6, 8, 3), np.uint8)
        time_ns = T0 + i * 100_000_000
        yield ImageRecord.of_image(image, time_ns, time_ns - 7 if stamped else 0, 'camera')


def write_mixed(path, ros1=False, bad=()):
    """Write a bag with /raw, /small (PNG, those in `bad` damaged) and /text; /silent is empty."""
    with writing(path, ros1) as bag:
        bag.topic('/silent', RAW)
        for i, record in enumerate(records()):
            header, pixels = bag.header(i * SECOND + 5), record.data.reshape(6, 8, 3)
            bag.write('/raw', RAW, record.time_ns, header, 6, 8, 'rgb8', 0, 24, record.data)
            png = cv2.imencode('.png', pixels[..., ::-1].copy())[1].ravel()
            png = png[:40] if i in bad else png
            bag.write('/small', COMPRESSED, record.time_ns, header, 'png', png)
            bag.write('/text', TEXT, record.time_ns, 'hello')
    return path


def test_parts_of_a_split_ros1_bag_are_one_drive(tmp_path):
    whole = list(records(9))
    times = [each.time_ns for each in whole]
    for first in (6, 0, 3):
        with writing(tmp_path / f'drive_{first}.bag', ros1=True) as bag:
            for each in whole[first : first + 3]:
                header = bag.header(each.stamp_ns)
                bag.write('/raw', RAW, each.time_ns, header, 6, 8, 'rgb8', 0, 24, each.data)
                bag.write('/text', TEXT, each.time_ns, 'hello')
    source = open_source(tmp_path)
    assert isinstance(source, BagSource)
    assert len(source) == 9
    assert [frame.stamp for frame in source] == [each.stamp_ns for each in whole]
    assert [each.time_ns for each in source.records(0.4, 0.3)] == times[4:7]
    assert [each.time_ns for each in read_messages(tmp_path, ['/text'])] == times
    with writing(tmp_path / 'rear.bag', ros1=True) as bag:
        bag.write('/rear', RAW, T0, bag.header(5), 6, 8, 'rgb8', 0, 24, whole[0].data)
    with pytest.raises(SourceError, match=r'2 image topics, choose one .* /raw .*, /rear '):
        open_source(tmp_path)


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
def test_write_bag_then_open_source_is_identical(tmp_path, storage):
    path = tmp_path / 'bag'
    assert write_bag(path, '/camera/image', records(), storage) == 5
    file = next(file for file in path.iterdir() if file.suffix in {'.db3', '.mcap'})
    for place in (path, file):
        source = open_source(place)
        assert isinstance(source, BagSource)
        assert (len(source), source.topic) == (5, '/camera/image')
        for original, read in zip(records(), source.records(), strict=True):
            assert [getattr(read, name) for name in FIELDS] == [
                getattr(original, name) for name in FIELDS
            ]
            np.testing.assert_array_equal(read.data, original.data)
        for i, (original, frame) in enumerate(zip(records(), source, strict=True)):
            np.testing.assert_array_equal(frame.image, original.data.reshape(6, 8, 3))
            assert (frame.stamp, frame.identifier) == (original.stamp_ns, f'/camera/image#{i}')


def test_bag_without_header_stamps_uses_recording_time(tmp_path):
    write_bag(tmp_path / 'bag', '/image', records(stamped=False))
    source = open_source(tmp_path / 'bag', 'image')
    assert [frame.stamp for frame in source] == [record.time_ns for record in records()]
    assert {record.stamp_ns for record in source.records()} == {0}


@pytest.mark.parametrize('ros1', [False, True])
def test_bag_raw_and_compressed_images_are_equal(tmp_path, ros1):
    path = write_mixed(tmp_path / 'MIXED.BAG', ros1)
    for topic in ('/raw', '/small'):
        source = open_source(path, topic)
        for i, (original, frame, record) in enumerate(
            zip(records(), source, source.records(), strict=True)
        ):
            np.testing.assert_array_equal(frame.image, original.data.reshape(6, 8, 3))
            assert frame.stamp == record.stamp_ns == i * 1_000_000_000 + 5
            assert record.time_ns == original.time_ns
            assert (record.encoding, record.frame_id) == ('rgb8', 'camera')


@pytest.mark.parametrize('seconds', [2**31, 2**32 - 1])
def test_stamps_from_2038_on_are_no_times_before_1970(tmp_path, seconds):
    with writing(path := tmp_path / 'drive') as bag:
        header = bag.header((seconds - 2**32) * SECOND + 7)  # the same 32 bits
        bag.write('/raw', RAW, T0, header, 1, 2, 'rgb8', 0, 6, np.zeros(6, np.uint8))
    (frame,), (record,) = open_source(path), open_source(path).records()
    assert frame.stamp == record.stamp_ns == seconds * SECOND + 7


@pytest.mark.parametrize(
    ('topic', 'sentence'),
    [
        (None, r'2 image topics.*/raw \(sensor_msgs/msg/Image, 5 messages\), /small'),
        ('/other', r"'/other' is not in .*expected one of /raw"),
        ('/text', 'is of type std_msgs/msg/String in '),
        ('/silent', "'/silent' has no messages in"),
    ],
)
def test_bag_with_ambiguous_or_wrong_topic_lists_topics(tmp_path, topic, sentence):
    path = write_mixed(tmp_path / 'bag')
    with pytest.raises(SourceError, match=sentence):
        open_source(path, topic)
    with writing(tmp_path / 'none') as bag:
        bag.topic('/text', TEXT)
    with pytest.raises(SourceError, match=r'no images.*/text .std_msgs/msg/String, 0 messages'):
        open_source(tmp_path / 'none')


def test_bag_beside_images_is_read_and_the_images_are_named(tmp_path, caplog):
    write_bag(tmp_path / 'bag', '/camera', records())
    for name in ('a.png', 'b.png'):
        cv2.imwrite(str(tmp_path / 'bag' / name), np.zeros((4, 4), np.uint8))
    assert len(open_source(tmp_path / 'bag')) == 5
    assert 'is a bag beside 2 images: the bag is read; to read the images, move' in caplog.text


@pytest.mark.parametrize('ros1', [False, True])
def test_bag_with_damaged_image_fails_or_skips(tmp_path, ros1):
    path = write_mixed(tmp_path / 'mixed.bag', ros1, bad={1, 3})
    with pytest.raises(ImageError, match=r'/small#1: .*damaged'):
        list(open_source(path, '/small'))
    errors = []
    source = open_source(path, '/small', errors.append)
    assert [frame.identifier for frame in source] == ['/small#0', '/small#2', '/small#4']
    assert len(list(source.records())) == 3
    assert len(errors) == 4


@pytest.mark.parametrize('storage', ['sqlite3', 'mcap'])
def test_bag_without_metadata_whose_files_are_no_parts_is_refused(tmp_path, storage):
    write_bag(tmp_path / 'bag', '/image', records(), storage)
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    (file,) = (tmp_path / 'bag').iterdir()
    shutil.copy(file, file.with_stem('second'))
    with pytest.raises(
        SourceError, match=r'exactly one .db3 or .mcap file then, .* found .*second'
    ):
        open_source(tmp_path / 'bag')


def test_list_of_bag_that_states_too_many_messages_reserves_no_memory_for_them(tmp_path, caplog):
    write_bag(tmp_path / 'bag', '/image', records())
    metadata = tmp_path / 'bag' / 'metadata.yaml'
    text = metadata.read_text().replace('message_count: 5', f'message_count: {2**60}')
    metadata.write_text(text)
    assert len(list(open_source(tmp_path / 'bag'))) == 5
    assert f'states: /image has 5 of {2**60} messages' in caplog.text


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


@pytest.fixture(params=['sqlite3', 'mcap', 'ros1'])
def bag_file(tmp_path, request):
    """Return the file of a bag with images on /raw."""
    if request.param == 'ros1':
        return write_mixed(tmp_path / 'mixed.bag', ros1=True)
    write_bag(tmp_path / 'bag', '/raw', records(200), request.param)
    return next(file for file in (tmp_path / 'bag').iterdir() if file.suffix != '.yaml')


@pytest.mark.parametrize('keep', [0.0, 0.3, 0.99])
def test_bag_cut_off_fails(bag_file, keep):
    file, data = bag_file, bag_file.read_bytes()
    file.write_bytes(data[: int(len(data) * keep)])
    if (file.suffix, keep) == ('.mcap', 0.99):  # without its index, which is not needed
        assert len(list(open_source(file, '/raw'))) == 200
        return
    with pytest.raises(SourceError, match=str(file)):
        list(open_source(file, '/raw'))


def test_mcap_without_an_end_yields_its_whole_chunks(tmp_path, caplog):
    """As after a power loss: zeros may follow, or a part of a chunk."""
    image = np.zeros((64, 64, 3), np.uint8)
    times = [2, 1, *range(3, 201)]  # recorded by two threads
    originals = (ImageRecord.of_image(image, t) for t in times)
    write_bag(tmp_path / 'bag', '/raw', originals, 'mcap')
    data, file = next((tmp_path / 'bag').glob('*.mcap')).read_bytes(), tmp_path / 'lost.MCAP'
    for kept, images in ((0.6, 85), (0.95, 170)):  # chunks are of one megabyte
        part = data[: int(len(data) * kept)]
        for content in (part, part + bytes(2_000_000)):
            file.write_bytes(content)
            assert [frame.stamp for frame in open_source(file)] == times[:images]
    assert 'lost.MCAP has no end, as after a power loss' in caplog.text
    file.write_bytes(data[:1000])
    with pytest.raises(SourceError, match='has no images'):
        open_source(file)


def test_mcap_of_another_profile_names_it(tmp_path):
    write_bag(tmp_path / 'bag', '/raw', records(), 'mcap')
    file = next((tmp_path / 'bag').glob('*.mcap'))
    file.write_bytes(file.read_bytes().replace(b'ros2', b'ros1', 1))
    with pytest.raises(SourceError, match="is an MCAP of profile 'ros1': expected ros2"):
        open_source(file)


def test_bag_with_damaged_bytes_fails_or_reads(bag_file):
    file, data, rng = bag_file, bag_file.read_bytes(), np.random.default_rng(0)
    outcomes = set()
    for _ in range(30):
        damaged = np.frombuffer(data, np.uint8).copy()
        at = rng.integers(0, len(damaged), 20)
        damaged[at] = rng.integers(0, 256, 20)
        file.write_bytes(damaged.tobytes())
        try:
            outcomes.add(len(list(open_source(file, '/raw'))))
        except (SourceError, ImageError) as error:
            outcomes.add(type(error))
    assert SourceError in outcomes


@pytest.fixture(params=['db3', 'mcap'])
def split_bag(tmp_path, request):
    """Return a bag of three parts, of three images each, with the names of ``ros2 bag record``."""
    folder, whole, suffix = tmp_path / 'drive', list(records(9)), request.param
    folder.mkdir()
    for i in range(3):
        storage = 'mcap' if suffix == 'mcap' else 'sqlite3'
        write_bag(tmp_path / 'part', '/raw', whole[3 * i : 3 * i + 3], storage)
        (tmp_path / f'part/part.{suffix}').rename(folder / f'drive_{i}.{suffix}')
        shutil.rmtree(tmp_path / 'part')
    names = [f'drive_{i}.{suffix}' for i in range(3)]
    topics = [{'topic_metadata': {'name': '/raw'}, 'message_count': 9}]
    stated = {'relative_file_paths': names, 'topics_with_message_count': topics}
    (folder / 'metadata.yaml').write_text(json.dumps({'rosbag2_bagfile_information': stated}))
    return folder


NO_METADATA = r'metadata\.yaml is damaged or of another program .*: read without it'


@pytest.mark.parametrize(('change', 'count', 'note'), [
    (lambda *files, at: at.unlink(), 9, ''),
    (lambda *files, at: at.write_text(at.read_text()[:150]), 9, NO_METADATA),
    (lambda *files, at: at.write_text('rosbag2_bagfile_information: {}'), 9, NO_METADATA),
    (lambda *files, at: files[2].unlink(), 6, r'2\.\w+ is missing, /raw has 6 of 9 messages'),
    (lambda *files, at: files[1].write_bytes(b'?' * 300), 6, r'left out: .*_1\.\w+ is damaged'),
    (lambda *files, at: files[0].rename(files[0].with_stem('a')), 9, r'_0\.\w+ is missing'),
    (lambda *files, at: [f.rename(f.with_name(f.name.upper())) for f in files], 9, ''),
])  # fmt: skip
def test_what_is_there_of_a_split_bag_is_read(split_bag, caplog, change, count, note):
    change(*sorted(split_bag.glob('drive_*')), at=split_bag / 'metadata.yaml')
    source = open_source(split_bag)
    times = [frame.stamp for frame in source]
    assert (len(source), len(times), times) == (count, count, sorted(times))
    assert len(list(source.records(0.1, 0.2))) == 2
    assert re.search(note, caplog.text) if note else not caplog.text


@pytest.mark.parametrize('mode', ['FILE', 'MESSAGE', 'STORAGE'])
@pytest.mark.parametrize('has_metadata', [True, False])
def test_compressed_bag_is_read(tmp_path, mode, has_metadata):
    plugin = StoragePlugin.MCAP if mode == 'STORAGE' else StoragePlugin.SQLITE3
    writer = Ros2Writer(tmp_path / 'bag', version=9, storage_plugin=plugin)
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        bag = Bag(writer, ros1=False)
        for each in records():
            fields = bag.header(each.stamp_ns), 6, 8, 'rgb8', 0, 24, each.data
            bag.write('/raw', RAW, each.time_ns, *fields)
    path = (tmp_path / 'bag').rename(tmp_path / 'odd #%41?')
    if not has_metadata:
        (path / 'metadata.yaml').unlink()
    assert [frame.stamp for frame in open_source(path)] == [each.stamp_ns for each in records()]


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


@pytest.mark.parametrize('name', ['bag.bag', 'bag.db3', 'folder'])
def test_open_bag_takes_regular_files_only(tmp_path, name):
    """Reading a pipe would not end."""
    path = tmp_path / name
    if name == 'folder':
        path.mkdir()
        os.mkfifo(path / 'bag.db3')
    else:
        os.mkfifo(path)
    with pytest.raises(SourceError, match=r'pipe|director'), open_bag(path):
        pass
