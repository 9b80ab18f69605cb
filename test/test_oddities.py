# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two sources in one stream, clocks that jump, numbers of another unit: named in one line."""

from itertools import cycle
from types import SimpleNamespace

from builtin_interfaces.msg import Time
import numpy as np
import pytest
from sensor_msgs.msg import Image
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.ros import input as ros_input
from stavpr_ros.sources.bag import BagSource
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord
from stavpr_ros.sources.oddities import RECENT, speed_oddity
from stavpr_ros.units import DATED, SECOND
from std_msgs.msg import Header

COUNT, STEP, START = 30, SECOND // 10, 6 * DATED
STEADY = [START + STEP * i for i in range(COUNT)]
CLOCKS = {
    'steady': (STEADY, ''),
    'no stamps': ([0] * COUNT, ''),
    'out of order': ([STEADY[i ^ 1] for i in range(COUNT)], ''),
    'paused': (STEADY[:15] + [t + 600 * SECOND for t in STEADY[15:]], ''),
    'equal': (STEADY[:1] * COUNT, 'all stamps are 1500000000.000 s: correct the clock'),
    'back': (STEADY[:15] + [t - 5 * SECOND for t in STEADY[15:]], 'stamps jump 1 times, by up'),
    'hours': (STEADY[:15] + [t + 9000 * SECOND for t in STEADY[15:]], 'by up to 9000.1 s'),
    'milliseconds': ([t // 1000 for t in STEADY], 'stamps advance by 0.0029 s in 2.9 s'),
    'nanoseconds': ([START + (t - START) * 1000 for t in STEADY], 'by 2900 s in 2.9 s'),
}


def notes(caplog, folder, stamps, times=STEADY, sources=(('camera', 4, 6),)):
    """Return the lines that two readings of a bag log."""
    records = [
        ImageRecord.of_image(np.zeros((*size, 3), np.uint8), time, stamp, frame)
        for (frame, *size), stamp, time in zip(cycle(sources), stamps, times, strict=False)
    ]
    write_bag(path := folder / 'drive', '/raw', records)
    assert len([*BagSource(path), *BagSource(path)]) == 2 * COUNT
    return caplog.text.splitlines()


@pytest.mark.parametrize('name', CLOCKS)
def test_clocks_that_jump_are_named_in_commands_and_node(
    tmp_path, caplog, image_input, monkeypatch, name
):
    stamps, text = CLOCKS[name]
    lines, expected = notes(caplog, tmp_path, stamps), [True] * bool(text)
    assert [text in line and '/raw: ' in line for line in lines] == expected
    clock = iter(np.array(STEADY) / SECOND)
    monkeypatch.setattr(ros_input.time, 'monotonic', lambda: next(clock))
    for stamp in stamps:
        time = Time(sec=stamp // SECOND, nanosec=stamp % SECOND)
        image_input.on_image(Image(header=Header(stamp=time)))
    assert [text in line for line in image_input.oddities()] == expected


def test_stamps_of_another_epoch_than_the_recording_are_named(tmp_path, caplog):
    (line,) = notes(caplog, tmp_path, STEADY, [time + 4000 * 86400 * SECOND for time in STEADY])
    assert 'stamps are -4000.0 days from the times of recording' in line


@pytest.mark.parametrize('other', [('rear', 4, 6), ('front', 6, 8)])
def test_two_cameras_on_one_topic_are_named(tmp_path, caplog, image_input, other):
    sources = ('front', 4, 6), other
    (line,) = notes(caplog, tmp_path, STEADY, sources=sources)
    assert 'images of 2 sources alternate' in line
    for i in [0] * RECENT + [1] * RECENT:  # another camera from then on
        frame, height, width = sources[i]
        image_input.on_image(Image(header=Header(frame_id=frame), height=height, width=width))
    assert not image_input.oddities()
    for i in range(20):
        image_input.on_image(Image(header=Header(frame_id='xy'[i % 2])))
    assert 'images of 3 sources alternate' in image_input.oddities()[0]


def test_two_publishers_of_a_topic_are_named(image_input):
    info = SimpleNamespace(topic_type='sensor_msgs/msg/Image')
    image_input._node.get_publishers_info_by_topic = lambda topic: [info, info]
    (text,) = image_input.oddities()
    assert text == 'images of 2 publishers are mixed on /image: a topic for each'


def test_odometry_in_millimeters_is_named():
    poses = np.zeros((COUNT, 7))
    poses[:, 0] = np.arange(COUNT) / 10  # 1 m/s
    stamps = np.array(STEADY)
    assert speed_oddity(stamps, poses) == speed_oddity(stamps, 0 * poses) == ''
    poses[5] = np.nan
    assert 'perhaps it has millimeters' in speed_oddity(stamps, 1000 * poses)


@pytest.mark.parametrize(('focal', 'center', 'text'), [
    (500, (320, 240), ''),
    (1000, (640, 360), 'the center (640, 360), as of another resolution'),
    (4.2, (320, 240), 'the focal length 4.2, as of another unit'),
])  # fmt: skip
def test_intrinsics_of_another_image_are_named(focal, center, text):
    oddity = Camera(640, 480, (focal, focal), center).oddity
    assert text in oddity
    assert bool(oddity) == bool(text)
