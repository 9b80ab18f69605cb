# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One drive along a taught route to its goal: dead-man switch, laps, and why it ends."""

from dataclasses import dataclass
import enum
import math

from stavpr_nav.evidence import OdometryComparison
from stavpr_nav.follower import Command, FollowerSettings, NO_EVIDENCE, RouteFollower, TaughtRun
from stavpr_nav.observation import Observation
from stavpr_ros.errors import InputError

DEADMAN_AGE = 0.5  # seconds that the dead-man switch counts after its last message
PAUSED = 'the dead-man switch is not pressed'
END = 'end of the route'


class Outcome(enum.IntEnum):
    """Why a drive has ended; numbers of the action Repeat."""

    REACHED = 0
    CANCELED = 1
    LOST = 2


@dataclass(frozen=True)
class Goal:
    """
    Where a drive ends.

    :param place: the last place; -1 = the last of the route.
    :param laps: which pass of this place ends the drive; 0 = none. An open route has 1.
    :param start: place where the robot is; -1 = unknown.
    """

    place: int = -1
    laps: int = 1
    start: int = -1


class Driver:
    """
    Drives to a goal; all times are seconds of one clock.

    :param needs_deadman: the robot moves only while :meth:`press` is called.
    :param give_up_after: seconds without an image of the route after which the drive ends, 0 =
        never; times without the dead-man switch do not count.
    :param is_blocked: the drive before ended without evidence of motion: the dead-man switch has
        to be released and pressed first, or :meth:`restart` to be called.
    :param odometry: has to move while a speed is commanded, and only then; None = no odometry.
    :raises InputError: the goal is not on the route.

    ``outcome`` is None while it drives; ``laps`` passes of the seam, ``place`` of the newest image
    of the route (-1 = none yet), ``distance`` meters that were commanded.
    ``is_waiting``: the place of the robot is not known yet, and an operator drives.
    """

    def __init__(
        self,
        run: TaughtRun,
        goal: Goal,
        now: float,
        settings: FollowerSettings | None = None,
        needs_deadman: bool = True,
        give_up_after: float = 30.0,
        is_blocked: bool = False,
        odometry: OdometryComparison | None = None,
    ) -> None:
        n, self._run = len(run.times), run
        self._goal = n - 1 if goal.place == -1 else goal.place
        if not (0 <= self._goal < n and -1 <= goal.start < n):
            raise InputError(f'places {goal.place} and {goal.start}: expected -1 to {n - 1}')
        if run.seam is None and goal.laps != 1:
            raise InputError(f'laps = {goal.laps}: expected 1, since the route is not closed')
        if run.seam is not None and self._goal <= run.seam:  # the same place at the lap's end
            self._goal += n - 1 - run.seam
        if run.seam is None and goal.start > self._goal:
            raise InputError(f'place {self._goal} is before the start {goal.start}')
        self._follower = RouteFollower(run, settings, odometry)
        if goal.start >= 0:
            self._follower.start(goal.start)
        self._lap = 0 if run.seam is None else n - 1 - run.seam
        self._passes = goal.laps or math.inf
        self._last_lap: float | None = None
        self._needs_deadman, self._give_up_after = needs_deadman, give_up_after
        self._valid_press = -math.inf
        self._press = now if is_blocked else -math.inf  # when the switch was last pressed
        self._time = self._alive = now
        self.outcome: Outcome | None = None
        self.place, self.laps, self.distance = -1, 0, 0.0
        self.newest: Observation | None = None
        self.command = Command(0.0, 0.0, '')
        self._follower.evidence.is_missing = is_blocked
        self.is_waiting = goal.start < 0

    def press(self, now: float) -> None:
        """Count the dead-man switch as pressed; a new press ends a stop without evidence."""
        if now - self._press > DEADMAN_AGE and now - self._time <= DEADMAN_AGE:  # not suspended
            self.restart()
        self._valid_press = self._press = now

    def release(self) -> None:
        """Count the dead-man switch as released."""
        self._valid_press = self._press = -math.inf

    def restart(self) -> bool:
        """Go on after a stop without evidence of motion; return whether there was one."""
        if was_blocked := self.is_blocked:
            self._follower.restart()
        return was_blocked

    @property
    def is_blocked(self) -> bool:
        """Whether the robot waits for a new press, or for :meth:`restart`."""
        return self._follower.evidence.is_missing

    @property
    def is_at_rest(self) -> bool:
        """Whether no speed is commanded."""
        return not (self.command.speed or self.command.turn)

    def expected_place(self, is_new: bool = True) -> int:
        """Return the place of an image without a match, or as that before; -1 = unknown."""
        if not is_new and self.newest is not None and self.newest.place >= 0:
            return self.newest.place
        return self._follower.expected_place()

    def observe(self, observation: Observation, now: float) -> None:
        """Take the result of an image."""
        self._follower.observe(observation, now)
        self.newest = observation
        if not observation.is_confirmed:
            return
        self.is_waiting = False
        before, self.place = self.place, observation.place
        if self._last_lap is None:
            self._last_lap = self._passes - 1 + (self._lap > 0 and self.place >= self._goal)
            if self._lap == 0 and self.place > self._goal:
                self.end(Outcome.LOST, now)
        elif abs(self.place - before) > self._lap / 2 > 0:
            self.laps += 1 if self.place < before else -1
        self._follower.end = self._goal if self.laps == self._last_lap else None

    def end(self, outcome: Outcome, now: float) -> None:
        """End the drive, unless it has ended."""
        if self.outcome is None:
            self.outcome = outcome
            self.command = self._follower.halt(now, self.command.reason)

    def halt(self, now: float, reason: str) -> Command:
        """Stop for now."""
        self.command = self._follower.halt(now, reason)
        return self.command

    def step(self, now: float) -> Command:
        """Return the velocities for now; to be called at a steady rate, above 10 Hz."""
        last = self._last_lap
        if last is not None and (self.laps, self.place) >= (last, self._goal):
            self.end(Outcome.REACHED, now)
        if self.outcome is not None:
            return self.command
        if now - self._time > DEADMAN_AGE:  # the program or the clock has jumped: no release
            self._press += now - self._time
        if self._needs_deadman and not 0 <= now - self._valid_press <= DEADMAN_AGE:
            reason = NO_EVIDENCE if self.is_blocked else PAUSED
            self.command, self._alive = self._follower.halt(now, reason), now
        else:
            self.command = self._follower.command(now)
        self.distance += abs(self.command.speed) * min(max(now - self._time, 0.0), 1.0)
        self._time = now
        if not self.command.reason:
            self._alive = now
        elif self.command.reason == END:
            self.end(Outcome.REACHED, now)
        elif 0 < self._give_up_after < now - self._alive:
            self.end(Outcome.LOST, now)
        return self.command

    @property
    def distance_to_go(self) -> float:
        """Return the meters of the taught run to the goal; NaN = unknown, or without an end."""
        if self._last_lap is None or math.isinf(self._last_lap):
            return math.nan
        meters = self._run.distances
        lap = float(meters[-1] - meters[self._run.seam or 0])
        ahead = float(meters[self._goal] - meters[self.place])
        return max(0.0, ahead + lap * (self._last_lap - self.laps))
