# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One node for all tests: rates, gaps and jumps of stamps, invalid images, its neighbors."""

import threading

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile
from robot import image_message, SECOND
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.ros import output
from std_srvs.srv import Trigger

WARMING_UP, MATCH, SKIPPED = PlaceMatch.WARMING_UP, PlaceMatch.MATCH, PlaceMatch.SKIPPED


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
        robot.until(lambda: all(each.done() for each in responses), 'all responses')
    finally:
        end.set()
        robot.node.destroy_client(client)


def test_node_draws_match_images_for_a_subscriber_only(robot, running, route, monkeypatch):
    calls, draw = [], output.draw_match
    monkeypatch.setattr(output, 'draw_match', lambda *args: calls.append(args) or draw(*args))
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


def test_node_logs_an_incompatible_subscriber_and_lost_images_once(robot, running):
    requested = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.listen(PlaceMatch, '/stavpr/match', requested)
    robot.until_logged('a subscriber of ~/match receives nothing: it requests another durability')
    running.statistics.add_drop('lost in transport', 3)
    line = '3 images lost in transport in the last 10 s: '
    robot.until_logged(line)
    robot.counts('input')  # of two more reports
    assert sum(line in text for text in robot.log) == 1
