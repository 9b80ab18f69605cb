# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The control law: velocities by place, corrections and their signs, limits, stops."""

import math

import numpy as np
import pytest
from stavpr_nav import follower
from stavpr_nav.follower import FollowerSettings, RouteFollower, TaughtRun
from stavpr_nav.observation import Observation
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.relative_pose.offset import Offset

STEP = 0.05
STRAIGHT = Offset(0.0, 0.01, 0.0, 1e6, 0.6)
COVERED = Offset(0.0, 0.01, 0.0, 1.0, 0.0)
FAST = FollowerSettings(max_acceleration=1e3, max_turn_acceleration=1e3, max_turn=5.0)


def taught(n=100, speed=0.8, turn=0.1, **changes):
    return TaughtRun(np.arange(n) * 0.5, np.full(n, speed), np.full(n, turn), **changes)


class Run:
    """A follower with images at 5 Hz, at the places that it repeats."""

    def __init__(self, settings=FAST, run=None):
        self.run = run or taught()
        self.follower, self.time, self.place = RouteFollower(self.run, settings), 0.0, 0.0

    def drive(self, seconds, offset=STRAIGHT, probability=1.0, images=True, place=None):
        """Return the commands of some seconds."""
        commands = []
        for k in range(round(seconds / STEP)):
            if images and k % 4 == 0:
                shown = int(self.place) if place is None else place
                self.follower.observe(
                    Observation(self.time, shown, probability, offset), self.time
                )
            commands.append(self.follower.command(self.time))
            self.place += commands[-1].speed / self.run.speeds[0] * STEP / 0.5
            self.place %= len(self.run.times)
            self.time += STEP
        return commands


def test_taught_velocities_are_repeated_from_third_image_on():
    commands = Run().drive(3)
    moving = [command.speed > 0 for command in commands]
    assert moving == [False] * 8 + [True] * (len(commands) - 8)
    assert (commands[-1].speed, commands[-1].turn) == pytest.approx((0.8, 0.1))
    assert commands[0].reason == 'waiting for more images of the route'
    assert commands[-1].reason == ''


@pytest.fixture
def proportional(monkeypatch):
    """Leave out the integral of the law."""
    monkeypatch.setattr(follower, 'INTEGRAL', 1e9)


@pytest.mark.usefixtures('proportional')
@pytest.mark.parametrize('offset', [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.02), (0.0, -0.02)])
def test_robot_turned_or_offset_to_the_left_steers_to_the_right(offset):
    shift, parallax = offset
    command = Run().drive(2, Offset(shift, 0.01, parallax, 1e6, 0.6))[-1]
    expected = 0.1 - FAST.gain * 0.8 * (shift + FAST.parallax_weight * parallax)
    assert command.turn == pytest.approx(expected)


@pytest.mark.usefixtures('proportional')
def test_correction_is_bounded():
    turns = [Run().drive(2, Offset(shift, 0.01, 0, 1e6, 0.6))[-1].turn for shift in (0.25, 0.45)]
    assert turns[0] == turns[1] == pytest.approx(0.1 - FAST.gain * 0.8 * 0.2)


def test_speed_falls_with_certainty():
    speeds = [Run().drive(2, probability=p)[-1].speed for p in (0.99, 0.7, 0.51)]
    assert speeds == pytest.approx([0.8, 0.4, 0.24])
    ambiguous = Run().drive(2, Offset(0.1, 0.01, 0, 2.0, 0.6))[-1]
    assert (ambiguous.speed, ambiguous.turn) == pytest.approx((0.4, 0.05))  # no correction


def test_speeds_and_accelerations_are_limited():
    settings = FollowerSettings(max_speed=0.5, max_turn=0.2, max_acceleration=0.4)
    run = Run(settings, taught(speed=2.0, turn=3.0))
    commands = run.drive(5)
    speeds, turns = (np.array([getattr(c, name) for c in commands]) for name in ('speed', 'turn'))
    assert speeds.max() == pytest.approx(0.5)
    assert turns.max() == pytest.approx(0.2)
    assert np.diff(speeds).max() <= 0.4 * STEP + 1e-9
    assert np.diff(turns).max() <= STEP + 1e-9


def test_robot_stops_half_a_second_after_last_image():
    run = Run()
    run.drive(2)
    commands = run.drive(1, images=False)
    stopped = next(k for k, command in enumerate(commands) if command.speed == 0)
    assert stopped * STEP <= 0.5
    assert commands[-1].reason == 'no new image'
    assert commands[-1].turn == 0


def test_images_that_arrive_too_late_stop_the_robot():
    run = Run()
    run.drive(2)
    run.follower.observe(Observation(run.time - 1.2, 4, 1.0, STRAIGHT), run.time)
    assert run.follower.command(run.time).reason == 'no new image'


@pytest.mark.parametrize('change', [{'offset': COVERED}, {'offset': None}, {'place': -1}])
def test_first_image_that_is_not_of_the_route_stops_the_robot(change):
    run = Run()
    run.drive(2)
    commands = run.drive(1, **change)
    assert {command.speed for command in commands} == {0}
    assert commands[0].reason == 'the newest image is not of the route'
    assert commands[-1].reason == 'not localized on the route'
    assert run.drive(2)[-1].speed == pytest.approx(0.8)  # it goes on


def test_place_that_does_not_change_stops_the_robot():
    run = Run()
    run.drive(2)
    commands = run.drive(6, place=3)
    assert commands[-1].reason == follower.NO_EVIDENCE
    assert sum(command.speed for command in commands) * STEP < 0.4 + 3 * 0.8 * 0.2


@pytest.mark.parametrize('similarity', [0.6, 0.2])
def test_start_without_match_needs_images_like_the_expected_places(similarity):
    run, offset = Run(), Offset(0.0, 0.01, 0.0, 1e6, similarity)
    assert run.follower.expected_place() == -1
    run.follower.start(5)
    places, moved = [], 0.0
    for _ in range(100):  # at .3 m/s, since no match shows that it moves
        places.append(run.follower.expected_place())
        moved += sum(c.speed for c in run.drive(0.2, offset, math.nan, place=places[-1])) * STEP
    if similarity < 0.3:
        assert moved == 0
        return
    assert places[0] == 5
    assert max(places) == pytest.approx(5 + 6.0 / 0.5, abs=1)
    assert places[-1] == -1  # the bridge ends without a match
    assert moved == pytest.approx(0.8 * 6.0, rel=0.1)
    assert run.drive(0.2, STRAIGHT, math.nan, place=-1)[-1].speed == 0


def test_expected_place_follows_the_last_match():
    run = Run()
    run.drive(4)
    assert run.follower.expected_place() == pytest.approx(run.place, abs=1)


def test_route_ends_at_its_last_place_unless_it_is_closed():
    runs = [Run(run=taught(20, seam=seam)) for seam in (None, 0)]
    commands = [run.drive(14)[-1] for run in runs]
    assert commands[0].reason == 'end of the route'
    assert commands[0].speed == 0
    assert commands[1].speed == pytest.approx(0.8)
    assert runs[1].run.on_lap(10.0) == pytest.approx(0.5)


def test_invalid_numbers_are_rejected():
    with pytest.raises(SettingsError, match='gain = 0 must be a number above 0'):
        FollowerSettings(gain=0)
    with pytest.raises(InputError, match=r'shapes \(3,\), \(2,\), \(3,\)'):
        TaughtRun(np.arange(3.0), np.ones(2), np.ones(3))
    with pytest.raises(InputError, match='times must increase'):
        TaughtRun(np.zeros(3), np.ones(3), np.ones(3))


def test_integral_takes_out_a_constant_pull():
    """A robot that turns by itself: the shift is what its heading has become."""
    robot, heading, pull = RouteFollower(taught(2000), FAST), 0.0, 0.02
    headings = []
    for k in range(4000):
        time = k * STEP
        offset = Offset(heading, 0.01, 0.0, 1e6, 0.6)
        if k % 4 == 0:
            robot.observe(Observation(time, int(time * 2), 1.0, offset), time)
        command = robot.command(time)
        heading += (command.turn - 0.1 * command.speed / 0.8 + pull * command.speed) * STEP
        headings.append(heading)
    assert max(headings) > 0.01
    assert abs(headings[-1]) < 1e-3


def test_robot_beside_the_path_returns_at_a_small_angle():
    """One meter to the right, turned 10 degrees away, images 0.4 s late, a pull to the left."""
    robot = RouteFollower(taught(200, turn=0.0), FollowerSettings())
    left, heading, along, late = -1.0, math.radians(-10), 0.0, []
    robot.start(0)
    path = []
    for k in range(800):
        time = k * STEP
        if k % 4 == 0:
            offset = Offset(0.62 * math.tan(heading), 0.01, 0.05 * left, 1e6, 0.6)
            late.append(Observation(time, int(along / 0.4), 1.0, offset))
        if late and late[0].stamp <= time - 0.4:
            robot.observe(late.pop(0), time)
        command = robot.command(time)
        heading += (command.turn + 0.01 * command.speed) * STEP
        left += command.speed * math.sin(heading) * STEP
        along += command.speed * math.cos(heading) * STEP
        path.append((along, left, heading))
    assert max(path)[0] > 25
    assert np.max(path, axis=0)[1] < 0.15
    assert math.degrees(np.max(path, axis=0)[2]) < 12
    assert all(abs(left) < 0.15 for along, left, _ in path if along > 15)


def test_large_error_at_the_start_is_not_taken_for_a_pull():
    commands = Run(run=taught(200)).drive(12, Offset(0.2, 0.01, 0.0, 1e6, 0.6))
    driven = sum(command.speed for command in commands) * STEP
    steered = (0.1 - commands[-1].turn) / 0.9 / commands[-1].speed
    assert steered == pytest.approx(0.2 + 0.05 * driven / 15, abs=1e-3)


def test_matched_image_much_less_similar_than_before_stops_at_once():
    run = Run()
    run.drive(3)
    other = Offset(0.0, 0.01, 0.0, 1e6, 0.17)
    assert run.drive(STEP, other)[-1].reason == 'the newest image is not of the route'
    other = Offset(0.0, 0.01, 0.0, 1e6, 0.3)
    run = Run()
    run.drive(3)
    assert run.drive(3, other)[-1].speed == pytest.approx(0.8)


def test_clock_that_is_set_back_stops_the_robot_until_the_next_image():
    run = Run()
    run.drive(3)
    assert run.follower.command(run.time - 2).reason == 'no new image'
