# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of the node: transports, encodings, invalid images, keyframes, odometry, QoS."""

import array

from builtin_interfaces.msg import Time
from camera import Camera, LENGTH, SECOND
from diagnostic_msgs.msg import DiagnosticStatus
from image_messages import compressed_message, image_message
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from raw_images import BAYER, CHANNELS, is_deep, mosaic, packed_yuv, YUV
from rcl_interfaces.srv import GetParameters
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.parameters import BY_NAME
from std_msgs.msg import Header

WARN, ERROR = DiagnosticStatus.WARN, DiagnosticStatus.ERROR
WARMING_UP, MATCH = PlaceMatch.WARMING_UP, PlaceMatch.MATCH
INVALID, SKIPPED = PlaceMatch.INVALID_IMAGE, PlaceMatch.SKIPPED


def encoded(image, encoding):
    """Return an image in a raw encoding, byte by byte; 16 bits are little-endian."""
    height, width = image.shape[:2]
    if encoding in BAYER:
        rows = mosaic(encoding, image)
        step, data = rows.shape[1], rows.tobytes()
    elif encoding in YUV:
        red, green, blue = np.moveaxis(image.astype(float), 2, 0) / 255
        luma = 0.299 * red + 0.587 * green + 0.114 * blue  # BT.601
        planes = 16 + 219 * luma, 128 + 126.4 * (blue - luma), 128 + 159.8 * (red - luma)
        step, data = packed_yuv(encoding, np.dstack(planes).round().astype(np.uint8))
    else:
        order = CHANNELS[encoding]
        wide = 'a' in encoding or encoding.endswith('4')
        values = np.full((height, width, 4 if wide else len(set(order))), 255, np.uint16)
        for color, channel in enumerate(order):
            values[..., channel] = image[..., color] if len(set(order)) > 1 else image.mean(axis=2)
        rows = (values << 8).astype('<u2') if is_deep(encoding) else values.astype(np.uint8)
        step, data = rows.nbytes // height, rows.tobytes()
    message = Image(height=height, width=width, encoding=encoding, step=step)
    message.data = array.array('B', data)
    return message


def invalid_images(image):
    """One invalid image for each cause."""
    kinds = {
        kind: image_message(image, 0) for kind in ('cut off', 'encoding', 'depth', 'size', 'step')
    }
    kinds['cut off'].height = kinds['cut off'].step = 2**32 - 1
    kinds['encoding'].encoding = 'teleport8'
    kinds['depth'].encoding = '32FC1'
    kinds['size'].width = 0
    kinds['step'].step = 1
    return kinds


@pytest.fixture(scope='class')
def process(bench, start):
    process = start('-r', 'odom:=/wheels/odometry')
    bench.wait_for_node()
    yield process
    process.end()
    bench.wait_for_nobody()


class TestImages:
    """One node with the defaults; a test restores the parameters that it sets."""

    @pytest.mark.parametrize('encoding', [*CHANNELS, *BAYER, *YUV])
    def test_node_recognizes_raw_encoding(self, stream, route, encoding):
        """Without a reset: after five images there are only these in the window."""
        for image in route[30:35]:
            match = stream.show(encoded(image, encoding))
        assert (match.status, match.newest_index) == (MATCH, 34)

    def test_invalid_images_are_counted_and_explained_once_a_kind(
        self, bench, process, camera, route
    ):
        before = camera.counts('input')
        good = iter(range(20))
        for _ in range(2):
            for kind, message in invalid_images(route[0]).items():
                match = camera.show(message)
                assert match.status == INVALID, kind
                assert match.reason, kind
                assert match.place_index == match.newest_index == -1
                i = next(good)
                match = camera.show(route[i])
                assert match.status == (WARMING_UP if i < LENGTH - 1 else MATCH)
        assert match.newest_index == 9
        after = camera.counts('input')
        for kind in invalid_images(route[0]):
            key = f'dropped_invalid_{kind.replace(" ", "_")}'
            assert int(after[key]) == int(before.get(key, 0)) + 2, kind
            assert (
                process.output().count(f'logged once; /diagnostics counts "invalid: {kind}"') == 1
            ), kind
        bench.until_diagnosed('input', WARN, 'cut off 2')
        assert 'Traceback' not in process.output()

    def test_images_at_rest_do_not_fill_the_window(self, bench, camera, route):
        rng, change = np.random.default_rng(0), BY_NAME['keyframe_change'].default
        assert camera.show(route[20]).status == WARMING_UP
        for _ in range(100):
            noisy = np.clip(route[20] + rng.normal(0, 3, route[20].shape), 0, 255).astype(np.uint8)
            match = camera.show(noisy, SECOND // 10)
            assert match.status == SKIPPED
            assert f'less than {change:g}' in match.reason
        assert camera.counts('recognition')['window'] == '1'
        assert int(camera.counts('processing')['dropped_not_a_keyframe']) >= 100
        assert camera.statuses(route[21:25]) == 3 * [WARMING_UP] + [MATCH]
        assert bench.answers[-1].newest_index == 24
        camera.set(keyframe_change=0.0)
        camera.reset()
        assert camera.statuses(4 * [route[20]]) == 4 * [WARMING_UP]
        assert camera.counts('recognition')['window'] == '4'
        camera.set(keyframe_change=change)

    def test_keyframe_distance_and_angle_use_odometry(self, bench, camera, route):
        camera.set(keyframe_distance=1.0)
        match = camera.show(route[0])
        assert match.status == SKIPPED
        assert 'no odometry' in match.reason
        assert 'never' in bench.until_diagnosed('input', WARN, 'odometry').message
        assert int(camera.counts('input')['dropped_no_odometry']) >= 1
        wheels = bench.node.create_publisher(Odometry, '/wheels/odometry', 10)
        bench.until(lambda: wheels.get_subscription_count() > 0, 'the subscriber of odometry')

        def moved(meters, degrees=0.0):
            """Publish the next image with a pose, which is valid for half a second."""
            camera.stamp += SECOND
            odometry, half = Odometry(), np.radians(degrees) / 2
            odometry.header.stamp = Time(sec=camera.stamp // SECOND, nanosec=camera.stamp % SECOND)
            odometry.pose.pose.position.x = meters
            odometry.pose.pose.orientation.z, odometry.pose.pose.orientation.w = (
                np.sin(half),
                np.cos(half),
            )
            image = next(images)

            def known():  # the image may be faster, or the publisher not be matched yet
                wheels.publish(odometry)
                return 'no odometry' not in camera.show(image, 0).reason

            bench.until(known, 'odometry')
            return bench.answers[-1]

        images = iter(route)
        assert moved(5.0).status == WARMING_UP
        assert moved(5.4).reason == 'moved 0.400 m of 1 m since the last keyframe'
        assert moved(6.1).status == WARMING_UP
        assert moved(6.1, degrees=170).status == SKIPPED
        camera.set(keyframe_angle=30.0)
        assert moved(6.1, degrees=40).status == WARMING_UP
        match = moved(6.1, degrees=50)
        assert (
            match.reason
            == 'moved 0.000 m of 1 m and turned 10.00 of 30 degrees since the last keyframe'
        )
        assert camera.counts('recognition')['window'] == '3'
        assert 'no odometry' in camera.show(next(images), 3600 * SECOND).reason  # another clock

        def compared():
            wheels.publish(Odometry(header=Header(stamp=Time(sec=1))))
            message = bench.diagnostics['input'].message
            return 'without odometry at their stamps' in message

        bench.until(compared, 'a word on the stamps')
        bench.until_diagnosed('input', WARN, 'has stopped')
        camera.set(keyframe_distance=0.0, keyframe_angle=0.0)
        assert camera.show(next(images)).status == WARMING_UP
        bench.until(lambda: wheels.get_subscription_count() == 0, 'the end of the subscription')
        assert camera.counts('input')['odometry'] == 'not needed'
        bench.node.destroy_publisher(wheels)

    def test_incompatible_subscriber_is_logged(self, bench, process):
        requested = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        bench.listen(PlaceMatch, '/stavpr/match', requested)
        line = 'a subscriber of ~/match receives nothing: it requests another durability'
        bench.until(lambda: line in process.output(), 'the warning')

    def test_a_burst_of_large_images(self, bench, camera, route):
        """The middleware may report losses; every image that arrived gets one match."""
        before, count = camera.counts('input'), len(bench.answers)
        big = image_message(np.kron(route[0], np.ones((10, 10, 1), np.uint8)), camera.stamp)
        for _ in range(60):
            bench.publisher.publish(big)
        bench.ask_until_answered(image_message(route[1], camera.stamp + 1))
        after = camera.counts('input')
        received = int(after['received']) - int(before['received'])
        bench.until(lambda: len(bench.answers) - count == received, 'a match for every image')
        lost = int(after.get('dropped_lost_in_transport', 0)) - int(
            before.get('dropped_lost_in_transport', 0)
        )
        assert 0 <= lost <= 61 - received


@pytest.fixture(scope='class')
def compressed_process(start):
    process = start('-r', 'image:=/front/image', '-p', 'image_transport:=compressed')
    yield process
    process.end()


@pytest.fixture(scope='class')
def packed(bench, compressed_process):
    """Check the diagnostics without, with a raw, and with a silent publisher."""
    topic = '/front/image/compressed'  # below what `image` is remapped to
    message = bench.until_diagnosed('input', WARN, 'no publisher').message
    assert topic in message
    assert 'image:=TOPIC' in message
    raw = bench.node.create_publisher(Image, topic, qos_profile_sensor_data)
    bench.until_diagnosed(
        'input', ERROR, 'sensor_msgs/msg/Image is published there: compare image_transport'
    )
    bench.node.destroy_publisher(raw)
    publisher = bench.node.create_publisher(CompressedImage, topic, qos_profile_sensor_data)
    bench.until_diagnosed('input', WARN, 'there, but silent')
    camera = Camera(bench, publisher, CompressedImage)
    camera.connect()
    bench.until_diagnosed('input', ERROR, 'all images in the last 10 s were invalid')
    return camera


class TestCompressed:
    @pytest.mark.parametrize('suffix', ['.png', '.jpeg'])
    def test_compressed_images_are_recognized(self, packed, route, suffix):
        packed.reset()
        statuses = packed.statuses(compressed_message(image, 0, suffix) for image in route[40:46])
        assert statuses == 4 * [WARMING_UP] + 2 * [MATCH]
        assert packed.bench.answers[-1].newest_index == 45

    def test_invalid_compressed_images_are_counted(self, bench, packed, route):
        packed.reset()
        depth, short, text = (compressed_message(route[0], 0) for _ in range(3))
        depth.format = '16UC1; compressedDepth png'
        short.data = short.data[: len(short.data) // 2]
        text.data = array.array('B', b'not an image at all')
        for message, word in ((depth, 'compressedDepth'), (short, 'png'), (text, 'rgb8')):
            match = packed.show(message)
            assert match.status == INVALID
            assert word in match.reason
        assert packed.show(compressed_message(route[0], 0)).status == WARMING_UP
        bench.until_diagnosed('input', WARN, 'depth 1')


@pytest.fixture(scope='class')
def reliable_process(start):
    process = start(
        *('-p', 'qos_overrides./image.subscription.reliability:=reliable'),
        *('-p', 'qos_overrides./image.subscription.depth:=7'),
    )
    yield process
    process.end()


@pytest.fixture(scope='class')
def reliable(bench, reliable_process):
    """Return a reliable camera; the publisher of the bench is rejected."""
    message = bench.until_diagnosed('input', ERROR, 'refused for QoS').message
    remedy = (
        'set qos_overrides./image.subscription.reliability to best_effort, or make the publisher'
    )
    assert remedy in message
    assert (
        f'images are not received: a publisher of /image offers another reliability: {remedy}'
        in (reliable_process.output())
    )
    camera = Camera(bench, bench.node.create_publisher(Image, 'image', QoSProfile(depth=10)))
    camera.connect()
    yield camera
    bench.node.destroy_publisher(camera.publisher)


class TestQualityOfService:
    def test_incompatible_publisher_beside_a_compatible_one_is_reported(
        self, bench, reliable, route
    ):
        for image in route[:LENGTH]:
            # not received: there is one match only
            bench.publisher.publish(image_message(route[50], 1))
            match = reliable.show(image)
        assert (match.status, match.newest_index) == (MATCH, LENGTH - 1)

        def reported():
            reliable.show(route[LENGTH])
            status = bench.diagnostics['input']
            return (
                status.level == WARN
                and '1 publisher refused for QoS, while images of' in status.message
            )

        bench.until(reported, 'a warning')
        counts = reliable.counts('input')
        assert (counts['publishers'], counts['publishers_refused']) == ('2', '1')
        bench.node.destroy_publisher(bench.publisher)
        # the refused one is gone
        bench.until_diagnosed('input', WARN, '1 publisher there, but silent')
        assert reliable.counts('input')['publishers_refused'] == '0'
        bench.publish_anew()
        depth = bench.call(
            GetParameters, 'get_parameters', names=['qos_overrides./image.subscription.depth']
        )
        assert depth.values[0].integer_value == 7

    def test_qos_overrides_apply_to_one_topic_and_after_a_pause(self, bench, reliable, route):
        def offered(topic):
            return [
                s.qos_profile.reliability
                for s in bench.node.get_subscriptions_info_by_topic(topic)
            ]

        assert bench.transition('deactivate')
        assert bench.transition('activate')
        reliable.connect()
        assert reliable.show(route[0]).status == WARMING_UP
        assert offered('/image') == [ReliabilityPolicy.RELIABLE]
        reliable.set(keyframe_distance=1.0)
        bench.until(lambda: bool(offered('/odom')), 'the subscriber of odometry')
        assert offered('/odom') == [ReliabilityPolicy.BEST_EFFORT]


def test_durability_override_excludes_volatile_publishers(bench, start):
    process = start('-p', 'qos_overrides./image.subscription.durability:=transient_local')
    try:
        bench.until_diagnosed(
            'input', ERROR, 'qos_overrides./image.subscription.durability to volatile, or'
        )
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        camera = Camera(bench, bench.node.create_publisher(Image, 'image', latched))
        camera.connect()
        bench.node.destroy_publisher(camera.publisher)
    finally:
        process.end()


def test_invalid_qos_override_is_an_error(bench, start):
    process = start('-p', 'qos_overrides./image.subscription.reliability:=certain')
    try:
        bench.until_diagnosed('map', ERROR, 'correct qos_overrides./image.subscription')
        bench.until_state('unconfigured')
        assert 'certain' in process.output()
        assert 'Traceback' not in process.output()
    finally:
        process.end()
