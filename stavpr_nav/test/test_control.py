# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The control law, a drive to its goal, evidence of motion: corrections, signs, limits, stops."""

import contextlib
import math

import cv2
import numpy as np
import pytest
from stavpr_nav import follower
from stavpr_nav.driver import DEADMAN_AGE, Driver, Goal, Outcome, PAUSED
from stavpr_nav.evidence import ImageComparison, MotionEvidence, OdometryComparison
from stavpr_nav.follower import FollowerSettings, NO_EVIDENCE, RouteFollower, TaughtRun
from stavpr_nav.observation import Observation
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.relative_pose.offset import Offset

STEP = 0.05
STRAIGHT = Offset(0.0, 0.01, 0.0, 1e6, 0.6)
COVERED = Offset(0.0, 0.01, 0.0, 1.0, 0.0)
FAST = FollowerSettings(max_acceleration=1e3, max_turn_acceleration=1e3, max_turn=5.0)


def teach(n=100, speed=0.8, turn=0.1, **changes):
    return TaughtRun(np.arange(n) * 0.5, np.full(n, speed), np.full(n, turn), **changes)


class Run:
    """A follower with images at 5 Hz, at the places that it repeats."""

    def __init__(self, settings=FAST, run=None):
        self.run = run or teach()
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
def proportional(set_constants):
    """Leave out the integral of the law."""
    set_constants(follower, INTEGRAL=1e9)


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
    run = Run(settings, teach(speed=2.0, turn=3.0))
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


@pytest.mark.parametrize(('age', 'later'), [(1.2, 0.0), (0.0, -2.0)])
def test_images_that_arrive_too_late_or_after_a_clock_that_is_set_back_stop_the_robot(age, later):
    run = Run()
    run.drive(3)
    run.follower.observe(Observation(run.time - age, 6, 1.0, STRAIGHT), run.time)
    assert run.follower.command(run.time + later).reason == 'no new image'


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
    assert commands[-1].reason == NO_EVIDENCE
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
    runs = [Run(run=teach(20, seam=seam)) for seam in (None, 0)]
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
    robot, heading, pull = RouteFollower(teach(2000), FAST), 0.0, 0.02
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
    robot = RouteFollower(teach(200, turn=0.0), FollowerSettings())
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
    commands = Run(run=teach(200)).drive(12, Offset(0.2, 0.01, 0.0, 1e6, 0.6))
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


class Drive:
    """A robot that is where the driver believes, with images at 5 Hz."""

    def __init__(self, goal, n=40, seam=None, place=0, **options):
        self.run = teach(n, seam=seam)
        self.time, self.place = 0.0, float(place)
        self.driver = Driver(self.run, goal, 0.0, FAST, **options)

    def go(self, seconds, offset=STRAIGHT, pressed=True):
        """Drive for some seconds, or until the end; return the commands."""
        commands = []
        for k in range(round(seconds / STEP)):
            if pressed:
                self.driver.press(self.time)
            if k % 4 == 0:
                shown = Observation(self.time, int(self.place), 1.0, offset)
                self.driver.observe(shown, self.time)
            commands.append(self.driver.step(self.time))
            if self.driver.outcome is not None:
                break
            self.place += commands[-1].speed / 0.8 * STEP / 0.5
            last, seam = len(self.run.times) - 1, self.run.seam
            if seam is not None and self.place >= last:
                self.place -= last - seam
            self.time += STEP
        return commands


@pytest.mark.parametrize(('place', 'end'), [(-1, 39), (25, 25)])
def test_drive_ends_at_its_last_place(place, end):
    drive = Drive(Goal(place), place=10)
    drive.go(5)
    remaining = (end - drive.place) * 0.4
    assert drive.driver.distance_to_go == pytest.approx(remaining, abs=0.9)
    command = drive.go(60)[-1]
    assert drive.driver.outcome is Outcome.REACHED
    assert command.speed == 0
    assert drive.place == pytest.approx(end, abs=0.6)
    assert drive.driver.distance == pytest.approx((end - 10) * 0.4, abs=0.5)


@pytest.mark.parametrize(
    ('place', 'laps', 'end'), [(20, 1, 0), (20, 3, 2), (12, 1, 1), (5, 1, 0), (-1, 2, 1)]
)
def test_laps_of_a_closed_route_end_at_a_pass_of_the_last_place(place, laps, end):
    drive = Drive(Goal(place, laps), n=41, seam=10, place=12)
    drive.go(laps * 40 + 40)
    assert drive.driver.outcome is Outcome.REACHED
    assert drive.driver.laps == pytest.approx(end, abs=place == -1)
    meters = ((place if place > 12 else place + 30 if place >= 0 else 40) - 12) * 0.4
    assert drive.driver.distance == pytest.approx(meters + (laps - 1) * 12, abs=0.8)


def test_laps_without_an_end():
    drive = Drive(Goal(laps=0), n=41, seam=0)
    drive.go(100)
    assert drive.driver.outcome is None
    assert drive.driver.laps >= 4
    assert math.isnan(drive.driver.distance_to_go)


def test_robot_stands_without_dead_man_switch_and_goes_on_slowly():
    drive = Drive(Goal(), give_up_after=5.0)
    assert drive.go(8, pressed=False)[-1].reason == PAUSED
    assert drive.driver.outcome is None
    assert drive.go(3)[-1].speed == pytest.approx(0.8)
    began = drive.time
    stopped = [c.reason for c in drive.go(2, pressed=False)].index(PAUSED) * STEP
    assert stopped <= DEADMAN_AGE + STEP
    assert drive.time > began
    drive.driver.press(drive.time + 9)
    assert drive.driver.step(drive.time).reason == PAUSED  # the clock was set back
    drive.driver.press(drive.time)
    drive.driver.release()
    assert drive.driver.step(drive.time).reason == PAUSED


def test_a_lost_robot_stands_and_gives_up():
    drive = Drive(Goal(), give_up_after=5.0)
    drive.go(4)
    commands = drive.go(20, COVERED)
    assert drive.driver.outcome is Outcome.LOST
    assert drive.time == pytest.approx(9, abs=0.8)
    assert commands[-1].reason == 'not localized on the route'
    again = Drive(Goal(), give_up_after=0.0)
    again.go(20, COVERED)
    assert again.driver.outcome is None


def test_robot_behind_its_goal_does_not_drive():
    drive = Drive(Goal(10), place=20)
    assert drive.go(60)[-1].speed == 0
    assert drive.driver.outcome is Outcome.LOST
    assert drive.driver.distance == 0


def test_places_that_jump_over_the_seam_and_back_are_no_lap():
    drive = Drive(Goal(30, 3), n=41, seam=10, place=12)
    for place in (39, 10, 39, 10, 39, 30, 29, 30):
        drive.driver.observe(Observation(0.0, place, 1.0, STRAIGHT), 0.0)
    drive.driver.step(0.1)
    assert (drive.driver.laps, drive.driver.outcome) == (0, None)


@pytest.mark.parametrize(
    ('goal', 'message'),
    [
        (Goal(40), 'places 40 and -1: expected -1 to 39'),
        (Goal(-2), 'expected -1 to 39'),
        (Goal(start=40), 'places -1 and 40'),
        (Goal(laps=2), 'the route is not closed'),
        (Goal(laps=0), 'the route is not closed'),
        (Goal(5, start=6), 'place 5 is before the start 6'),
    ],
)
def test_goals_that_are_not_on_the_route_are_rejected(goal, message):
    with pytest.raises(InputError, match=message):
        Drive(goal)


rng = np.random.default_rng(0)
TEXTURE = cv2.resize(rng.integers(0, 256, (30, 60, 3), np.uint8), (960, 480))


def scene(shift=0.0):
    """Return an image of a texture that moves by pixels."""
    return cv2.warpAffine(TEXTURE, np.float32([[1, 0, -shift], [0, 1, 0]]), (640, 480))


def noisy(image):
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def recompress(image):
    return cv2.imdecode(cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], 1)


def with_clock(image):
    text = str(rng.integers(10**6))
    return cv2.putText(image.copy(), text, (10, 40), cv2.FONT_HERSHEY_PLAIN, 3, (255,) * 3)


@pytest.mark.parametrize(
    ('change', 'images'),
    [
        (np.copy, [scene(8 * k) for k in range(4)]),  # of a ring of buffers
        (np.copy, [np.zeros((480, 640, 3), np.uint8)]),
        *((change, [scene()]) for change in (noisy, recompress, with_clock)),
    ],
)
def test_repeated_images_are_not_new(change, images):
    comparison = ImageComparison()
    assert all(map(comparison.is_new, images))
    assert not any(comparison.is_new(change(image)) for image in images * 8)
    assert 2 <= sum(comparison.is_new(scene(k / 10 - 20)) for k in range(40)) < 40  # slow motion


@pytest.mark.parametrize(
    ('places', 'count', 'meters', 'seam'),
    [
        ([5, 6, 7], 2, np.arange(10.0), None),
        ([5] * 9, 0, np.arange(10.0), None),
        ([5, 7, 4, 6] * 9, 3, np.arange(10.0), None),  # neighbors in turn
        ([7, 6, 5], 2, np.arange(10.0), None),
        ([5, 8, 6, 7, 8, 9], 4, np.arange(10.0), None),  # one match that is ahead
        ([3, 4, 5, 6, 7], 1, np.maximum(0, np.arange(10) - 6.0), None),  # taught at one position
        ([*range(10, 40), *range(40)] * 2, 139, np.arange(41.0), 0),  # laps
    ],
)
def test_only_places_that_were_not_matched_are_evidence(places, count, meters, seam):
    motion, fresh = MotionEvidence(meters, seam, 0.5), 0
    for k, place in enumerate(places):
        motion.rest(np.full(3, -1.0))
        motion.is_changed = True
        motion.take(Observation(k * 0.1, place, 1.0, STRAIGHT), np.zeros(3), 1.0)
        fresh += motion.is_fresh
    assert fresh == count


def drive_blocked(drive, is_new=True):
    """Drive with blocked wheels: images of one place; return the meters that are commanded."""
    meters, driver = 0.0, drive.driver
    for _ in range(round(8 / STEP)):
        driver.press(drive.time)
        shown = Observation(drive.time, int(drive.place), 1.0, STRAIGHT, is_new)
        driver.observe(shown, drive.time)
        meters += driver.step(drive.time).speed * STEP
        drive.time += STEP
    return meters


@pytest.mark.parametrize(('is_new', 'start'), [(True, 0.0), (True, 4.0), (False, 4.0)])
def test_emergency_stop_needs_a_new_press(is_new, start):
    drive = Drive(Goal(start=0), n=90, give_up_after=0.0)
    drive.go(start + STEP)
    if start:
        assert drive.go(1, pressed=False)[-1].reason == PAUSED  # before the stop: no press for it
        drive.go(start)
    assert drive_blocked(drive, is_new) < 0.8
    assert {command.reason for command in drive.go(3)} == {NO_EVIDENCE}  # after its release, too
    assert drive.go(1, pressed=False)[-1].reason == NO_EVIDENCE
    commands = drive.go(4)
    assert 0 < max(c.speed for c in commands[:10]) <= 0.3
    assert commands[-1].speed == pytest.approx(0.8)


def test_release_or_restart_go_on_and_gaps_of_the_program_do_not():
    drive = Drive(Goal(start=0), n=90, needs_deadman=False, give_up_after=0.0)
    driver = drive.driver
    assert not driver.restart()
    drive.go(4)
    drive.time += 3.0  # the program was suspended, or the clock was set forward
    assert max(command.speed for command in drive.go(0.5)) <= 0.3
    drive.go(4)
    drive_blocked(drive)
    drive.time += 3.0
    assert drive.go(2)[-1].reason == NO_EVIDENCE
    driver.release()
    driver.press(drive.time)
    assert not driver.is_blocked
    drive_blocked(drive)
    assert driver.restart()
    assert drive.go(5)[-1].speed == pytest.approx(0.8)
    again = Driver(drive.run, Goal(start=0), 0.0, FAST, is_blocked=True)  # the next goal
    for now in (0.1, 0.2 + 2 * DEADMAN_AGE):  # the second one suspended: no step between
        again.press(now)
        assert again.is_blocked


def look(run, count, has_match=False, is_new=1, is_compared=1):
    """Take steps with an image each; each n-th is new or compared, 0 = none; return the speeds."""
    speeds = []
    for k in range(count):
        new, compared = (n > 0 and k % n == 0 for n in (is_new, is_compared))
        shown = run.follower.expected_place(), math.nan
        if has_match and compared:
            shown = int(run.place), 0.99
        run.follower.observe(Observation(run.time, *shown, STRAIGHT, new, compared), run.time)
        speeds.append(run.drive(STEP, images=False)[0].speed)
    return speeds


def test_skipped_images_keep_the_speed_and_are_no_evidence():
    run = Run(run=teach(400))
    assert set(look(run, 300, True, is_compared=2)[100:]) == {0.8}
    assert look(run, 100, is_compared=0)[-1] == 0


def test_bridge_of_slow_motion_includes_skipped_and_equal_images_and_no_frozen_ones():
    run = Run(run=teach(400))
    run.follower.start(5)
    meters = sum(look(run, 200, is_new=6, is_compared=3)) * STEP
    assert meters == pytest.approx(0.3 * 200 * STEP, abs=0.1)  # beyond the next place
    assert 0.1 < sum(look(run, 200, is_new=0, is_compared=3)) * STEP < 0.4
    assert run.follower.command(run.time).reason == NO_EVIDENCE


def test_images_out_of_order_or_of_the_future_are_not_used():
    run = Run()
    run.drive(4)
    place = run.follower.expected_place()
    for stamp in (run.time - STEP, run.time - 0.3, run.time + 30):
        run.follower.observe(Observation(run.time - STEP, place, 1.0, STRAIGHT), run.time)
        run.follower.observe(Observation(stamp, 0, 1.0, STRAIGHT), run.time)
        assert run.follower.expected_place() == pytest.approx(place, abs=1)


@pytest.mark.parametrize(
    ('pose', 'reason'),  # x, stamp and frame by the meters that are driven, and the time
    [
        (lambda x, t: (x, t, 'odom'), ''),
        (lambda x, t: (min(x, 2.0), t, 'odom'), NO_EVIDENCE),  # frozen, or blocked wheels
        (lambda x, t: (3 * x, t, 'odom'), NO_EVIDENCE),  # moves, and the places do not
        (lambda x, t: (x + 50 * (t > 4), t, 'odom'), ''),  # one jump
        (lambda x, t: (x + 50 * (round(t / STEP) % 2), t, 'odom'), 'no odometry'),
        (lambda x, t: (x if t < 4 else math.nan, t, 'odom'), 'no odometry'),
        (lambda x, t: (x, min(t, 4.0), 'odom'), 'no odometry'),
        (lambda x, t: (x, t, 'ab'[round(t / STEP) % 2]), 'no odometry'),
    ],
)
def test_odometry_that_disagrees_or_ends_stops_the_robot(pose, reason):
    drive = Drive(Goal(start=0), n=90, odometry=(odometry := OdometryComparison(1.0)))
    for _ in range(round(8 / STEP)):
        x, stamp, frame = pose(drive.place * 0.4, drive.time)
        with contextlib.suppress(InputError):
            odometry.take(frame, stamp, np.array([x, 1, 3, 0, 0, 0, 1.0]), drive.time)
        last = drive.go(STEP)[-1]
    assert last.reason == reason


@pytest.mark.parametrize(
    ('places', 'added'),
    [
        ([1, 2, 3], 0.0),
        ([5, 7, 6, 4, 8], 0.75),  # by 0 to 1.25 m
        ([13, 14, 15], 1.5),  # up to a limit
        ([13, *range(2, 13), *range(14, 20)], 0.0),  # of the latest ones
    ],
)
def test_matches_ahead_of_or_behind_the_commanded_meters_allow_for_the_distance(places, added):
    """A place each 0.25 m."""
    evidence = MotionEvidence(0.25 * np.arange(25), None, 0.1)
    evidence.restart(np.zeros(3), 0)
    for k, place in enumerate(places):
        meters = 0.25 * (k + 1)
        evidence.is_changed = True
        evidence.take(Observation(meters, place, 0.9, None), np.array([meters, 0, meters]), 0.0)
    for margin in (-0.01, 0.01):
        late = meters + 0.3 + added + margin
        assert evidence.is_due(np.array([late, 0, late]), 0.0) == (margin > 0)
    evidence.restart(np.array([late, 0, late]))
    for meters in (late + 0.29, late + 0.31):
        assert evidence.is_due(np.array([meters, 0, meters]), 0.0) == (meters > late + 0.3)
