# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Replay as `ros2 bag play`, its parts and the command; the command record."""

from collections import deque
from contextlib import closing, contextmanager
from functools import partial
import json
import math
import os
import resource
import signal
import subprocess
import sys
import threading
from xml.etree import ElementTree

from bags import SECOND, TEXT, write_odometry, writing
from evaluation_commands import write_images
from nav_msgs.msg import Odometry
import numpy as np
from processes import DOMAIN, environment, Process, TIMEOUT
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from stavpr_msgs.msg import LoopClosure, MapInfo, PlaceMatch
from stavpr_ros.commands.replay import main
from stavpr_ros.errors import SourceError, UnavailableError
from stavpr_ros.ros import process
from stavpr_ros.ros.messages import message_class, record_message
from stavpr_ros.ros.qos import LATCHED
from stavpr_ros.ros.replay import Playback, Replayer, ReplayOptions
from stavpr_ros.ros.subscriber_progress import MAX_BEHIND
from stavpr_ros.sources.bag import BagSource
from stavpr_ros.sources.bag_messages import list_topics, read_messages
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord, RecordedTopic
from std_msgs.msg import Empty, String
from std_srvs.srv import Trigger

FIRST = 100 * SECOND


def images(count, gap=SECOND):
    """Return one image a second from second 100 on, stamped as the odometry beside it."""
    pixels = np.zeros((2, 3, 3), np.uint8)
    return [ImageRecord.of_image(pixels + i, FIRST + i * gap) for i in range(count)]


def playing(rate, *times):
    """Return a playback whose clock shows these seconds in turn."""
    playback = Playback(rate, False, iter(times).__next__)
    playback.start(FIRST)
    return playback


def test_playback_after_a_pause_continues_where_it_stopped():
    playback = playing(1.0, 5, 6, 6, 66, 67)
    playback.pause(True)
    assert playback.seconds_until(FIRST) == math.inf
    assert playback.now_ns() == FIRST + SECOND
    playback.pause(False)
    assert playback.now_ns() == FIRST + 2 * SECOND


@pytest.mark.parametrize('ros1', [False, True])
def test_bag_with_start_and_duration_yields_that_part(tmp_path, ros1):
    path = tmp_path / ('one.bag' if ros1 else 'two')
    write_odometry(path, [FIRST + i * SECOND for i in range(6)], ros1, images(6))
    # the bag begins with a text at second 99
    records = BagSource(path).records(start=3, duration=2)
    assert [record.time_ns // SECOND for record in records] == [102, 103]
    records = read_messages(path, ['/odom'], start=3, duration=2)
    assert [record.time_ns // SECOND for record in records] == [102, 103]
    assert len(list(BagSource(path).records(start=100))) == 0


def test_messages_of_ros1_are_those_of_ros2(tmp_path):
    """Headers of ROS 1 have a number more, and CameraInfo other names of fields."""
    contents = {}
    for name, ros1 in (('one.bag', True), ('two', False)):
        with writing(tmp_path / name, ros1) as bag:
            region = bag.make('sensor_msgs/msg/RegionOfInterest', 1, 2, 3, 4, True)
            numbers = [np.arange(count, dtype=float) for count in (5, 9, 9, 12)]
            fields = [bag.header(FIRST), 480, 640, 'plumb_bob', *numbers, 0, 0, region]
            bag.write('/info', 'sensor_msgs/msg/CameraInfo', FIRST, *fields)
        (record,) = read_messages(tmp_path / name, ['/info'])
        contents[ros1] = record.content
    assert contents[True] == contents[False]


def test_messages_of_an_unknown_type_of_ros1_are_rejected(tmp_path):
    write_odometry(tmp_path / 'one.bag', [FIRST], ros1=True)
    with writing(tmp_path / 'broken.bag', ros1=True) as bag:
        bag.write_bytes('/odom', 'nav_msgs/msg/Odometry', FIRST, b'short')
    with pytest.raises(SourceError, match='5 bytes are no nav_msgs/msg/Odometry'):
        list(read_messages(tmp_path / 'broken.bag', ['/odom']))


def test_message_class_imports_packages_of_messages_only():
    assert message_class('nav_msgs/msg/Odometry') is Odometry
    unknown = ['os/msg/path', 'antigravity/msg/Text', 'nobody/msg/Text', 'nav_msgs/msg/__name__']
    for name in (*unknown, 'x', '../a/msg/B'):
        with pytest.raises(UnavailableError, match='is not installed'):
            message_class(name)


@contextmanager
def spinning(context, name):
    node = rclpy.create_node(name, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield node
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()


class Received:
    """What a subscriber has received, topic and message."""

    def __init__(self, node, *topics, qos=1000):
        self.messages, self.changed = [], threading.Condition()
        for message_type, topic in topics:
            node.create_subscription(message_type, topic, partial(self.receive, topic), qos)

    def receive(self, topic, message):
        with self.changed:
            self.messages.append((topic, message))
            self.changed.notify_all()

    def wait(self, enough):
        with self.changed:
            assert self.changed.wait_for(lambda: enough(self.messages), TIMEOUT), self.messages

    def of(self, topic):
        return [message for name, message in self.messages if name == topic]


@contextmanager
def replayer(context, options, topics=None):
    node = rclpy.create_node('stavpr_replay', context=context)
    try:
        with closing(Replayer(node, lambda text: None, options, topics or {})) as made:
            yield made
    finally:
        node.destroy_node()


def seconds(header):
    return header.stamp.sec


def test_image_message_has_the_encoding_and_byte_order_of_its_record():
    message = record_message(ImageRecord(1, 2, 'camera', 1, 2, 'mono16', True, 4, b'abcd'))
    assert (message.encoding, message.is_bigendian, message.step) == ('mono16', 1, 4)


def test_replay_with_other_topics_publishes_their_messages(context, tmp_path):
    """Latched ones for late subscribers, too."""
    path = write_odometry(
        tmp_path / 'bag', [FIRST + i * SECOND for i in range(3)], images=images(3)
    )
    topics = list_topics(path)
    assert topics['/odom'] == RecordedTopic('/odom', 'nav_msgs/msg/Odometry', False)
    published = {topics['/odom']: 'odom', RecordedTopic('/text', TEXT, True): '/text'}
    received_on = ((Odometry, '/odom'), (String, '/text'), (Image, '/image'))
    with (
        spinning(context, 'others') as node,
        replayer(context, ReplayOptions(rate=20.0), published) as made,
    ):
        received = Received(node, *received_on)
        made.wait_for_subscribers()
        records = [*read_messages(path, made.topics), *images(3)]
        made.play(sorted(records, key=lambda record: record.time_ns))
        made.finish()
        received.wait(lambda messages: len(messages) == 7)
        Received(node, (String, '/text'), qos=LATCHED).wait(lambda messages: len(messages) == 1)
    assert [seconds(message.header) for message in received.of('/odom')] == [100, 101, 102]
    assert [message.pose.pose.position.x for message in received.of('/odom')] == [0, 1, 2]
    assert made.published == len(received.of('/image')) == 3


def test_replay_clock_advances_with_the_records_and_restarts_with_a_loop(context):
    options = ReplayOptions(rate=100.0, clock=200.0)
    with spinning(context, 'clocked') as node, replayer(context, options) as made:
        received = Received(node, (Clock, '/clock'), (Image, '/image'))
        made.wait_for_subscribers()
        made.play(images(50))
        made.play(images(50))
        made.finish()
        received.wait(lambda _: len(received.of('/image')) == 100)
    times = [clock.clock.sec + clock.clock.nanosec / 1e9 for clock in received.of('/clock')]
    backward = [i for i in range(1, len(times)) if times[i] < times[i - 1]]
    assert len(backward) == 1
    assert times[backward[0]] < 125  # of seconds 100 to 149
    assert backward[0] > 50  # with each image, and between them


def test_replay_lossless_waits_for_a_recorder_until_it_is_ready(context):
    notices = []
    with (
        spinning(context, 'stavpr') as node,
        spinning(context, 'stavpr_record') as recorder,
        replayer(context, ReplayOptions(lossless=True)) as made,
    ):

        def notify(text):
            notices.append(text)
            if 'stavpr_record' in text:
                recorder.create_publisher(Empty, '~/recording', 1)

        made.notify = notify
        node.create_subscription(Image, 'image', lambda image: None, 10)
        node.create_publisher(PlaceMatch, '~/match', 10)
        recorder.create_subscription(PlaceMatch, 'stavpr/match', lambda match: None, 10)
        while not made.node.get_subscriptions_info_by_topic('/stavpr/match')[1:]:
            pass  # its own, and the recorder's
        made.wait_for_subscribers()
    assert notices[-1] == 'waiting for /stavpr_record to be ready'


def test_replay_services_pause_step_and_resume(context):
    with (
        spinning(context, 'control') as node,
        replayer(context, ReplayOptions(rate=1000.0, paused=True)) as made,
    ):
        received = Received(node, (Image, '/image'))

        def call(name):
            client = node.create_client(Trigger, f'/stavpr_replay/{name}')
            assert client.wait_for_service(TIMEOUT)
            done = threading.Event()
            future = client.call_async(Trigger.Request())
            future.add_done_callback(lambda _: done.set())
            assert done.wait(TIMEOUT)
            return future.result().success, future.result().message

        def play():
            made.wait_for_subscribers()
            made.play(images(4))
            made.finish()

        player = threading.Thread(target=play)
        player.start()
        for count in (1, 2):
            assert call('play_next') == (True, 'paused')
            received.wait(lambda messages, count=count: len(messages) == count)
            assert call('pause') == (True, 'paused')
            assert len(received.messages) == count
        assert call('toggle_paused') == (True, 'playing')
        received.wait(lambda messages: len(messages) == 4)
        player.join(TIMEOUT)
    assert [seconds(image.header) for image in received.of('/image')] == [100, 101, 102, 103]


def test_replay_command_loops_over_a_part_of_a_bag(context, tmp_path):
    """Odometry, other topics and the clock are published beside the images."""
    path = write_odometry(
        tmp_path / 'bag', [FIRST + i * SECOND for i in range(6)], images=images(6)
    )
    command = [sys.executable, '-m', 'stavpr_ros.commands.replay', str(path)]
    command += '--odometry --also --clock --loop --rate 20'.split()  # noqa: SIM905
    command += ['--start-offset', '3', '--duration', '2', '--ros-args', '-r', 'odom:=/robot/odom']
    with spinning(context, 'terminal') as node:
        received = Received(node, (Image, '/image'), (Odometry, '/robot/odom'), (Clock, '/clock'))
        running = subprocess.Popen(
            command,
            env=environment() | {'ROS_DOMAIN_ID': str(DOMAIN)},
        )
        try:
            received.wait(lambda _: received.of('/clock') and len(received.of('/image')) >= 5)
            running.send_signal(signal.SIGINT)
            assert running.wait(TIMEOUT) == 130
        finally:
            running.kill()
            running.wait()
    stamps = [seconds(image.header) for image in received.of('/image')]
    assert stamps[:5] == [102, 103, 102, 103, 102]
    assert {seconds(message.header) for message in received.of('/robot/odom')} == {102, 103}


@pytest.mark.parametrize(
    ('name', 'options', 'error'),
    [
        ('bag', ['--also', '/nothing'], '0 topics /nothing'),
        ('bag', ['--odometry', '/text'], '0 topics /text nav_msgs/msg/Odometry with messages'),
        ('images', ['--odometry'], 'no bag, which --odometry and --also require'),
    ],
)
def test_replay_command_of_a_part_that_is_missing_fails(
    tmp_path, capsys, environ, name, options, error
):
    write_odometry(tmp_path / 'bag', [FIRST], images=images(1))
    (tmp_path / 'images').mkdir()
    (tmp_path / 'images/0.ppm').write_bytes(b'P6 3 2 255 ' + bytes(18))
    environ[process.PROFILES_VARIABLE] = ''  # what the command sets ends with the test
    assert main([str(tmp_path / name), *options]) == 1
    assert error in capsys.readouterr().err


# as many as there are: this thread may get no processor for long
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


def every(images):
    """Whether the last image gets a match."""
    return True


class Subscriber(Received):
    """Subscribes to images with best effort and publishes a match of each."""

    def __init__(self, node, answers=every):
        self.answers = answers  # decides from the images received so far
        self.publisher = node.create_publisher(PlaceMatch, '~/match', 10)
        super().__init__(node, (Image, 'image'), qos=BEST_EFFORT)

    def receive(self, topic, image):
        super().receive(topic, image)
        if self.answers(self.images):
            self.publisher.publish(PlaceMatch(header=image.header))

    @property
    def images(self):
        return self.of('image')

    def data(self):
        return [bytes(image.data) for image in self.images]


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
def replay(environ, monkeypatch, capfd):
    """Run the command in this process, which keeps its signal handlers."""
    monkeypatch.setattr('signal.signal', lambda *_: None)
    environ[process.PROFILES_VARIABLE] = ''  # set by the command: ends with the test

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


PACED = {'count': 5, 'gap_ms': 60_000}  # four minutes
LOST = ', 18 of 20 received by the node, 2 lost: see docs/troubleshooting.md'
AGAIN = 'image 3 (stamp 1000000000.040000000): no result for 4 s, sent again'
NEVER = 'replay: image 2 (stamp 1000000000.020000000) got no result on /stavpr/match in 3 tries'
AS_FAST = '0 sent again, 0 dropped, 0 skipped'
WHOLE = '20 images published on /image ', ', 20 of 20 received by the node, 0 skipped'
# of a bag: what it has, arguments, which images get a match, exit status, words, images received
REPLAYS = [
    ({}, '', every, 0, WHOLE, range(20)),
    ({'stamped': False}, '', lambda seen: len(seen) not in (3, 5), 0, [LOST], range(20)),
    ({'count': 30, 'gap_ms': 33, 'size': (480, 640)}, '', every, 0, [], range(30)),
    (PACED, '--rate 600', every, 0, [], range(5)),
    (PACED, '--lossless', every, 0, [AS_FAST], range(5)),
    (PACED | {'stamped': False}, '--lossless', every, 0, [AS_FAST], range(5)),
    (
        {'count': 5},
        '--lossless --timeout 4',
        lambda seen: len(seen) != 3,
        0,
        [AGAIN, '1 sent again'],
        [0, 1, 2, 2, 3, 4],
    ),
    ({}, '--lossless --timeout 1', lambda seen: len(seen) == 1, 4, [NEVER], [0, 1, 1, 1]),
    ({}, '--start-offset 1000', every, 1, ['has no image from second 1000 on'], []),
]


@pytest.mark.parametrize(('bag', 'arguments', 'answers', 'code', 'words', 'received'), REPLAYS)
def test_replay_of_a_bag_publishes_its_images(
    tmp_path, subscribe, replay, bag, arguments, answers, code, words, received
):
    path, data = make_bag(tmp_path / 'bag', **bag)
    subscriber = subscribe(answers=answers)
    status, output, errors = replay(path, *arguments.split())
    assert status == code
    assert all(text in output + errors for text in words), output + errors
    assert subscriber.data() == [data[i] for i in received]
    if 'rate' in arguments:
        assert float(output.partition(' in ')[2].partition(' s')[0]) >= 0.4
    for i, image in zip(received, subscriber.images, strict=True):
        height, width = bag.get('size', (6, 8))
        assert (image.height, image.width, image.step) == (height, width, 3 * width)
        assert (image.header.frame_id, image.encoding) == ('cam', 'rgb8')
        stamp = (10**12 + i * bag.get('gap_ms', 20)) * bag.get('stamped', True)
        assert image.header.stamp.sec * 1000 + image.header.stamp.nanosec // 10**6 == stamp


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
        subscriber.wait(bool)
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
    assert errors.endswith('left out: images that are damaged: 1\n')
    stamps = [image.header.stamp.nanosec // 1_000_000 for image in subscriber.images]
    assert stamps == [50, 100, 200]


def test_transport_profile_of_the_user_is_kept(environ):
    environ.pop(process.PROFILES_VARIABLE, None)
    process.prepare_transport()
    profile = ElementTree.parse(os.environ[process.PROFILES_VARIABLE])
    assert int(profile.find('.//{*}segment_size').text) == 32 * 2**20
    assert {kind.text for kind in profile.iterfind('.//{*}type')} == {'SHM', 'UDPv4'}
    environ[process.PROFILES_VARIABLE] = 'my_own.xml'
    process.prepare_transport()
    assert os.environ[process.PROFILES_VARIABLE] == 'my_own.xml'


# The command record: earlier recordings stay until there is something to replace them by

OLD = '{"stamp": 1, "frame_id": "old"}\n'


@pytest.fixture
def record(robot, tmp_path, request):
    """Start the command over an old recording; it is ended with the test."""
    path = tmp_path / 'old.jsonl'
    path.write_text(OLD)

    def start(*options):
        recorder = Process(tmp_path / 'log', 'record', '--output', str(path), *options)
        request.addfinalizer(recorder.end)
        return recorder

    return start


@pytest.fixture
def publisher(robot):
    publisher = robot.node.create_publisher(PlaceMatch, '/stavpr/match', 10)
    yield publisher
    robot.node.destroy_publisher(publisher)


def recording(robot, process):
    robot.until(lambda: '\nrecording' in process.output(), 'the recorder')


def test_record_over_an_old_recording_is_refused_without_force(record, tmp_path):
    process = record()
    assert process.wait() == 1
    assert 'exists already: choose another name, or replace it by --force' in process.output()
    assert (tmp_path / 'old.jsonl').read_text() == OLD


def test_record_shows_matches_on_the_standard_output(record, robot, publisher):
    process = record('--output', '-')
    recording(robot, process)
    publisher.publish(PlaceMatch(place_index=7))
    robot.until(lambda: '"place_index": 7' in process.output(), 'the match')


def test_record_replaces_an_old_recording_at_the_first_message(record, robot, publisher, tmp_path):
    path = tmp_path / 'old.jsonl'
    process = record('--force')
    recording(robot, process)
    assert path.read_text() == OLD
    assert process.stop() == 0  # without a message
    assert path.read_text() == OLD

    process = record('--force')
    recording(robot, process)
    for index in range(3):
        publisher.publish(PlaceMatch(place_index=index))
    robot.until(lambda: path.read_text().count('\n') == 3, 'three records')
    process.popen.kill()  # what is written is there
    process.wait()
    assert [json.loads(line)['place_index'] for line in path.open()] == [0, 1, 2]
    assert sorted(os.listdir(tmp_path)) == ['log', 'old.jsonl']


def test_record_on_a_full_disk_ends_with_whole_lines(record, robot, publisher, tmp_path):
    """The limit of the size of a file has the effect of a full disk."""
    path = tmp_path / 'old.jsonl'
    process = record('--force')
    recording(robot, process)
    resource.prlimit(process.popen.pid, resource.RLIMIT_FSIZE, (10_000, 10_000))

    def has_ended():
        publisher.publish(PlaceMatch(reason='x' * 200))
        return process.popen.poll() is not None

    robot.until(has_ended, 'the end')
    lines = path.read_text().splitlines(keepends=True)
    assert len(lines) > 3
    assert all(json.loads(line)['reason'] == 'x' * 200 for line in lines)
    assert f'it has {len(lines)} matches, all of them whole: free space' in process.output()
    assert 'untouched' not in process.output()
    assert process.wait() == 1
