# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Two sources in one stream, clocks that jump, numbers of another unit: named in one line."""

from types import SimpleNamespace

from bags import writing
from builtin_interfaces.msg import Time
import numpy as np
import pytest
from sensor_msgs.msg import Image
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.ros import input as ros_input
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.sources.bag import BagSource, RAW
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
    'epochs': (STEADY[:15] + [STEP * i for i in range(15)], 'stamps jump 1 times'),
    'milliseconds': ([t // 1000 for t in STEADY], 'stamps advance by 0.0029 s in 2.9 s'),
    'nanoseconds': ([START + (t - START) * 1000 for t in STEADY], 'by 2900 s in 2.9 s'),
}


def write(path, stamps, times=STEADY, sources=(('camera', 4, 6),)):
    with writing(path) as bag:
        for i, (stamp, time) in enumerate(zip(stamps, times, strict=True)):
            frame, height, width = sources[i % len(sources)]
            pixels = np.zeros(3 * height * width, np.uint8)
            header = bag.header(stamp, frame)
            bag.write('/raw', RAW, time, header, height, width, 'rgb8', 0, 3 * width, pixels)
    return BagSource(path)


@pytest.fixture
def live(context):
    """Return the input of a node: images are given to it, no publisher is needed."""
    node = ManagedNode('n', context=context)
    settings = SimpleNamespace(image_transport='raw', max_rate=0.0, max_stamp_gap=2.0)
    ignore = [lambda *_: None] * 3
    images = ros_input.ImageInput(node, settings, Statistics(), *ignore)
    yield images
    images.close()
    node.destroy_node()


@pytest.mark.parametrize('name', CLOCKS)
def test_clocks_that_jump_are_named_in_commands_and_node(
    tmp_path, caplog, live, monkeypatch, name
):
    stamps, text = CLOCKS[name]
    source = write(tmp_path / 'drive', stamps)
    for _ in range(2):  # once a process
        assert len(list(source)) == COUNT
    lines = caplog.text.splitlines()
    assert [text in line and '/raw: ' in line for line in lines] == [True] * bool(text)
    clock = iter(np.array(STEADY) / SECOND)
    monkeypatch.setattr(ros_input.time, 'monotonic', lambda: next(clock))
    for stamp in stamps:
        time = Time(sec=stamp // SECOND, nanosec=stamp % SECOND)
        live.on_image(Image(header=Header(stamp=time)))
    assert [text in each for each in live.oddities()] == [True] * bool(text)


def test_stamps_of_another_epoch_than_the_recording_are_named(tmp_path, caplog):
    later = [time + 40_000 * 86400 * STEP for time in STEADY]
    list(write(tmp_path / 'drive', STEADY, later))
    assert caplog.text.count('stamps are -4000.0 days from the times of recording') == 1


@pytest.mark.parametrize('other', [('rear', 4, 6), ('front', 6, 8)])
def test_two_cameras_on_one_topic_are_named(tmp_path, caplog, live, other):
    sources = ('front', 4, 6), other
    list(write(tmp_path / 'drive', STEADY, sources=sources))
    assert caplog.text.count('images of 2 sources alternate') == 1
    for i in range(2 * RECENT):
        frame, height, width = sources[i // RECENT]  # another camera from then on
        header = Header(frame_id=frame, stamp=Time(sec=i))
        live.on_image(Image(header=header, height=height, width=width))
    assert not live.oddities()
    for i in range(20):
        live.on_image(Image(header=Header(frame_id='xy'[i % 2], stamp=Time(sec=500 + i))))
    assert 'images of 3 sources alternate' in live.oddities()[0]


def test_two_publishers_of_a_topic_are_named(live):
    info = SimpleNamespace(topic_type='sensor_msgs/msg/Image')
    live._node.get_publishers_info_by_topic = lambda topic: [info, info]
    assert live.oddities() == ['images of 2 publishers are mixed on /image: a topic for each']


def test_odometry_in_millimeters_is_named():
    poses = np.zeros((COUNT, 7))
    poses[:, 0] = np.arange(COUNT) / 10  # 1 m/s
    stamps = np.array(STEADY)
    assert speed_oddity(stamps, poses) == speed_oddity(stamps, 0 * poses) == ''
    assert 'odometry moves at 1000 m/s' in speed_oddity(stamps, 1000 * poses)
    poses[5] = np.nan
    assert 'perhaps it has millimeters' in speed_oddity(stamps, 1000 * poses)
    assert speed_oddity(stamps[:2], 1000 * poses[:2]) == ''


@pytest.mark.parametrize(
    ('focal', 'center', 'text'),
    [
        (500, (320, 240), ''),
        (500, (300, 200), ''),
        (1000, (640, 360), r'the center (640, 360), as of another resolution'),
        (250, (160, 120), ''),
        (4.2, (320, 240), 'the focal length 4.2, as of another unit'),
        (250, (150, 110), 'as of another resolution'),
    ],
)
def test_intrinsics_of_another_image_are_named(focal, center, text):
    assert text in Camera(640, 480, (focal, focal), center).oddity
