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
from stavpr_nav.follower import NO_EVIDENCE
from stavpr_nav.observation import Observation
from stavpr_ros.errors import InputError
from test_driver import Drive
from test_follower import FAST, Run, STEP, STRAIGHT, taught

rng = np.random.default_rng(0)
TEXTURE = cv2.resize(rng.integers(0, 256, (30, 60, 3), np.uint8), (960, 480))


def scene(shift=0.0):
    """Return an image of a texture that moves by pixels."""
    return cv2.warpAffine(TEXTURE, np.float32([[1, 0, -shift], [0, 1, 0]]), (640, 480))


def noisy(image):
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def recompressed(image):
    return cv2.imdecode(cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], 1)


def with_clock(image):
    text = str(rng.integers(10**6))
    return cv2.putText(image.copy(), text, (10, 40), cv2.FONT_HERSHEY_PLAIN, 3, (255,) * 3)


@pytest.mark.parametrize(
    ('change', 'images'),
    [
        (np.copy, [scene(8 * k) for k in range(4)]),  # of a ring of buffers
        (np.copy, [np.zeros((480, 640, 3), np.uint8)]),
        *((change, [scene()]) for change in (noisy, recompressed, with_clock)),
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


def blocked(drive, is_new=True):
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
    assert blocked(drive, is_new) < 0.8
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
    blocked(drive)
    drive.time += 3.0
    assert drive.go(2)[-1].reason == NO_EVIDENCE
    driver.release()
    driver.press(drive.time)
    assert not driver.is_blocked
    blocked(drive)
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
    run = Run(run=taught(400))
    assert set(look(run, 300, True, is_compared=2)[100:]) == {0.8}
    assert look(run, 100, is_compared=0)[-1] == 0


def test_bridge_of_slow_motion_includes_skipped_and_equal_images_and_no_frozen_ones():
    run = Run(run=taught(400))
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
