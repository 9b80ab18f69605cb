# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time: rates, gaps and jumps of stamps, simulated time, bags that loop or pause."""

from builtin_interfaces.msg import Time
import pytest
from rclpy.qos import QoSProfile
from robot import image_message, SECOND
from rosgraph_msgs.msg import Clock
from stavpr_msgs.msg import PlaceMatch

WARMING_UP, MATCH, SKIPPED = PlaceMatch.WARMING_UP, PlaceMatch.MATCH, PlaceMatch.SKIPPED


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


def test_max_rate_skips_images_by_their_stamps(robot, start, route):
    start()
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


def test_max_rate_without_stamps_uses_arrival(robot, start, route):
    start()
    robot.set(max_rate=0.001)
    matches = [robot.ask(image_message(image, 0)) for image in route[:3]]
    assert [match.status for match in matches] == [WARMING_UP, SKIPPED, SKIPPED]
    robot.set(max_rate=5.0)
    late = image_message(route[3])
    robot.until(lambda: robot.ask(late).status == WARMING_UP, 'an image that is late enough')


def test_jump_back_of_stamps_resets_the_window(robot, start, route):
    start()
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


def test_gaps_are_counted_and_keep_the_window(robot, start, route):
    start(max_stamp_gap=2.0)
    robot.drive(route[:5])
    before = int(robot.counts('input')['gaps'])
    assert robot.show(route[5], 2 * SECOND).status == MATCH
    assert robot.show(route[6], 3 * SECOND).status == MATCH
    assert int(robot.counts('input')['gaps']) == before + 1
    robot.set(max_stamp_gap=0.5)
    assert robot.statuses(route[7:9]) == 2 * [MATCH]
    robot.show(route[9], SECOND // 2)
    assert int(robot.counts('input')['gaps']) == before + 3


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


def test_diagnostics_continue_while_the_simulated_clock_stands_still(robot, start, set_clock):
    start(use_sim_time=True)

    def stamps():  # one of an earlier node may arrive late
        return [array.header.stamp.sec for array in robot.arrays[-3:]]

    robot.until(lambda: stamps() == [0, 0, 0], 'diagnostics without a clock')
    set_clock(100)
    uptimes = [float(robot.counts('processing')['uptime_s']) for _ in range(3)]
    assert uptimes == sorted(set(uptimes))
    assert robot.arrays[-1].header.stamp == Time(sec=100)


def test_jump_back_of_the_simulated_clock_resets_the_window(robot, start, set_clock, route):
    """The stamps of the images go on."""
    start(use_sim_time=True)
    set_clock(1000)
    assert robot.statuses(route[:6]) == 4 * [WARMING_UP] + 2 * [MATCH]
    set_clock(5000)
    assert robot.show(route[6]).status == MATCH
    set_clock(4950)
    robot.until_logged('window reset: the clock jumped back by 50.000 s')
    assert robot.statuses(route[7:12])[::4] == [WARMING_UP, MATCH]
    assert robot.answers[-1].newest_index == 11
    assert robot.counts('input')['jumps_back'] == '0'
