# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command replay, with a subscriber; as a process where a signal ends it."""

from collections import deque
from functools import partial
import os
import signal
import subprocess
import sys
import threading
from xml.etree import ElementTree

from evaluation_commands import write_images
import numpy as np
from processes import DOMAIN, environment, TIMEOUT
import pytest
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Image
from stavpr_msgs.msg import LoopClosure, MapInfo, PlaceMatch
from stavpr_ros.commands.replay import main
from stavpr_ros.ros import process
from stavpr_ros.ros.qos import LATCHED
from stavpr_ros.ros.subscriber_progress import MAX_BEHIND
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord
from test_playback import spinning

# as many as there are: this thread may get no processor for long
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


class Subscriber:
    """Subscribes to images with best effort and publishes a match of each."""

    def __init__(self, node, answers=lambda images: True):
        self.answers = answers  # decides from the images received so far
        self.images = []
        self.changed = threading.Condition()
        self.publisher = node.create_publisher(PlaceMatch, '~/match', 10)
        node.create_subscription(Image, 'image', self.receive, BEST_EFFORT)

    def receive(self, image):
        with self.changed:
            self.images.append(image)
            self.changed.notify_all()
        if self.answers(self.images):
            self.publisher.publish(PlaceMatch(header=image.header))

    def wait_for(self, count):
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.images) >= count, TIMEOUT)

    def data(self):
        return [bytes(image.data) for image in self.images]

    def milliseconds(self):
        return [image.header.stamp.nanosec // 1_000_000 for image in self.images]


@pytest.fixture
def node(monkeypatch):
    """Return a node that shares its context, and so its participant, with the command."""
    rclpy.init(domain_id=DOMAIN, signal_handler_options=SignalHandlerOptions.NO)
    with (
        monkeypatch.context() as command,
        spinning(rclpy.get_default_context(), 'stavpr') as node,
    ):
        command.setattr(rclpy, 'init', lambda **options: None)
        command.setattr(rclpy, 'try_shutdown', lambda: None)
        yield node
    rclpy.try_shutdown()


@pytest.fixture
def subscribe(node):
    return partial(Subscriber, node)


@pytest.fixture
def replay(monkeypatch, capfd):
    """Run the command in this process, which keeps its signal handlers."""
    monkeypatch.setattr('signal.signal', lambda *_: None)
    monkeypatch.setenv(process.PROFILES_VARIABLE, '')  # set by the command: ends with the test

    def run(*arguments):
        code = main([str(argument) for argument in arguments])
        output, errors = capfd.readouterr()
        assert 'Traceback' not in errors, errors
        return code, output, errors

    return run


def make_bag(path, count=20, gap_ms=20, stamped=True, size=(6, 8)):
    noise = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    times = [10**18 + i * gap_ms * 1_000_000 for i in range(count)]
    write_bag(
        path,
        '/camera',
        (ImageRecord.of_image(noise + i, t, t * stamped, 'cam') for i, t in enumerate(times)),
    )
    return path, [(noise + i).tobytes() for i in range(count)]


def test_replay_of_a_bag_publishes_its_images_and_headers(tmp_path, subscribe, replay):
    bag, data = make_bag(tmp_path / 'bag')
    subscriber = subscribe()
    code, output, _ = replay(bag)
    assert (code, output[:30]) == (0, '20 images published on /image ')
    assert ', 20 of 20 received by the node, 0 skipped' in output
    assert subscriber.data() == data
    first = subscriber.images[0]
    assert (first.header.frame_id, first.header.stamp.sec) == ('cam', 10**9)
    assert (first.height, first.width, first.encoding, first.step) == (6, 8, 'rgb8', 24)
    assert subscriber.milliseconds() == list(range(0, 400, 20))


def test_replay_reports_the_images_that_got_no_result_as_lost(tmp_path, subscribe, replay):
    bag, _ = make_bag(tmp_path / 'bag', stamped=False)  # equal headers are counted
    subscribe(answers=lambda images: len(images) not in (3, 5))
    code, output, _ = replay(bag)
    assert code == 0
    assert ', 18 of 20 received by the node, 2 lost: see docs/troubleshooting.md' in output


def test_replay_with_a_rate_publishes_at_that_pace(tmp_path, subscribe, replay):
    bag, _ = make_bag(tmp_path / 'bag', count=5, gap_ms=60_000)  # four minutes, as recorded
    subscriber = subscribe()
    code, output, _ = replay(bag, '--rate', '600')
    assert (code, len(subscriber.images)) == (0, 5)
    assert float(output.partition(' in ')[2].partition(' s')[0]) >= 0.4


def test_replay_of_large_images_loses_none(tmp_path, subscribe, replay):
    bag, data = make_bag(tmp_path / 'bag', count=30, gap_ms=33, size=(480, 640))
    subscriber = subscribe()
    assert replay(bag)[0] == 0
    assert subscriber.data() == data


@pytest.mark.parametrize('stamped', [True, False])
def test_replay_lossless_ignores_the_recorded_pace(tmp_path, subscribe, stamped, replay):
    bag, data = make_bag(tmp_path / 'bag', count=20, gap_ms=60_000, stamped=stamped)
    subscriber = subscribe()
    code, output, _ = replay(bag, '--lossless')
    assert code == 0
    assert '0 sent again, 0 dropped, 0 skipped' in output
    assert subscriber.data() == data


def test_replay_lossless_waits_for_loop_closures_that_are_behind(tmp_path, node, replay):
    bag, _ = make_bag(tmp_path / 'bag', count=40)
    waiting, backlog = deque(), []

    def answer(image):
        match.publish(PlaceMatch(header=image.header, status=PlaceMatch.MATCH))
        waiting.append(LoopClosure(header=image.header))
        backlog.append(len(waiting))

    def close():
        if waiting:
            closure.publish(waiting.popleft())

    info = node.create_publisher(MapInfo, '~/map_info', LATCHED)  # the first, as the node's
    info.publish(MapInfo(operation='loop_closure'))
    match = node.create_publisher(PlaceMatch, '~/match', 10)
    closure = node.create_publisher(LoopClosure, '~/loop_closure', 10)
    node.create_subscription(Image, 'image', answer, 10)
    node.create_timer(0.05, close)
    assert replay(bag, '--lossless')[0] == 0
    assert len(backlog) == 40
    assert max(backlog) <= MAX_BEHIND + 2


def test_replay_lossless_without_a_match_sends_the_image_again(tmp_path, subscribe, replay):
    bag, data = make_bag(tmp_path / 'bag', count=5)
    subscriber = subscribe(answers=lambda images: len(images) != 3)
    code, output, errors = replay(bag, '--lossless', '--timeout', '4')
    assert code == 0
    assert 'image 3 (stamp 1000000000.040000000): no result for 4 s, sent again' in errors
    assert '1 sent again' in output
    assert subscriber.data() == [*data[:3], *data[2:]]


def test_replay_lossless_without_a_match_after_all_tries_fails(tmp_path, subscribe, replay):
    bag, _ = make_bag(tmp_path / 'bag')
    subscriber = subscribe(answers=lambda images: images[-1].header.stamp.nanosec == 0)
    code, _, errors = replay(bag, '--lossless', '--timeout', '1')
    assert code == 4
    name = 'image 2 (stamp 1000000000.020000000)'
    assert f'replay: {name} got no result on /stavpr/match in 3 tries' in errors
    assert subscriber.milliseconds()[-3:] == [20] * 3


def test_replay_of_a_part_without_images_fails(tmp_path, subscribe, replay):
    bag, _ = make_bag(tmp_path / 'bag')
    subscribe()
    code, _, errors = replay(bag, '--start-offset', '1000')
    assert (code, 'has no image from second 1000 on' in errors) == (1, True)


def test_replay_without_a_subscriber_fails(tmp_path, replay):
    bag, _ = make_bag(tmp_path / 'bag')
    remap = ('--ros-args', '-r', 'image:=/nowhere')
    code, _, errors = replay(bag, '--wait', '0.3', *remap)
    assert code == 3
    assert 'waiting for a subscriber of /nowhere' in errors
    assert 'waited 0.3 s for a subscriber of /nowhere' in errors


@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGTERM])
def test_replay_after_a_signal_ends_at_once(tmp_path, subscribe, sent):
    bag, _ = make_bag(tmp_path / 'bag', count=5, gap_ms=60_000)
    subscriber = subscribe()
    process = subprocess.Popen(
        [sys.executable, '-m', 'stavpr_ros.commands.replay', str(bag)],
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        lines = iter(process.stderr.readline, '')
        assert any('the next image is due in 60 s' in line for line in lines)
        subscriber.wait_for(1)
        process.send_signal(sent)
        _, errors = process.communicate(timeout=TIMEOUT)
    finally:
        process.kill()
    assert process.returncode == 130
    assert errors == 'replay: interrupted\n'


def test_replay_of_a_folder_with_a_damaged_image_skips_it(tmp_path, subscribe, route, replay):
    folder, subscriber = write_images(tmp_path / 'images', route[:4]), subscribe()
    (folder / '002.png').write_bytes(b'damaged')
    code, output, errors = replay(folder, '--fps', '20', '--rate', '2')
    assert code == 0
    assert '1 skipped' in output
    assert '002.png: 7 bytes are no image' in errors
    assert errors.endswith('left out: 1 images that are damaged\n')
    assert subscriber.milliseconds() == [50, 100, 200]


def test_transport_profile_of_the_user_is_kept(monkeypatch):
    monkeypatch.delenv(process.PROFILES_VARIABLE, raising=False)
    process.prepare_transport()
    profile = ElementTree.parse(os.environ[process.PROFILES_VARIABLE])
    assert int(profile.find('.//{*}segment_size').text) == 32 * 2**20
    assert {kind.text for kind in profile.iterfind('.//{*}type')} == {'SHM', 'UDPv4'}
    monkeypatch.setenv(process.PROFILES_VARIABLE, 'my_own.xml')
    process.prepare_transport()
    assert os.environ[process.PROFILES_VARIABLE] == 'my_own.xml'
