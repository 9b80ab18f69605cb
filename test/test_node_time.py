# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time: rates, gaps and jumps of stamps, simulated time, bags that loop or pause."""

from builtin_interfaces.msg import Time
from camera import LENGTH, SECOND
from image_messages import image_message
import pytest
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from stavpr_msgs.msg import PlaceMatch

WARMING_UP, MATCH, SKIPPED = PlaceMatch.WARMING_UP, PlaceMatch.MATCH, PlaceMatch.SKIPPED


@pytest.fixture(scope='class')
def process(bench, start, request):
    """Run a node, with the options of the class."""
    process = start(*getattr(request.cls, 'OPTIONS', ()))
    bench.wait_for_node()
    yield process
    process.end()
    bench.wait_for_nobody()


class SimulationClock:
    """Publishes the time of a simulation, or of a bag."""

    def __init__(self, bench, camera):
        self.bench, self.arrays = bench, camera.diagnostics
        self.publisher = bench.node.create_publisher(Clock, '/clock', QoSProfile(depth=1))
        bench.until(lambda: self.publisher.get_subscription_count() > 0, 'a subscriber of /clock')

    def set(self, seconds):
        """Set the time until the node has it; from then on it stands still."""

        def there():
            self.publisher.publish(Clock(clock=Time(sec=seconds)))
            return bool(self.arrays) and self.arrays[-1].header.stamp.sec == seconds

        self.bench.until(there, f'{seconds} s')


class TestRates:
    def test_max_rate_skips_images(self, bench, camera, route):
        camera.set(max_rate=5.0)
        before = camera.counts('processing')
        statuses = camera.statuses((route[i % 60] for i in range(60)), SECOND // 30)
        assert [i for i, status in enumerate(statuses) if status != SKIPPED] == list(
            range(0, 60, 6)
        )
        assert 'exceeds max_rate = 5 Hz' in bench.answers[-1].reason
        dropped = int(camera.counts('processing')['dropped_max_rate'])
        assert dropped == int(before.get('dropped_max_rate', 0)) + 50
        camera.show(route[0])
        assert camera.show(route[1], -SECOND // 30).status == SKIPPED  # was overtaken on its way
        assert camera.show(route[2], SECOND // 10).status == SKIPPED
        assert camera.show(route[3], SECOND // 5).status != SKIPPED
        camera.set(max_rate=0.0)
        assert SKIPPED not in camera.statuses(route[10:20], SECOND // 30)

    def test_max_rate_without_stamps_uses_arrival(self, bench, camera, route):
        camera.set(max_rate=0.01)
        matches = [bench.ask(image_message(image, 0)) for image in route[:3]]
        assert [match.status for match in matches] == [WARMING_UP, SKIPPED, SKIPPED]
        camera.set(max_rate=5.0)
        late = image_message(route[3], 0)
        bench.until(lambda: bench.ask(late).status == WARMING_UP, 'an image that is late enough')
        camera.set(max_rate=0.0)
        assert bench.ask(image_message(route[4], 0)).status == WARMING_UP

    def test_keyframe_interval_skips_images(self, bench, camera, route):
        camera.set(keyframe_interval=1.0)
        statuses = camera.statuses(route[:9], SECOND // 4)
        assert [i for i, status in enumerate(statuses) if status == WARMING_UP] == [0, 4, 8]
        assert (
            camera.show(route[9], SECOND // 2).reason
            == '0.500 s after the last keyframe: less than 1 s'
        )
        camera.set(keyframe_interval=0.0)
        assert camera.show(route[10], 1).status == WARMING_UP
        assert camera.counts('recognition')['window'] == '4'


class TestStamps:
    def test_a_jump_back_of_stamps_resets_the_window(self, bench, process, camera, route):
        before = camera.counts('input')
        assert camera.statuses(route[:6]) == 4 * [WARMING_UP] + 2 * [MATCH]
        assert camera.show(route[6], -60 * SECOND).status == WARMING_UP
        assert camera.statuses(route[7:11]) == 3 * [WARMING_UP] + [MATCH]
        assert bench.answers[-1].newest_index == 10
        first = bench.answers[-1].window_first
        assert first.sec * SECOND + first.nanosec == camera.stamp - 4 * SECOND
        after = camera.counts('input')
        assert int(after['jumps_back']) == int(before['jumps_back']) + 1
        assert after['longest_jump_back_s'] == '60.000'
        line = 'window reset: the stamps of the images jumped back by 60.000 s'
        assert process.output().count(line) == 1

    def test_images_out_of_order_are_no_jump(self, camera, route):
        before = camera.counts('input')
        camera.statuses(route[:5])
        assert camera.show(route[5], -SECOND // 20).status == MATCH
        assert camera.show(route[6], SECOND // 10).status == MATCH
        after = camera.counts('input')
        assert after['jumps_back'] == before['jumps_back']

    def test_gaps_are_counted_and_keep_the_window(self, camera, route):
        camera.statuses(route[:5])
        before = int(camera.counts('input')['gaps'])
        assert camera.show(route[5], 2 * SECOND).status == MATCH
        assert camera.show(route[6], 3 * SECOND).status == MATCH
        after = camera.counts('input')
        assert int(after['gaps']) == before + 1
        camera.set(max_stamp_gap=0.5)
        assert camera.statuses(route[7:9], SECOND) == 2 * [MATCH]
        camera.show(route[9], SECOND // 2)
        assert int(camera.counts('input')['gaps']) == before + 3
        camera.set(max_stamp_gap=2.0)

    def test_images_without_stamps_are_matched(self, bench, camera, route):
        before = camera.counts('input')
        matches = [bench.ask(image_message(image, 0)) for image in route[20:26]]
        assert [match.status for match in matches] == 4 * [WARMING_UP] + 2 * [MATCH]
        assert matches[-1].newest_index == 25
        assert matches[-1].window_first == matches[-1].window_last == Time()
        assert camera.show(route[26]).status == MATCH
        after = camera.counts('input')
        assert (after['gaps'], after['jumps_back']) == (before['gaps'], before['jumps_back'])

    def test_a_change_of_use_sim_time_keeps_the_window(self, bench, process, camera, route):
        camera.statuses(route[:LENGTH])
        camera.set(use_sim_time=True)
        clock = SimulationClock(bench, camera)
        clock.set(50)
        assert camera.show(route[5]).status == MATCH
        camera.set(use_sim_time=False)
        assert camera.show(route[6]).status == MATCH
        assert camera.counts('input')['rate_in_hz'] != '0.000'
        assert 'the clock jumped' not in process.output()
        bench.node.destroy_publisher(clock.publisher)


class TestSimulatedTime:
    """With ``/clock``, from the start; it stands still wherever a test does not set it."""

    OPTIONS = ('-p', 'use_sim_time:=true')

    def test_diagnostics_continue_without_a_clock_and_while_it_stands_still(
        self, bench, process, camera
    ):
        arrays = camera.diagnostics
        bench.until(lambda: len(arrays) >= 3, 'diagnostics without a clock')
        assert [array.header.stamp for array in arrays[:3]] == 3 * [Time()]
        clock = SimulationClock(bench, camera)
        clock.set(100)
        before = len(arrays)
        bench.until(lambda: len(arrays) >= before + 5, 'diagnostics while the clock stands still')
        assert {array.header.stamp.sec for array in arrays[before:]} == {100}
        uptimes = [self.value(array, 'processing', 'uptime_s') for array in arrays[before:]]
        assert uptimes == sorted(set(uptimes))
        bench.node.destroy_publisher(clock.publisher)

    def test_a_jump_back_of_the_clock_resets_the_window(self, bench, process, camera, route):
        """The images' own stamps go on."""
        clock = SimulationClock(bench, camera)
        clock.set(1000)
        assert camera.statuses(route[:6]) == 4 * [WARMING_UP] + 2 * [MATCH]
        clock.set(5000)
        assert camera.show(route[6]).status == MATCH
        clock.set(4950)
        assert 'window reset: the clock jumped back by 50.000 s' in process.output()
        assert camera.statuses(route[7:12]) == 4 * [WARMING_UP] + [MATCH]
        assert bench.answers[-1].newest_index == 11
        clock.set(4951)
        assert camera.show(route[12]).status == MATCH
        assert self.value(camera.diagnostics[-1], 'input', 'jumps_back') == 0
        bench.node.destroy_publisher(clock.publisher)

    @staticmethod
    def value(array, part, key):
        found = [status for status in array.status if status.name.endswith(part)]
        return next(float(pair.value) for pair in found[0].values if pair.key == key)
