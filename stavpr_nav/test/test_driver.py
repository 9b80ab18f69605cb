# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A drive to its goal: dead-man switch, last place, laps, and when it gives up."""

import math

import pytest
from stavpr_nav.driver import DEADMAN_AGE, Driver, Goal, Outcome, PAUSED
from stavpr_nav.observation import Observation
from stavpr_ros.errors import InputError
from test_follower import COVERED, FAST, STEP, STRAIGHT, taught


class Drive:
    """A robot that is where the driver believes, with images at 5 Hz."""

    def __init__(self, goal, n=40, seam=None, place=0, **options):
        self.run = taught(n, seam=seam)
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
