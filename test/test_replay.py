"""The replay command as its own process, against a node in this one."""

import os
import signal
import subprocess
import sys
import threading
import time
from xml.etree import ElementTree

import numpy as np
import pytest

from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord

rclpy = pytest.importorskip('rclpy')
messages = pytest.importorskip('stavpr_msgs.msg')

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from sensor_msgs.msg import Image  # noqa: E402

from stavpr_ros.ros import transport  # noqa: E402

DOMAIN = 1 + os.getpid() % 100
COMMAND = [sys.executable, '-m', 'stavpr_ros.commands.replay']
MINUTE = 60


class Listener:
    """A node that hears images best-effort, as a camera's subscriber does, and answers each."""

    def __init__(self, answer=lambda count: True):
        self.answer = answer
        self.heard = []
        self.changed = threading.Condition()
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('stavpr', context=self.context)
        self.publisher = self.node.create_publisher(messages.PlaceMatch, '~/match', 10)
        self.node.create_subscription(Image, 'image', self.hear, qos_profile_sensor_data)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin)
        self.thread.start()

    def hear(self, image):
        with self.changed:
            self.heard.append(image)
            self.changed.notify_all()
        if self.answer(len(self.heard)):
            self.publisher.publish(messages.PlaceMatch(header=image.header))

    def wait_for(self, count):
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.heard) >= count, MINUTE)

    def close(self):
        self.executor.shutdown()
        self.thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def listen():
    listeners = []

    def start(**options):
        listeners.append(Listener(**options))
        return listeners[-1]

    yield start
    for listener in listeners:
        listener.close()


def start_replay(*arguments):
    environment = os.environ | {'ROS_DOMAIN_ID': str(DOMAIN), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    return subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def replay(*arguments):
    process = start_replay(*arguments)
    try:
        output, errors = process.communicate(timeout=MINUTE)
    finally:
        process.kill()
    assert 'Traceback' not in errors
    return process.returncode, output, errors


def make_bag(path, count=20, gap_ms=20, stamped=True, size=(6, 8)):
    noise = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    times = [10**18 + i * gap_ms * 1_000_000 for i in range(count)]
    write_bag(
        path, '/camera', (ImageRecord.of_image(noise + i, t, t * stamped, 'cam') for i, t in enumerate(times))
    )
    return path, [(noise + i).tobytes() for i in range(count)]


def test_paced_from_the_first_image_on(tmp_path, listen):
    bag, pixels = make_bag(tmp_path / 'bag')
    listener = listen()
    code, output, _ = replay(bag)
    assert (code, output[:30]) == (0, '20 images published on /image ')
    assert [bytes(image.data) for image in listener.heard] == pixels
    first = listener.heard[0]
    assert (first.header.frame_id, first.header.stamp.sec, first.header.stamp.nanosec) == ('cam', 10**9, 0)
    assert (first.height, first.width, first.encoding, first.step) == (6, 8, 'rgb8', 24)
    assert listener.heard[-1].header.stamp.nanosec == 380_000_000


def test_rate_and_another_topic(tmp_path, listen):
    bag, _ = make_bag(tmp_path / 'bag', count=5, gap_ms=400)
    listener = listen()
    began = time.monotonic()
    code, output, _ = replay(bag, '--rate', '4', '--publish-to', 'other', '--ros-args', '-r', 'other:=/image')
    assert (code, len(listener.heard)) == (0, 5)
    seconds = float(output.partition(' in ')[2].partition(' s')[0])
    assert 0.4 <= seconds <= time.monotonic() - began


def test_large_images_all_arrive(tmp_path, listen):
    bag, pixels = make_bag(tmp_path / 'bag', count=60, gap_ms=33, size=(480, 640))
    listener = listen()
    assert replay(bag)[0] == 0
    assert [bytes(image.data) for image in listener.heard] == pixels


@pytest.mark.parametrize('stamped', [True, False])
def test_lossless(tmp_path, listen, stamped):
    bag, pixels = make_bag(tmp_path / 'bag', count=50, gap_ms=60_000, stamped=stamped)
    listener = listen()
    code, output, _ = replay(bag, '--lossless')
    assert code == 0
    assert '0 sent again, 0 dropped, 0 skipped' in output
    assert [bytes(image.data) for image in listener.heard] == pixels


def test_a_lost_image_is_sent_again(tmp_path, listen):
    bag, pixels = make_bag(tmp_path / 'bag', count=5)
    listener = listen(answer=lambda count: count != 3)
    code, output, errors = replay(bag, '--lossless', '--timeout', '0.5')
    assert code == 0
    assert 'image 3 (stamp 1000000000.040000000): no answer for 0.5 s, sent again' in errors
    assert '1 sent again' in output
    assert [bytes(image.data) for image in listener.heard] == [*pixels[:3], *pixels[2:]]


def test_no_answer(tmp_path, listen):
    bag, _ = make_bag(tmp_path / 'bag')
    listener = listen(answer=lambda count: count < 2)
    code, _, errors = replay(bag, '--lossless', '--timeout', '0.2')
    assert code == 4
    assert 'error: image 2 (stamp 1000000000.020000000) got no answer on /stavpr/match in 3 tries' in errors
    assert len(listener.heard) == 4


def test_nobody_listens(tmp_path):
    bag, _ = make_bag(tmp_path / 'bag')
    code, _, errors = replay(bag, '--wait', '0.3', '--publish-to', '/nowhere')
    assert code == 3
    assert 'waiting for a subscriber of /nowhere' in errors
    assert 'waited 0.3 s for a subscriber of /nowhere' in errors


def test_a_late_listener_misses_nothing(tmp_path, listen):
    bag, pixels = make_bag(tmp_path / 'bag')
    process = start_replay(bag)
    try:
        assert 'waiting for a subscriber of /image' in process.stderr.readline()
        listener = listen()
        process.communicate(timeout=MINUTE)
    finally:
        process.kill()
    assert process.returncode == 0
    assert [bytes(image.data) for image in listener.heard] == pixels


@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGTERM])
def test_interrupted(tmp_path, listen, sent):
    bag, _ = make_bag(tmp_path / 'bag', count=5, gap_ms=60_000)
    listener = listen()
    process = start_replay(bag)
    try:
        lines = iter(process.stderr.readline, '')
        assert any('the next image comes in 60 s' in line for line in lines)
        listener.wait_for(1)
        process.send_signal(sent)
        _, errors = process.communicate(timeout=MINUTE)
    finally:
        process.kill()
    assert process.returncode == 130
    assert errors == 'replay: interrupted\n'


def test_images_that_cannot_be_read_are_skipped(tmp_path, listen, route):
    import cv2

    for i, image in enumerate(route[:4]):
        cv2.imwrite(str(tmp_path / f'{i}.png'), image)
    (tmp_path / '2.png').write_bytes(b'damaged')
    listener = listen()
    code, output, errors = replay(tmp_path, '--rate', '20')
    assert (code, len(listener.heard)) == (0, 3)
    assert '1 skipped' in output
    assert '2.png: 7 bytes are no image' in errors
    assert [image.header.stamp.nanosec for image in listener.heard] == [50_000_000, 100_000_000, 200_000_000]


@pytest.mark.parametrize(
    ('arguments', 'code', 'text'),
    [
        (['no/such.bag'], 1, 'no/such.bag does not exist'),
        ([], 2, 'BAG'),
        (['.', '--rate', '0'], 2, '0: expected a number above 0'),
        (['.', '--rate', '2', '--lossless'], 2, 'not allowed with'),
        (['{bag}', '--publish-to', 'im%age'], 2, 'Invalid topic name'),
        (['{bag}', '--ros-args', '-r'], 2, 'remap'),
        (['{bag}', '--topic', '/other'], 1, 'expected one of /camera'),
    ],
)
def test_exit_codes(tmp_path, arguments, code, text):
    bag, _ = make_bag(tmp_path / 'bag', count=1)
    found, _, errors = replay(*(argument.format(bag=bag) for argument in arguments))
    assert found == code
    assert text in errors


def test_help_names_exit_codes():
    code, output, _ = replay('--help')
    assert code == 0
    assert all(word in output for word in ('examples:', 'exit codes:', '--lossless', '130'))


def test_real_bags(data_folder, listen):
    listener = listen()
    bags = data_folder / 'bags'
    for topic in ('/image', '/image/compressed'):
        assert replay(bags / 'klintan_rosbag2js_sample.db3', '--topic', topic, '--lossless')[0] == 0
    for camera in (1, 2):
        topic = f'/camera/fisheye{camera}/image_raw'
        assert replay(bags / 'kapture_t265_trimmed_locoffice.bag', '--topic', topic)[0] == 0
    assert [image.encoding for image in listener.heard] == ['bgr8', 'rgb8'] + ['mono8'] * 6


def test_the_transport_profile(monkeypatch):
    monkeypatch.delenv(transport.PROFILES_VARIABLE, raising=False)
    transport.prepare_transport()
    profile = ElementTree.parse(os.environ[transport.PROFILES_VARIABLE])
    assert int(profile.find('.//{*}segment_size').text) == 32 * 2**20
    assert {kind.text for kind in profile.iterfind('.//{*}type')} == {'SHM', 'UDPv4'}
    monkeypatch.setenv(transport.PROFILES_VARIABLE, 'my_own.xml')
    transport.prepare_transport()
    assert os.environ[transport.PROFILES_VARIABLE] == 'my_own.xml'
