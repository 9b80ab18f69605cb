# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The control law: velocities of the taught run by place, corrected by the offset of the camera.

At the place of the newest image the robot repeats the taught velocities v and w, at a share c of
the speed that falls with the probability of the place, and steers against the offset of the image:

    v' = c v        w' = c w - gain v' (e + 1 / D integral e ds)        e = shift + weight parallax

shift is the heading error and parallax the lateral offset, in parts of the image's width (see
``stavpr_ros.relative_pose.offset``). Both errors converge, without a calibrated camera, as the
bearing-only law of Krajnik et al. (Navigation without localisation, 2018) does, whose one shift of
all features is the sum of the two. The weighted parallax is limited: far beside the path the robot
returns at a small angle, and does not swing beyond it. The integral over the path takes out a
constant pull to one side, of unequal wheels or a camera that does not look straight ahead.

From a standstill the robot creeps until a match of another place shows that it moves. Where such
evidence stays away, it stops until an operator starts it again (``stavpr_nav.evidence``).
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from stavpr_nav.evidence import (
    BRIDGE_TIME,
    MAX_STEP,
    MotionEvidence,
    OdometryComparison,
    path_speed,
)
from stavpr_nav.observation import Observation
from stavpr_nav.parameters import REPEAT
from stavpr_ros.errors import InputError, SettingsError

SLOW_PROBABILITY, FULL_PROBABILITY = 0.5, 0.9  # probabilities of the slowest and of the full speed
MIN_SHARE = 0.3  # share of the taught speed
NO_OFFSET_SHARE = 0.5  # share of the speed while the offset is not valid
# Widths of the image: of the sum; of the parallax in it, for a small angle back to the path.
MAX_STEER, MAX_APPROACH = 0.2, 0.1
INTEGRAL, MAX_INTEGRAL = 15.0, 0.05  # D, meters; widths of the image, of summands too
BRIDGE_SHARE = 0.5  # share of the speed without a match
CREEP = 0.3  # m/s from a standstill to the first evidence of motion
NO_EVIDENCE = 'no evidence of motion: press the dead-man switch again, or call ~/start'
MIN_RATIO, MEMORY = 0.3, 10  # of the similarity to its recent mean; images of the mean
MIN_IMAGES = 3  # successive confirmed images, from which on the robot moves
HISTORY = 200  # latest commands, to know how far the robot is since an image was taken


@dataclass(frozen=True)
class FollowerSettings:
    """
    Settings of the control law, whose units and sentences are in ``parameters.REPEAT``.

    :raises SettingsError: a number that is not above 0.
    """

    gain: float = REPEAT['gain'][0]
    parallax_weight: float = REPEAT['parallax_weight'][0]
    max_speed: float = REPEAT['max_speed'][0]
    max_turn: float = REPEAT['max_turn'][0]
    max_acceleration: float = REPEAT['max_acceleration'][0]
    max_turn_acceleration: float = REPEAT['max_turn_acceleration'][0]
    max_age: float = REPEAT['max_age'][0]
    max_delay: float = REPEAT['max_delay'][0]
    max_unconfirmed: float = REPEAT['max_unconfirmed'][0]

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (value > 0 and math.isfinite(value)):
                raise SettingsError(f'{name} = {value} must be a number above 0')


@dataclass(frozen=True, eq=False)
class TaughtRun:
    """
    The velocities of the taught run at the n places of the map.

    :param times: seconds, increasing, shape (n,).
    :param speeds, turns: m/s and rad/s, positive to the left, shape (n,).
    :param seam: the place that the last one of a closed route shows, which goes on from there;
        None = the route ends at its last place.
    :raises InputError: other shapes, numbers that are not finite, times that do not increase.
    """

    times: np.ndarray
    speeds: np.ndarray
    turns: np.ndarray
    seam: int | None = None

    def __post_init__(self) -> None:
        columns = (self.times, self.speeds, self.turns)
        n = len(self.times)
        if n < 2 or any(column.shape != (n,) for column in columns):
            shapes = ', '.join(str(column.shape) for column in columns)
            raise InputError(f'times, speeds and turns have shapes {shapes}: expected (n,), n > 1')
        if not np.isfinite(columns).all() or (np.diff(self.times) <= 0).any():
            raise InputError('times, speeds and turns must be finite, times must increase')
        if self.seam is not None and not 0 <= self.seam < n - 1:
            raise InputError(f'seam = {self.seam}: expected a place before the last of {n}')

    @cached_property
    def distances(self) -> np.ndarray:
        """Return the meters from the first place to each, shape (n,)."""
        steps = abs(self.speeds[:-1] + self.speeds[1:]) / 2 * np.diff(self.times)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def on_lap(self, time: float) -> float:
        """Return a time after the last place of a closed route as one of the next lap."""
        last = float(self.times[-1])
        if self.seam is None or time <= last:
            return time
        first = float(self.times[self.seam])
        return first + (time - last) % (last - first)

    def at(self, place: int, later: float) -> tuple[float, float, bool]:
        """Return speed and turn a time (s) after a place, and whether it is the end."""
        time = self.on_lap(float(self.times[place]) + later)
        is_end = self.seam is None and time >= self.times[-1]
        speed, turn = (np.interp(time, self.times, column) for column in (self.speeds, self.turns))
        return float(speed), float(turn), is_end


@dataclass(frozen=True)
class Command:
    """
    Velocities of the robot.

    :param speed, turn: m/s, and rad/s to the left.
    :param reason: why the robot does not move; empty while it does.
    """

    speed: float
    turn: float
    reason: str = ''


class RouteFollower:
    """
    Follows a taught route; all times are seconds of one clock.

    :param taught: the velocities to repeat.
    :param odometry: has to move while a speed is commanded, and only then; None = no odometry.
    """

    def __init__(
        self,
        taught: TaughtRun,
        settings: FollowerSettings | None = None,
        odometry: OdometryComparison | None = None,
    ) -> None:
        self._taught, self._settings = taught, settings or FollowerSettings()
        self._newest: Observation | None = None  # the newest confirmed image
        self._received = self._confirmed = -math.inf
        self._stamp, self._delay = -math.inf, 0.0
        self._successive = 0
        self._integral = self._steer = 0.0
        self._similarity = 0.0  # mean of the latest matched images
        self._probability = math.nan  # place of the latest compared image
        self._last, self._time = Command(0.0, 0.0), -math.inf
        # meters that were commanded, meters of odometry and seconds of the taught run that were
        # repeated, by the time of the commands
        self._totals: deque[tuple[float, np.ndarray]] = deque([(-math.inf, np.zeros(3))], HISTORY)
        # the last match, and the seconds that were repeated until then
        self._anchor: tuple[int, float] | None = None
        steps = path_speed(taught.speeds[:-1], taught.turns[:-1]) * np.diff(taught.times)
        path = np.concatenate([[0.0], np.cumsum(steps)])
        self.evidence = MotionEvidence(path, taught.seam, self._settings.max_age)
        self._odometry = odometry
        if odometry is not None:
            odometry.commanded = 0.0  # of this drive
        self.end: int | None = None  # a place before the last at which the route ends

    @property
    def _now(self) -> np.ndarray:
        """Return the totals until now."""
        return self._totals[-1][1]

    def start(self, place: int) -> None:
        """Set the place of a robot at rest; otherwise it moves after its first match."""
        self._anchor = place, float(self._now[2])
        self.evidence.restart(self._now, place)

    def restart(self) -> None:
        """Go on after a stop by missing evidence of motion: an operator has looked."""
        self.evidence.restart(self._now, self._newest.place if self._newest else -1)
        if self._odometry is not None:
            self._odometry.commanded = float(self._now[0])

    def expected_place(self) -> int:
        """Return the place of an image soon after the last match; -1 = unknown."""
        if self._anchor is None:
            return -1
        place, before = self._anchor
        done, times = float(self._now[2]) - before, self._taught.times
        if done > BRIDGE_TIME:
            return -1
        time = self._taught.on_lap(float(times[place]) + done)
        return min(int(np.searchsorted(times, time)), len(times) - 1)

    def observe(self, observation: Observation, now: float) -> None:
        """Take the result of an image; one that is out of order, or of later, is not used."""
        self.evidence.is_changed |= observation.is_new
        late = now - observation.stamp
        is_earlier = observation.stamp <= self._stamp
        if late < -self._settings.max_delay or (is_earlier and late <= self._settings.max_delay):
            return
        self._received, self._stamp, self._delay = now, observation.stamp, max(late, 0.0)
        if late > self._settings.max_delay:
            return
        if observation.is_compared:
            self._probability = observation.probability
        if observation.is_confirmed and not self._falls(observation):
            self._newest, self._confirmed = observation, now
            self._successive += 1
            totals = self._until(observation.stamp)
            if observation.is_matched:
                self._anchor = observation.place, float(totals[2])
            self.evidence.take(observation, totals, self._last.speed)
        elif now - self._confirmed > self._settings.max_unconfirmed:
            self._successive = 0

    def _falls(self, observation: Observation) -> bool:
        """Whether the filter still matches, by its memory, an image unlike its place."""
        if math.isnan(observation.probability) or observation.offset is None:
            return False
        similarity, before = observation.offset.similarity, self._similarity
        self._similarity += (similarity - before) / MEMORY if before else similarity
        return similarity < MIN_RATIO * before

    def halt(self, now: float, reason: str) -> Command:
        """Halt for now; the robot accelerates from rest afterwards."""
        self._time, self._last = now, Command(0.0, 0.0, reason)
        self.evidence.rest(self._now)
        return self._last

    def command(self, now: float) -> Command:
        """Return the velocities for now; to be called at a steady rate, above 10 Hz."""
        step = now - self._time
        self._time = now
        if not 0 <= step <= MAX_STEP:  # from rest: where the robot was before is unknown
            self._totals = deque([(-math.inf, self._now)], HISTORY)
            self._last = Command(0.0, 0.0, self._last.reason)
            self.evidence.rest(self._now)
            self._stamp = self._stamp if step > 0 else -math.inf
            step = 0.0
        self._count(step)
        self._last = self._limit_command(self._target_velocities(now), step)
        if self._last.reason:
            self.evidence.rest(self._now)
        return self._last

    def _stop_reason(self, now: float) -> str:
        """Return why the robot must not move; empty = it may."""
        evidence, odometry = self.evidence, self._odometry
        is_due = evidence.is_due(self._now, self._last.speed, self._delay)
        is_still = odometry is not None and odometry.is_still(float(self._now[0]))
        if is_still or (is_due and evidence.bridge):  # at the end of the bridge
            evidence.is_missing = True
        if evidence.is_missing:
            return NO_EVIDENCE
        if odometry is not None and not 0 <= now - odometry.received <= self._settings.max_age:
            return 'no odometry'
        return self._image_reason(now) or ('waiting for evidence of motion' if is_due else '')

    def _image_reason(self, now: float) -> str:
        """Return why the images do not permit motion; empty = they do."""
        settings = self._settings
        is_new = 0 <= now - self._received <= settings.max_age  # or the clock was set back
        if not is_new or now - self._stamp > settings.max_delay:
            return 'no new image'
        if now - self._confirmed > settings.max_unconfirmed:
            self._successive = 0
            return 'not localized on the route'
        if self._confirmed < self._received:
            return 'the newest image is not of the route'
        return 'waiting for more images of the route' if self._successive < MIN_IMAGES else ''

    def _target_velocities(self, now: float) -> Command:
        """Return the velocities without limits of the acceleration."""
        settings, newest = self._settings, self._newest
        if reason := self._stop_reason(now):
            return Command(0.0, 0.0, reason)
        assert newest is not None
        offset = newest.offset
        assert offset is not None
        since, times = self._since(newest.stamp), self._taught.times
        speed, turn, is_end = self._taught.at(newest.place, since)
        if is_end or (self.end is not None and times[newest.place] + since >= times[self.end]):
            return Command(0.0, 0.0, 'end of the route')
        share = (self._probability - SLOW_PROBABILITY) / (FULL_PROBABILITY - SLOW_PROBABILITY)
        share = BRIDGE_SHARE if math.isnan(share) else min(max(share, MIN_SHARE), 1.0)
        share *= 1 if offset.is_valid else NO_OFFSET_SHARE
        limit = settings.max_speed if self.evidence.is_fresh else min(CREEP, settings.max_speed)
        share = min(share, limit / max(abs(speed), 1e-9))
        speed, turn = share * speed, share * turn
        self._steer = 0.0
        if offset.is_valid:
            lateral = settings.parallax_weight * offset.parallax
            self._steer = _limit(offset.shift + _limit(lateral, MAX_APPROACH), MAX_STEER)
        turn -= settings.gain * abs(speed) * (self._steer + self._integral)
        return Command(speed, turn)

    def _until(self, stamp: float) -> np.ndarray:
        """Return the totals at a time."""
        return next((t for at, t in reversed(self._totals) if at <= stamp), self._totals[0][1])

    def _since(self, stamp: float) -> float:
        """Return the seconds of the taught run that were repeated since a time."""
        return float(self._now[2] - self._until(stamp)[2])

    def _count(self, step: float) -> None:
        """Count what the last command has repeated in the seconds since."""
        meters = self._odometry.take_meters() if self._odometry is not None else 0.0
        last, newest = self._last, self._newest
        if last.reason or newest is None:
            return
        taught = self._taught.at(newest.place, self._since(newest.stamp))[0]
        done = last.speed / taught * step if abs(taught) > 1e-3 else step
        increment = np.array([path_speed(last.speed, last.turn) * step, meters, done])
        self._totals.append((self._time, self._now + increment))

    def _limit_command(self, target: Command, step: float) -> Command:
        """Limit velocities and accelerations, but no stop."""
        settings = self._settings
        if target.reason:
            return target
        faster = settings.max_acceleration * step
        speed = min(max(target.speed, self._last.speed - faster), self._last.speed + faster)
        turning = settings.max_turn_acceleration * step
        turn = min(max(target.turn, self._last.turn - turning), self._last.turn + turning)
        turn = _limit(turn, settings.max_turn)
        increment = _limit(self._steer, MAX_INTEGRAL) * abs(speed) * step / INTEGRAL
        self._integral = _limit(self._integral + increment, MAX_INTEGRAL)
        return Command(speed, turn)


def _limit(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)
