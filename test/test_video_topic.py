# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Video topics: packets by encoders of PyAV, in substitutes for the messages of other projects.

The substitutes are built from the published definitions, in a bag or in this process.
"""

from types import SimpleNamespace

from bags import SECOND, writing
from builtin_interfaces.msg import Time
import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage
from stavpr_ros.errors import ImageError, SourceError
from stavpr_ros.ros import input as ros_input
from stavpr_ros.sources import files
from stavpr_ros.sources.bag import BagSource, COMPRESSED
from stavpr_ros.sources.encodings import decode_message
from stavpr_ros.sources.video_topic import (
    DEFINITIONS,
    FFMPEG,
    FOXGLOVE,
    NO_KEY_FRAME,
    ROS1_FFMPEG,
    VideoStream,
)
from std_msgs.msg import Header
from videos import colored_images, HEIGHT, packets, WIDTH

COUNT, GOP = 15, 5
IMAGES = colored_images(COUNT)
CODECS = {'libx264': ('h264;yuv420p;bgr8;rgb8', 'h264'), 'libx265': ('hevc_nvenc', 'h265')}
NEWER = 'string uuid\nstring lineage\n'  # fields behind those that are read


@pytest.fixture(scope='module', params=CODECS)
def codec(request):
    return request.param


@pytest.fixture(scope='module')
def video(codec):
    return packets(IMAGES, codec, GOP)


def message_of(packet, kind, codec, i, **changes):
    """Return a packet as a message of a kind, its fields in the order of the definition."""
    data, time = np.frombuffer(bytes(packet), np.uint8), Time(sec=i + 1)
    fields = {'timestamp': time, 'frame_id': 'camera', 'data': data, 'format': CODECS[codec][1]}
    if kind == FFMPEG:
        fields = {
            'header': Header(stamp=time, frame_id='camera'),
            'width': WIDTH,
            'height': HEIGHT,
        }
        fields |= {'encoding': CODECS[codec][0], 'pts': packet.pts}
        fields |= {'flags': int(packet.is_keyframe), 'is_bigendian': False, 'data': data}
    return SimpleNamespace(**fields | changes)


def decode(stream, messages):
    """Return the image of each message, or the kind of its error."""
    result = []
    for message in messages:
        image = stream.read(message)
        assert image.header.stamp.sec
        try:
            result.append(decode_message(image))
        except ImageError as error:
            result.append(error.kind)
    return result


def check(found, missing=()):
    """Compare images with those that were encoded; others have an error."""
    for i, image in enumerate(found):
        if i in missing:
            assert image == missing[i], i
        else:
            assert np.median(np.abs(image.astype(int) - IMAGES[i])) < 4, i


@pytest.mark.parametrize('kind', [FFMPEG, FOXGLOVE])
def test_each_packet_is_an_image_from_the_first_key_frame_on(video, codec, kind):
    messages = [message_of(packet, kind, codec, i) for i, packet in enumerate(video)]
    check(decode(VideoStream(), messages))
    late = decode(VideoStream(), messages[3:])
    check([*IMAGES[:3], *late], dict.fromkeys(range(3, GOP), NO_KEY_FRAME))


def test_lost_packets_are_counted_and_their_key_frame_is_awaited(video, codec):
    messages = [message_of(packet, FFMPEG, codec, i) for i, packet in enumerate(video)]
    stream = VideoStream()
    result = decode(stream, messages[:6] + messages[8:])
    check([*result[:6], *IMAGES[6:8], *result[6:]], {8: NO_KEY_FRAME, 9: NO_KEY_FRAME})
    assert stream.lost == 2
    decode(stream, messages)  # the publisher has started again
    assert stream.lost == 2
    for i, message in enumerate(messages):
        message.pts = 33_333 * i  # microseconds
    check(decode(other := VideoStream(), messages))
    assert other.lost == 0


def test_bad_packets_are_errors_of_their_images_only(video, codec, set_constants):
    stream, random = VideoStream(), np.random.default_rng(0)
    for kind in (FFMPEG, FOXGLOVE):
        for i, packet in enumerate(video * 4):
            message = message_of(packet, kind, codec, i)
            message.data = message.data.copy()
            where = random.integers(0, message.data.size, 1 + i % 7)
            message.data[where] = random.integers(0, 256, where.size)
            message.data = message.data[: random.integers(0, message.data.size + 1)]
            decode(stream, [message])
    good = [message_of(packet, FFMPEG, codec, i) for i, packet in enumerate(video)]
    check(decode(stream, good))
    bad = message_of(video[0], FFMPEG, codec, 0, width=100_000, height=100_000)
    assert decode(stream, [bad]) == ['too large']
    bad = message_of(video[0], FFMPEG, codec, 0, encoding='av1')
    assert decode(stream, [bad]) == ['encoding']
    set_constants(files, MAX_PIXELS=WIDTH * HEIGHT - 1)  # what the parameters claim
    for message in good[:2]:
        message.width = message.height = 1
    assert decode(VideoStream(), good[:2]) == ['damaged', NO_KEY_FRAME]


def test_image_that_ffmpeg_conceals_is_damaged(route):
    messages = [
        message_of(packet, FOXGLOVE, 'libx264', i)
        for i, packet in enumerate(packets(route[:6], 'libx264', 5))
    ]
    messages[2].data = messages[2].data[: messages[2].data.size // 2]
    result = [image if isinstance(image, str) else '' for image in decode(VideoStream(), messages)]
    assert result == ['', '', 'damaged', NO_KEY_FRAME, NO_KEY_FRAME, '']


def test_b_frames_are_refused_with_the_remedy():
    result = packets(IMAGES, b_frames=2)
    message = message_of(result[0], FOXGLOVE, 'libx264', 0)
    with pytest.raises(ImageError, match='max_b_frames: 0'):
        VideoStream().read(message).decode()


@pytest.mark.parametrize('kind', [FFMPEG, FOXGLOVE, 'ros1', 'newer'])
def test_bag_with_a_video_topic_is_a_sequence_of_images(tmp_path, codec, video, kind):
    is_ros1, name = kind == 'ros1', FOXGLOVE if kind in (FOXGLOVE, 'newer') else FFMPEG
    text = ROS1_FFMPEG if is_ros1 else DEFINITIONS[name] + (NEWER if kind == 'newer' else '')
    path = tmp_path / ('drive.bag' if is_ros1 else 'drive')
    with writing(path, is_ros1) as bag:
        bag.define(name, text)
        for i, packet in enumerate(video):
            if i == 7:
                continue
            data, header = np.frombuffer(bytes(packet), np.uint8), bag.header((i + 1) * SECOND)
            fields = header.stamp, 'camera', data, CODECS[codec][1]
            fields += ('id', 'text') if kind == 'newer' else ()
            if name == FFMPEG:
                start = (header, data, WIDTH, HEIGHT) if is_ros1 else (header, WIDTH, HEIGHT)
                fields = *start, CODECS[codec][0], packet.pts, int(packet.is_keyframe)
                fields += () if is_ros1 else (False, data)
            bag.write('/camera/video', name, (i + 1) * SECOND, *fields)
    errors = []
    source = BagSource(path, on_error=errors.append)
    assert (source.message_type, len(source)) == (name, COUNT - 1)
    frames = list(source)
    if name == FFMPEG:  # the other one does not report that a packet is missing
        assert [error.kind for error in errors] == 2 * [NO_KEY_FRAME]
        left = [*range(7), *range(10, COUNT)]
        assert [frame.stamp for frame in frames] == [(i + 1) * SECOND for i in left]
        for i, frame in zip(left, frames, strict=True):
            assert np.median(np.abs(frame.image.astype(int) - IMAGES[i])) < 4
        record = next(source.records())
        assert (record.encoding, record.stamp_ns) == ('rgb8', SECOND)


@pytest.mark.parametrize('ros1', [False, True])
def test_video_in_compressed_images_of_a_bag_is_decoded(tmp_path, codec, video, ros1):
    path = tmp_path / 'drive.bag'
    with writing(path, ros1) as bag:
        for i, packet in enumerate(video):
            data = np.frombuffer(bytes(packet), np.uint8)
            fields = bag.header((i + 1) * SECOND), f'bgr8; {CODECS[codec][1].upper()}', data
            bag.write('/camera/compressed', COMPRESSED, (i + 1) * SECOND, *fields)
    check([frame.image for frame in BagSource(path)])
    assert len(list(BagSource(path).records())) == COUNT


@pytest.mark.parametrize('image_input', ['compressed'], indirect=True)
@pytest.mark.parametrize('has_pyav', [True, False])
def test_node_decodes_video_in_compressed_images(image_input, hide_module, video, codec, has_pyav):
    if not has_pyav:
        hide_module('av.video.reformatter')
    for i, packet in enumerate(video):
        header, data = Header(stamp=Time(sec=i + 1)), bytes(packet)
        image_input.on_image(CompressedImage(header=header, format=CODECS[codec][1], data=data))
    assert [image.header.stamp.sec for image in image_input.passed] == list(range(1, COUNT + 1))
    if has_pyav:
        check(list(map(decode_message, image_input.passed)))
    else:
        with pytest.raises(ImageError, match='pip install av'):
            decode_message(image_input.passed[0])


def test_bag_of_another_transport_has_a_remedy_and_damaged_messages_are_errors(tmp_path):
    kind = 'theora_image_transport/msg/Packet'
    with writing(tmp_path / 'theora') as bag:
        bag.define(kind, 'uint8[] data\n')
        bag.write('/camera/theora', kind, SECOND, np.zeros(9, np.uint8))
    with pytest.raises(SourceError, match='republish TRANSPORT raw'):
        BagSource(tmp_path / 'theora')
    with writing(tmp_path / 'damaged') as bag:
        bag.define(FOXGLOVE, DEFINITIONS[FOXGLOVE])
        for content in (b'', b'\0\1\0\0', b'\0\1\0\0' + 40 * b'\xff'):
            bag.write_bytes('/video', FOXGLOVE, SECOND, content)
    errors = []
    assert list(BagSource(tmp_path / 'damaged', on_error=errors.append)) == []
    assert [error.kind for error in errors] == 3 * ['damaged']


@pytest.fixture
def transport(monkeypatch):
    """Let the node have a class of messages for packets."""
    monkeypatch.setattr(ros_input, 'message_class', lambda name: CompressedImage)


@pytest.mark.parametrize('image_input', ['ffmpeg'], indirect=True)
def test_node_subscribes_below_the_topic_of_images_and_counts_lost_packets(
    transport, image_input, video, codec
):
    images, queue = image_input, image_input.passed
    assert images.topic == '/image/ffmpeg'
    images.max_rate = 1.0
    for i in (0, 1, 2, 3, 5, 6):
        message = message_of(video[i], FFMPEG, codec, i)
        if i == 2:  # faster than max_rate: decoded, since the next ones depend on it
            message.header.stamp = Time(sec=2, nanosec=1)
        images.on_image(message)
    assert [image.header.stamp.sec for image in queue] == [1, 2, 4, 6, 7]
    check([*IMAGES[:3], decode_message(queue[2]), IMAGES[4], *map(decode_message, queue[3:])])
    assert len(images.rejected) == 1
    images._on_lost(3)  # by the middleware, the one above among them
    assert images.statistics.counts().dropped.total['lost in transport'] == 3
    images.on_image(message_of(video[7], FFMPEG, codec, 7))
    with pytest.raises(ImageError, match='before a key frame'):
        decode_message(queue[-1])
