# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Evidence of motion: which images are new, which matches show motion, what odometry adds."""

import contextlib
import math

import cv2
import numpy as np
import pytest
from stavpr_nav.driver import DEADMAN_AGE, Driver, Goal, PAUSED
from stavpr_nav.evidence import ImageComparison, MotionEvidence, OdometryComparison
from stavpr_nav.follower import NO_EVIDENCE, Observation
from stavpr_ros.errors import InputError
from test_driver import Drive
from test_follower import FAST, Run, STEP, STRAIGHT, taught

rng = np.random.default_rng(0)


def scene(shift=0):
    """Return an image of a texture that moves by pixels."""
    texture = np.random.default_rng(1).integers(0, 256, (30, 60, 3), np.uint8)
    large = cv2.resize(texture, (960, 480), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(large[:, shift : shift + 640])


def noisy(image):
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def recompressed(image):
    packed = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
    return cv2.imdecode(packed, cv2.IMREAD_COLOR)


def with_clock(image):
    image = image.copy()
    cv2.putText(image, str(rng.integers(10**6)), (10, 40), cv2.FONT_HERSHEY_PLAIN, 3, (255,) * 3)
    return image


@pytest.mark.parametrize('change', [np.copy, noisy, recompressed, with_clock])
def test_repeated_image_is_not_new(change):
    comparison = ImageComparison()
    assert comparison.is_new(scene())
    assert not any(comparison.is_new(change(scene())) for _ in range(20))
    assert comparison.is_new(scene(4))


def test_images_of_a_ring_of_buffers_are_not_new():
    comparison = ImageComparison()
    ring = [scene(8 * k) for k in range(4)]
    assert all(comparison.is_new(image) for image in ring)
    assert not any(comparison.is_new(image) for image in ring * 3)


def test_slow_motion_adds_up_to_a_new_image_and_a_dark_one_has_none():
    comparison = ImageComparison()
    slow = [cv2.warpAffine(scene(), np.float32([[1, 0, -k / 10], [0, 1, 0]]), (600, 480))
            for k in range(40)]  # fmt: skip
    assert 2 <= sum(comparison.is_new(image) for image in slow) < 40
    dark = np.zeros((480, 640, 3), np.uint8)
    assert [comparison.is_new(dark) for _ in range(3)] == [True, False, False]


def evidence(places, meters=None, seam=None):
    """Return how many matches are evidence, after the first."""
    meters = np.arange(100) * 0.25 if meters is None else meters
    motion, count = MotionEvidence(meters, seam, 0.5), 0
    for k, place in enumerate(places):
        motion.rest(np.full(3, -1.0))
        motion.is_changed = True
        motion.take(k * 0.1, place, np.zeros(3), 1.0)
        count += motion.is_fresh
    return count


@pytest.mark.parametrize(
    ('places', 'count'),
    [
        ([5, 6, 7], 2),
        ([5] * 9, 0),
        ([5, 6] * 9, 1),  # two neighbors
        ([5, 7, 4, 6] * 9, 3),
        ([7, 6, 5], 2),
        ([5, 8, 6, 7, 8, 9], 4),  # one match that is ahead
    ],
)
def test_only_places_that_were_not_matched_are_evidence(places, count):
    assert evidence(places) == count


def test_places_taught_at_one_position_are_one_and_laps_show_places_again():
    assert evidence([3, 4, 5, 6, 7], np.maximum(0, np.arange(100) - 6.0)) == 1
    assert evidence([*range(10, 40), *range(0, 40)] * 2, seam=0, meters=np.arange(41.0)) == 139


def blocked(drive, seconds=8.0, **shown):
    """Drive with blocked wheels: images of one place; return the meters that are commanded."""
    commands = []
    for _ in range(round(seconds / STEP)):
        drive.driver.press(drive.time)
        shown = {'is_new': True} | shown
        drive.driver.observe(
            Observation(drive.time, int(drive.place), 1.0, STRAIGHT, **shown), drive.time
        )
        commands.append(drive.driver.step(drive.time))
        drive.time += STEP
    return sum(command.speed for command in commands) * STEP


@pytest.mark.parametrize('is_new', [True, False])
@pytest.mark.parametrize('start', [0.0, 4.0])
def test_emergency_stop_needs_a_new_press(is_new, start):
    drive = Drive(Goal(start=0), n=90, give_up_after=0.0)
    drive.go(start + STEP)
    assert blocked(drive, is_new=is_new) < 0.8
    assert drive.driver.command.reason == NO_EVIDENCE
    assert {command.speed for command in drive.go(3)} == {0}  # its release
    assert drive.go(1, pressed=False)[-1].reason == NO_EVIDENCE
    commands = drive.go(4)
    assert 0 < max(c.speed for c in commands[:10]) <= 0.3
    assert commands[-1].speed == pytest.approx(0.8)


def test_release_or_restart_go_on_and_gaps_of_the_program_do_not():
    drive = Drive(Goal(start=0), n=90, needs_deadman=False, give_up_after=0.0)
    assert not drive.driver.restart()
    drive.go(4)
    blocked(drive)
    drive.time += 3.0  # the program was suspended, or the clock was set forward
    drive.driver.press(drive.time)
    assert drive.go(2)[-1].reason == NO_EVIDENCE
    drive.driver.release()
    drive.driver.press(drive.time)
    assert not drive.driver.is_blocked
    blocked(drive)
    assert drive.driver.restart()
    assert drive.go(5)[-1].speed == pytest.approx(0.8)
    again = Driver(drive.run, Goal(start=0), 0.0, FAST, is_blocked=True)  # the next goal
    again.press(0.1)
    assert again.step(0.1).reason == NO_EVIDENCE
    again.press(0.2 + 2 * DEADMAN_AGE)
    assert again.is_blocked  # no step between: suspended
    again.step(0.3 + 2 * DEADMAN_AGE)


def test_skipped_images_keep_the_speed_and_are_no_evidence():
    run, k = Run(run=taught(400)), 0
    commands = []
    for k in range(300):
        if k % 2 == 0:
            is_compared = k % 4 == 0
            run.follower.observe(Observation(
                run.time, int(run.place) if is_compared else run.follower.expected_place(),
                0.99 if is_compared else math.nan, STRAIGHT, is_compared=is_compared,
            ), run.time)  # fmt: skip
        commands += run.drive(STEP, images=False)
    assert {command.speed for command in commands[100:]} == {0.8}
    for _ in range(100):
        run.follower.observe(
            Observation(run.time, int(run.place), math.nan, STRAIGHT, is_compared=False), run.time
        )
        run.drive(STEP, images=False)
    assert run.follower.command(run.time).speed == 0


def test_bridge_of_slow_motion_includes_skipped_and_equal_images_and_no_frozen_ones():
    run, moved = Run(run=taught(400)), 0.0
    run.follower.start(5)
    for k in range(400):
        if k == 200:
            moved = run.follower._totals[-1][1][0]
        run.follower.observe(Observation(
            run.time, run.follower.expected_place(), math.nan, STRAIGHT,
            is_new=k % 6 == 0 and k < 200, is_compared=k % 3 == 0,
        ), run.time)  # fmt: skip
        run.drive(STEP, images=False)
    assert moved == pytest.approx(0.3 * 200 * STEP, abs=0.1)  # beyond the next place
    assert moved + 0.1 < run.follower._totals[-1][1][0] < moved + 0.4
    assert run.follower.command(run.time).reason == NO_EVIDENCE


def test_images_out_of_order_or_of_the_future_are_not_used():
    run = Run()
    run.drive(4)
    stamp, place = run.follower._stamp, run.follower._newest.place
    for each in (stamp, stamp - 0.3, run.time + 30):
        run.follower.observe(Observation(each, 0, 1.0, STRAIGHT), run.time)
    assert (run.follower._stamp, run.follower._newest.place) == (stamp, place)


def test_clock_that_is_set_back_far_does_not_move_the_place():
    run = Run(run=taught(60))
    run.drive(15)
    run.time -= 3600
    commands = run.drive(4)
    assert {command.reason for command in commands} <= {
        'no new image', 'not localized on the route', 'waiting for more images of the route', '',
    }  # fmt: skip
    assert commands[-1].speed == pytest.approx(0.8)
    assert run.follower.expected_place() == pytest.approx(run.place, abs=1)


def odometry_drive(pose, seconds=8.0, frame='odom', stamp=lambda time: time):
    """Drive with images as commanded, and odometry of pose(x, time); return the reasons."""
    odometry = OdometryComparison(1.0)
    drive = Drive(Goal(start=0), n=90, odometry=odometry)
    reasons = []
    for _ in range(round(seconds / STEP)):
        x, now = drive.place * 0.4, drive.time
        if pose(x, now) is not None:
            name = frame if isinstance(frame, str) else frame(now)
            with contextlib.suppress(InputError):
                odometry.take(name, stamp(now), np.array([*pose(x, now), 0, 0, 0, 1]), now)
        shown = drive.go(STEP)
        reasons.append(shown[-1].reason)
    return reasons


def test_odometry_that_agrees_lets_the_robot_drive():
    assert odometry_drive(lambda x, _: (x, 1.0, 3.0))[-1] == ''


@pytest.mark.parametrize(
    ('options', 'reason'),
    [
        ({'pose': lambda x, t: (min(x, 2.0), 0, 0)}, NO_EVIDENCE),  # frozen, or blocked wheels
        ({'pose': lambda x, t: (x if t < 4 else math.nan, 0, 0)}, 'no odometry'),
        ({'pose': lambda x, t: (x, 0, 0) if t < 4 else None}, 'no odometry'),
        ({'pose': lambda x, t: None}, 'no odometry'),
        ({'pose': lambda x, t: (x, 0, 0), 'stamp': lambda t: min(t, 4.0)}, 'no odometry'),
        ({'pose': lambda x, t: (x + 50 * (round(t / STEP) % 2), 0, 0)}, 'no odometry'),
        ({'pose': lambda x, t: (x, 0, 0), 'frame': lambda t: 'ab'[round(t / STEP) % 2]},
         'no odometry'),
        ({'pose': lambda x, t: (x + 50 * (t > 4), 0, 0)}, ''),  # one jump
        ({'pose': lambda x, t: (3 * x, 0, 0)}, NO_EVIDENCE),  # moves, and the places do not
    ],
)  # fmt: skip
def test_odometry_that_disagrees_or_ends_stops_the_robot(options, reason):
    assert odometry_drive(**options)[-1] == reason


def test_pressed_again_before_the_stop_is_no_press_for_it():
    drive = Drive(Goal(start=0), n=90)
    drive.go(3)
    assert drive.go(1, pressed=False)[-1].reason == PAUSED
    drive.go(3)
    assert blocked(drive) < 1.0
    assert drive.go(2)[-1].reason == NO_EVIDENCE
