# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node over ROS: images in, matches out; parameters that change meanwhile; its clock."""

from builtin_interfaces.msg import Time
import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from robot import image_message, LENGTH, SECOND
from rosgraph_msgs.msg import Clock
from stavpr_msgs.msg import PlaceCandidates, PlaceMatch
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.ros.messages import nanoseconds
from std_msgs.msg import Float32, Int32

WARMING_UP, MATCH = PlaceMatch.WARMING_UP, PlaceMatch.MATCH
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
