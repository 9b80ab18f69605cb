# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node over ROS: images in, matches out; parameters that change meanwhile."""

import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from robot import image_message, LENGTH, SECOND
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceCandidates, PlaceMatch
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.ros import output
from stavpr_ros.ros.messages import nanoseconds
from std_msgs.msg import Float32, Int32

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
        if message.status == PlaceMatch.MATCH:
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
    assert (match.status, match.newest_index) == (PlaceMatch.MATCH, 45)


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
    assert {PlaceMatch.WARMING_UP, PlaceMatch.SKIPPED} <= statuses


def test_node_draws_match_images_for_a_subscriber_only(robot, start, route, monkeypatch):
    calls, draw = [], output.draw_match
    monkeypatch.setattr(output, 'draw_match', lambda *args: calls.append(args) or draw(*args))
    start()
    robot.drive(route[:4])
    assert calls == []
    drawn = robot.listen(Image, '/stavpr/match_image')

    def received():
        robot.show(route[4])
        return bool(drawn)

    robot.until(received, 'an image')
    match = robot.drive(route[5:10])[-1]
    robot.until(lambda: drawn[-1].header == match.header, 'the last image')
    image = np.frombuffer(drawn[-1].data, np.uint8).reshape(drawn[-1].height, -1, 3)
    np.testing.assert_array_equal(image[14:96, :128], route[9][14:])  # below the label


def test_node_with_the_name_of_another_logs_it(robot, start):
    start()
    other = rclpy.create_node('stavpr', context=robot.context)
    try:
        robot.until_logged('another node is named /stavpr, and its matches are on the same')
    finally:
        other.destroy_node()


def test_node_with_an_incompatible_subscriber_logs_it(robot, start):
    start()
    requested = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.listen(PlaceMatch, '/stavpr/match', requested)
    robot.until_logged('a subscriber of ~/match receives nothing: it requests another durability')
