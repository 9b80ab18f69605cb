# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node over ROS: images in, matches out, parameters, its clock, its subscriptions."""

import array
import threading

from builtin_interfaces.msg import Time
import cv2
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from robot import image_message, LENGTH, RELIABLE, SECOND
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image
from stavpr_msgs.msg import PlaceCandidates, PlaceMatch
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.ros import output
from stavpr_ros.ros.messages import nanoseconds
from std_msgs.msg import Float32, Header, Int32
from std_srvs.srv import Trigger

WARMING_UP, MATCH, SKIPPED = PlaceMatch.WARMING_UP, PlaceMatch.MATCH, PlaceMatch.SKIPPED
THRESHOLD = 0.2
PAPER = {'mode': 'paper', 'threshold': THRESHOLD}


def recognize(place_map, images):
    """Return the matches of the library."""
    settings = RecognizerSettings(
        THRESHOLD, sequence=SequenceSettings(LENGTH), nms_radius=5, mode='paper'
    )
    recognizer, extractor = PlaceRecognizer(place_map, settings), place_map.extractor()
    return [recognizer.update(extractor.extract([image])) for image in images]


def same_match(message, core):
    """Features may differ in the last bits."""
    assert message.status == core.status
    assert (message.place_index, message.newest_index) == (core.place, core.newest)
    path = [(pair.query_index, pair.place_index) for pair in message.path]
    assert path == [tuple(cell) for cell in core.path.pairs.tolist()]
    assert message.distance == pytest.approx(core.distance, abs=1e-4, nan_ok=True)


def test_node_publishes_the_matches_of_the_library(robot, start, small_map, route):
    """And candidates of every window, plain topics for accepted matches."""
    start(**PAPER, candidates=3)
    places = robot.listen(Int32, '/stavpr/place_index')
    distances = robot.listen(Float32, '/stavpr/distance')
    candidates = robot.listen(PlaceCandidates, '/stavpr/candidates')
    robot.until(lambda: robot.node.count_publishers('/stavpr/candidates') > 0, 'the topics')
    rng = np.random.default_rng(0)
    images = route[20:34] + [rng.integers(0, 256, (96, 128, 3), np.uint8) for _ in range(6)]
    cores = recognize(small_map, images)
    windows, matches = [], []
    for image, core in zip(images, cores, strict=True):
        bgr = image_message(image, encoding='bgr8')
        message = robot.show(bgr, SECOND + 7)
        same_match(message, core)
        if core.path.place >= 0:
            windows.append(message)
        if message.status == MATCH:
            matches.append(message)
    assert 10 <= len(matches) < len(images) - LENGTH + 1
    robot.until(lambda: len(places) == len(distances) == len(matches), 'the plain topics')
    assert [place.data for place in places] == [match.place_index for match in matches]
    assert [distance.data for distance in distances] == [match.distance for match in matches]
    robot.until(lambda: len(candidates) == len(windows), 'the candidates')
    assert {len(listed.candidates) for listed in candidates} == {3}


def test_node_after_a_burst_has_one_match_for_each_image(robot, start, route):
    """Every image is processed or dropped, oldest first, and the node goes on."""
    start(**PAPER, queue_size=2)
    key = 'dropped_queue_full'
    before, count = len(robot.answers), 40
    counted = int(robot.counts('processing').get(key, 0))
    big = [np.kron(image, np.ones((5, 5, 1), np.uint8)) for image in route[:count]]
    messages = [image_message(image, 100 + i) for i, image in enumerate(big)]
    for message in messages:
        robot.publisher.publish(message)
    robot.until(lambda: len(robot.answers) == before + count, 'a match for each image')
    matches = sorted(robot.answers[before:], key=lambda match: match.header.stamp.nanosec)
    assert [match.header for match in matches] == [message.header for message in messages]
    dropped = [match for match in matches if match.status == PlaceMatch.DROPPED]
    assert {match.reason for match in dropped} == {'newer images arrived before it was processed'}
    assert matches[-1].status != PlaceMatch.DROPPED  # the newest
    assert int(robot.counts('processing').get(key, 0)) - counted == len(dropped)
    match = robot.drive(route[40:46])[-1]
    assert (match.status, match.newest_index) == (MATCH, 45)


def test_node_with_changing_parameters_publishes_one_match_per_image(robot, start, route):
    start(queue_size=1000)
    before, count, futures = len(robot.answers), 60, []
    changes = [
        ('min_probability', (0.1, 0.3)),
        ('max_rate', (10.0, 0.0)),
        ('verbosity', ('warn', 'info')),
    ]
    first = []
    with robot.request(
        first, SetParameters, 'set_parameters', lambda: any(f.done() for f in first)
    ) as client:
        for i in range(count):
            robot.publisher.publish(image_message(route[i], SECOND + i * SECOND // 30))
            name, values = changes[i % 3]
            value = Parameter(name, value=values[i // 3 % 2]).to_parameter_msg()
            futures.append(client.call_async(SetParameters.Request(parameters=[value])))
            robot.until(lambda: all(future.done() for future in futures[:-3]), 'earlier changes')
        robot.until(lambda: all(future.done() for future in futures), 'all changes')
    robot.until(lambda: len(robot.answers) == before + count, 'a match for each image')
    assert all(result.successful for future in futures for result in future.result().results)
    stamps = [nanoseconds(match.header.stamp) for match in robot.answers[before:]]
    assert sorted(stamps) == [SECOND + i * SECOND // 30 for i in range(count)]
    statuses = {match.status for match in robot.answers[before:]}
    assert {WARMING_UP, PlaceMatch.SKIPPED} <= statuses


def test_node_with_the_name_of_another_logs_it(robot, start):
    start()
    other = rclpy.create_node('stavpr', context=robot.context)
    try:
        robot.until_logged('another node is named /stavpr, and its matches are on the same')
    finally:
        other.destroy_node()


# simulated time


@pytest.fixture
def set_clock(robot):
    """Publish the time of a simulation until the node has it; from then on it stands still."""
    publisher = robot.node.create_publisher(Clock, '/clock', QoSProfile(depth=1))

    def set_clock(seconds):
        def there():
            publisher.publish(Clock(clock=Time(sec=seconds)))
            return bool(robot.arrays) and robot.arrays[-1].header.stamp.sec == seconds

        robot.until(lambda: publisher.get_subscription_count() > 0, 'a subscriber of /clock')
        robot.until(there, f'{seconds} s')

    yield set_clock
    robot.node.destroy_publisher(publisher)


def test_change_of_use_sim_time_keeps_the_window(robot, start, set_clock, route):
    start()
    robot.drive(route[:5])
    robot.set(use_sim_time=True)
    set_clock(50)
    assert robot.show(route[5]).status == MATCH
    robot.set(use_sim_time=False)
    assert robot.show(route[6]).status == MATCH
    assert robot.counts('input')['rate_in_hz'] != '0.000'
    assert not [line for line in robot.log if 'the clock jumped' in line]


def test_simulated_clock_stands_still_and_jumps_back(robot, start, set_clock, route):
    """Diagnostics continue; a jump resets the window, though the stamps of the images go on."""
    start(use_sim_time=True)

    def stamps():  # one of an earlier node may arrive late
        return [array.header.stamp.sec for array in robot.arrays[-3:]]

    robot.until(lambda: stamps() == [0, 0, 0], 'diagnostics without a clock')
    set_clock(100)
    uptimes = [float(robot.counts('processing')['uptime_s']) for _ in range(3)]
    assert uptimes == sorted(set(uptimes))
    assert robot.arrays[-1].header.stamp == Time(sec=100)
    set_clock(1000)
    assert robot.statuses(route[:6]) == 3 * [WARMING_UP] + 3 * [MATCH]
    set_clock(5000)
    assert robot.show(route[6]).status == MATCH
    set_clock(4950)
    robot.until_logged('window reset: the clock jumped back by 50.000 s')
    assert robot.statuses(route[7:12])[::4] == [WARMING_UP, MATCH]
    assert robot.answers[-1].newest_index == 11
    assert robot.counts('input')['jumps_back'] == '0'


# Subscriptions of the node: transports, invalid images, odometry, QoS

WARN, ERROR = DiagnosticStatus.WARN, DiagnosticStatus.ERROR
INVALID = PlaceMatch.INVALID_IMAGE
RELIABILITY = 'qos_overrides./image.subscription.reliability'


@pytest.fixture
def publish(robot, request):
    """Make a publisher of images; it is destroyed with the test."""

    def publish(kind, topic, qos=qos_profile_sensor_data):
        publisher = robot.node.create_publisher(kind, topic, qos)
        request.addfinalizer(lambda: robot.node.destroy_publisher(publisher))
        return publisher

    return publish


@pytest.fixture
def stranger(context):
    """Return a node of another participant: in each, a topic has one type."""
    node = rclpy.create_node('stranger', context=context)
    yield node
    node.destroy_node()


def test_keyframes_by_distance_and_angle_use_odometry(robot, start, route):
    """On a topic with another name; poses are valid for half a second."""
    off = {'relative_pose': 'none', 'odometry_error': 0.0}
    start('-r', 'odom:=/odom', '-r', 'image:=/image', keyframe_distance=1.0, **off)
    match = robot.show(route[0])
    assert (match.status, 'no odometry' in match.reason) == (SKIPPED, True)
    assert 'never' in robot.until_diagnosed('input', WARN, 'odometry').message
    robot.until(lambda: robot.odometry.get_subscription_count() > 0, 'a subscriber of odometry')
    assert robot.show_at(5.0, route[1]).status == WARMING_UP
    assert robot.show_at(5.4, route[2]).status == SKIPPED
    assert robot.show_at(6.1, route[3]).status in (WARMING_UP, MATCH)
    assert robot.show_at(6.1, route[4], degrees=170).status == SKIPPED
    robot.set(keyframe_angle=30.0)  # its earlier name
    robot.until_logged("parameter 'keyframe_angle' is keyframe_angle_deg now")
    assert robot.show_at(6.1, route[5], degrees=40).status in (WARMING_UP, MATCH)
    assert 'no odometry' in robot.show(route[7], 3600 * SECOND).reason  # another clock

    def is_compared():
        robot.odometry.publish(Odometry(header=Header(stamp=Time(sec=1))))
        return 'without odometry at their stamps' in robot.diagnostics['input'].message

    robot.until(is_compared, 'a remark on the stamps')
    robot.until_diagnosed('input', WARN, 'has stopped')
    robot.set(keyframe_distance=0.0, keyframe_angle_deg=0.0)
    robot.until(lambda: not robot.odometry.get_subscription_count(), 'the end of odometry')


def test_a_rule_that_skips_every_image_is_a_warning_and_so_is_the_missing_map(robot, start, route):
    """By the stamps, in a replay that is faster; once for each such stretch."""
    start(map_path='', operation='mapping', keyframe_distance=0.5)
    robot.drive(route[:8])
    robot.until_logged('every image is skipped: no odometry for this image')
    assert sum('every image is skipped' in line for line in robot.log) == 1
    assert robot.transition('deactivate')
    robot.until_logged('no map written, because none of')


def test_wrongly_remapped_odometry_and_a_covered_lens_are_diagnosed(
    robot, start, publish, stranger, route
):
    """The topic with odometry is named, no topic of a pose graph; one of another type too."""
    publish(Odometry, '/pose_graph/odometry')
    publish(TransformStamped, '/pose_graph/map_to_odom')
    start('-r', 'odom:=/wheel', keyframe_distance=1.0)
    message = 'nothing is published on /wheel, odometry is on /odom: remap odom'
    robot.until_diagnosed('input', WARN, message)
    stranger.create_publisher(Image, '/wheel', 1)
    robot.until_diagnosed('input', WARN, 'sensor_msgs/msg/Image is published on /wheel, odometry')
    robot.set(keyframe_distance=0.0)
    robot.show(np.full_like(route[0], 200))
    robot.until_diagnosed('input', WARN, 'the images show nothing (standard deviation 0.0 of 255)')


def test_compressed_images_on_a_remapped_topic_are_recognized(
    robot, start, publish, stranger, route
):
    """The topic is below the one that `image` is remapped to; the diagnostics name it."""
    start('-r', 'image:=/front/image', wait=False, image_transport='compressed')
    topic = '/front/image/compressed'
    assert topic in robot.until_diagnosed('input', WARN, 'no publisher').message
    raw = stranger.create_publisher(Image, topic, 1)
    mistyped = 'sensor_msgs/msg/Image is published there: compare image_transport'
    robot.until_diagnosed('input', ERROR, mistyped)
    stranger.destroy_publisher(raw)
    camera = publish(CompressedImage, topic)
    robot.wait_for_node(camera, CompressedImage)

    def show(data):
        message = CompressedImage(format='rgb8; jpeg compressed bgr8', data=array.array('B', data))
        return robot.show(message, publisher=camera)

    match = show(b'not an image at all')
    assert (match.status, 'rgb8' in match.reason) == (INVALID, True)
    matches = [show(cv2.imencode('.jpeg', image[:, :, ::-1])[1]) for image in route[40:46]]
    assert [match.status for match in matches] == 4 * [WARMING_UP] + 2 * [MATCH]
    assert matches[-1].newest_index == 45


def test_incompatible_publishers_are_reported(robot, start, publish, route):
    """Alone, beside a compatible one, and no longer when they are gone."""
    start(wait=False, **{RELIABILITY: 'reliable'})
    unreliable = publish(Image, 'image')
    robot.node.destroy_publisher(robot.publisher)
    remedy = f'remove {RELIABILITY}, or make the publisher reliable'
    offers = f'a publisher of /image offers another reliability: {remedy}'
    robot.until_diagnosed('input', ERROR, f'1 publisher refused for QoS: {offers}')
    robot.until_logged(f'images are not received: {offers}')
    robot.publisher = robot.node.create_publisher(Image, 'image', RELIABLE)
    robot.wait_for_node()

    def is_reported():
        robot.show(route[0])
        warning = '1 publisher refused for QoS, while images of others arrive'
        return warning in robot.diagnostics['input'].message

    robot.until(is_reported, 'a warning')
    assert robot.counts('input')['publishers_refused'] == '1'
    robot.node.destroy_publisher(unreliable)
    robot.until(lambda: robot.counts('input')['publishers_refused'] == '0', 'no refusal')


def test_durability_override_excludes_volatile_publishers(robot, start, publish):
    durability = 'qos_overrides./image.subscription.durability'
    start(wait=False, **{durability: 'transient_local'})
    robot.until_diagnosed('input', ERROR, f'{durability} to volatile, or')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.wait_for_node(publish(Image, 'image', latched))


def test_invalid_qos_override_is_an_error(robot, start):
    start(wait=False, **{RELIABILITY: 'certain'})
    robot.until_diagnosed('map', ERROR, 'correct qos_overrides./image.subscription')
    robot.until_state('unconfigured')
    robot.until_logged('certain')


# One node for the tests below: rates, gaps and jumps of stamps, invalid images, its neighbors


def test_max_rate_skips_images_by_their_stamps(robot, running, route):
    robot.set(max_rate=5.0)  # probes would be skipped, and overtake others
    before = robot.counts('processing')
    statuses = robot.statuses(route, SECOND // 30)
    assert [i for i, status in enumerate(statuses) if status != SKIPPED] == list(range(0, 60, 6))
    assert 'exceeds max_rate = 5 Hz' in robot.answers[-1].reason
    dropped = int(robot.counts('processing')['dropped_max_rate'])
    assert dropped - int(before.get('dropped_max_rate', 0)) == 50
    robot.show(route[0])
    assert robot.show(route[1], -SECOND // 30).status == SKIPPED  # was overtaken on its way
    robot.set(max_rate=0.0)
    assert SKIPPED not in robot.statuses(route[10:20], SECOND // 30)


def test_max_rate_without_stamps_uses_arrival(robot, running, route):
    robot.set(max_rate=0.001)
    matches = [robot.ask(image_message(image, 0)) for image in route[:3]]
    assert [match.status for match in matches] == [WARMING_UP, SKIPPED, SKIPPED]
    robot.set(max_rate=5.0)
    late = image_message(route[3])
    robot.until(lambda: robot.ask(late).status == WARMING_UP, 'an image that is late enough')


def test_jump_back_of_stamps_resets_the_window(robot, running, route):
    before = robot.counts('input')
    assert robot.statuses(route[:5])[-1] == MATCH
    assert robot.show(route[5], -SECOND // 20).status == MATCH  # out of order is no jump
    assert robot.show(route[6], -60 * SECOND).status == WARMING_UP
    assert robot.statuses(route[7:11])[-1] == MATCH
    assert robot.answers[-1].newest_index == 10
    after = robot.counts('input')
    assert int(after['jumps_back']) == int(before['jumps_back']) + 1
    assert after['longest_jump_back_s'] == '60.050'
    line = 'window reset: the stamps of the images jumped back by 60.050 s'
    assert robot.log.count(line) == 1


def test_gaps_are_counted_and_keep_the_window(robot, running, route):
    robot.set(max_stamp_gap=2.0)
    robot.drive(route[:5])
    before = int(robot.counts('input')['gaps'])
    assert robot.show(route[5], 2 * SECOND).status == MATCH
    assert robot.show(route[6], 3 * SECOND).status == MATCH
    assert int(robot.counts('input')['gaps']) == before + 1
    robot.set(max_stamp_gap=0.5)
    assert robot.statuses(route[7:9]) == 2 * [MATCH]
    robot.show(route[9], SECOND // 2)
    assert int(robot.counts('input')['gaps']) == before + 3


def test_invalid_images_are_counted_and_explained_once_a_cause(robot, running, route):
    invalid = {kind: image_message(route[0]) for kind in ('cut off', 'encoding', 'depth')}
    invalid['cut off'].height = 10**6
    invalid['encoding'].encoding = 'teleport8'
    invalid['depth'].encoding = '32FC1'
    before = robot.counts('input')
    for i in range(2):
        for kind, message in invalid.items():
            match = robot.show(message)
            assert (match.status, bool(match.reason)) == (PlaceMatch.INVALID_IMAGE, True), kind
        matches = robot.drive(route[3 * i : 3 * i + 3])
    assert [match.status for match in matches] == 3 * [MATCH]  # the window was kept
    assert matches[-1].newest_index == 5
    robot.until_diagnosed('input', DiagnosticStatus.WARN, 'cut off 2')
    after = robot.counts('input')
    for kind in invalid:
        key = f'dropped_invalid_{kind.replace(" ", "_")}'
        assert int(after[key]) == int(before.get(key, 0)) + 2
        line = f'logged once; /diagnostics counts "invalid: {kind}"'
        assert sum(line in text for text in robot.log) == 1


def test_requests_of_many_clients_wait_and_all_get_a_response(robot, running):
    """200 at once, while the first one takes long."""
    end = threading.Event()
    client = robot.node.create_client(Trigger, '/stavpr/reset', qos_profile=QoSProfile(depth=1000))
    try:
        robot.does(Trigger, 'reset')
        robot.until(client.service_is_ready, 'the service')
        robot.until(client.call_async(Trigger.Request()).done, 'the first response')
        running.runtime.worker.call(end.wait)
        responses = [client.call_async(Trigger.Request()) for _ in range(200)]
        end.set()
        robot.until(lambda: all(response.done() for response in responses), 'all responses')
    finally:
        end.set()
        robot.node.destroy_client(client)


def test_node_draws_match_images_for_a_subscriber_only(robot, running, route, monkeypatch):
    calls, draw = [], output.draw_match
    monkeypatch.setattr(output, 'draw_match', lambda *args: calls.append(args) or draw(*args))
    robot.drive(route[:4])
    assert calls == []
    drawn = robot.listen(Image, '/stavpr/match_image')

    def is_received():
        robot.show(route[4])
        return bool(drawn)

    robot.until(is_received, 'an image')
    match = robot.drive(route[5:10])[-1]
    robot.until(lambda: drawn[-1].header == match.header, 'the last image')
    image = np.frombuffer(drawn[-1].data, np.uint8).reshape(drawn[-1].height, -1, 3)
    np.testing.assert_array_equal(image[14:96, :128], route[9][14:])  # below the label


def test_node_logs_an_incompatible_subscriber_and_lost_images_once(robot, running):
    requested = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.listen(PlaceMatch, '/stavpr/match', requested)
    robot.until_logged('a subscriber of ~/match receives nothing: it requests another durability')
    running.statistics.add_drop('lost in transport', 3)
    line = '3 images lost in transport in the last 10 s: '
    robot.until_logged(line)
    robot.counts('input')  # of two more reports
    assert sum(line in text for text in robot.log) == 1
