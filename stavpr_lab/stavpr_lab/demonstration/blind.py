# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How far a robot drives blind: meters from the image of its last evidence of motion to standstill.

Driver and control law in a loop of simulated time, on a straight route at 1 m/s: the dead-man
switch is pressed all the time, images are processed after ``LATENCY``, the base brakes with
``BRAKING``. Each number is the worst of ``PHASES`` moments of the failure between two places.
``python3 -m stavpr_lab.demonstration.blind`` prints the table.
"""

from collections import deque
from dataclasses import dataclass
import math

import numpy as np
from stavpr_nav.driver import Driver, Goal
from stavpr_nav.evidence import OdometryComparison
from stavpr_nav.follower import FollowerSettings, TaughtRun
from stavpr_nav.observation import Observation
from stavpr_ros.relative_pose.offset import Offset

SPEED, STEP, LATENCY, BRAKING = 1.0, 0.01, 0.05, 5.0  # m/s, seconds, seconds, m/s^2
CONTROL, ODOMETRY = 5, 2  # steps between two commands, and between two odometry messages
PHASES = 20
BEFORE, AFTER = 12.0, 30.0  # meters before, seconds after the failure
SIMILAR = Offset(0.0, 0.01, 0.0, 1e6, 0.6)  # an image that shows its place


@dataclass(frozen=True)
class Failure:
    """
    What fails.

    :param is_new: the images change. :param is_matched: they have a match.
    :param swing: places between which the matches alternate.
    :param wheels: they turn; False = something blocks the robot.
    :param odometry: the odometry goes on; None = it is not used.
    :param rate: good images per second that go on; 0 = none. :param images: there are images.
    """

    is_new: bool = False
    is_matched: bool = True
    swing: int = 0
    wheels: bool = True
    odometry: bool | None = None
    images: bool = True
    rate: float = 0.0


FAILURES = {
    'the camera repeats its last image': Failure(),
    'the same, without a match': Failure(is_matched=False),
    'the same, with noise that counts as a change': Failure(is_new=True),
    'it repeats images of two places in turn': Failure(swing=1),
    'the wheels are blocked, the scene is busy': Failure(is_new=True, wheels=False),
    'the same, matches alternate between two places': Failure(True, swing=1, wheels=False),
    'the same, with odometry': Failure(is_new=True, wheels=False, odometry=True),
    'odometry ends: meters after it': Failure(rate=5.0, odometry=False),
    'the camera ends': Failure(images=False),
    'the bridge: other images, without a match': Failure(is_new=True, is_matched=False),
    'the camera falls to half its rate: meters between images': Failure(rate=5.0),
    'the camera falls to 1 image/s: meters between images': Failure(rate=1.0),
}


def is_slow(failure: Failure) -> bool:
    """Return whether good images go on, slowly, and nothing else fails."""
    return failure.rate > 0 and failure.odometry is None


def drive(
    failure: Failure, spacing: float, rate: float, phase: float
) -> tuple[float, str, float, float]:
    """
    Drive until a failure, and as long as the robot moves.

    :param spacing: meters between two places. :param rate: images per second.
    :param phase: 0 to 1 places after which it happens.
    :returns: meters from the image of the last evidence to standstill, the reason at the end, the
        meters after the first standstill, and those after the failure.
    """
    count = round((BEFORE + SPEED * AFTER) / spacing) + 10
    run = TaughtRun(np.arange(count) * spacing / SPEED, np.full(count, SPEED), np.zeros(count))
    odometry = None if failure.odometry is None else OdometryComparison(SPEED)
    settings = FollowerSettings(max_acceleration=1.0)
    driver = Driver(run, Goal(start=0), 0.0, settings, odometry=odometry)
    waiting: deque[tuple[float, Observation]] = deque()
    x = speed = commanded = origin = evidence = next_image = 0.0
    failed_at = stopped_at = math.inf
    best = camera_place = k = 0
    while (now := k * STEP) <= min(failed_at + AFTER, 60):
        if failed_at == math.inf and x >= BEFORE + phase * spacing:
            failed_at, origin = now, commanded
        is_failed = failed_at < math.inf
        if now >= next_image - 1e-9 and (failure.images or not is_failed):
            is_good = not is_failed or failure.rate > 0
            has_place = not is_failed or failure.is_matched
            next_image += 1 / (failure.rate if is_failed and failure.rate else rate)
            camera_place = int(x / spacing + 1e-9) if is_good else camera_place
            if camera_place > best and stopped_at == math.inf:
                best, evidence = camera_place, commanded
            swing = failure.swing * (round(now * rate) % 2) if is_failed else 0
            place = camera_place - swing if has_place else driver.expected_place(failure.is_new)
            waiting.append((now + LATENCY, Observation(
                now, place, 0.99 if has_place else math.nan, SIMILAR if place >= 0 else None,
                is_good or failure.is_new,
            )))  # fmt: skip
        while waiting and waiting[0][0] <= now:
            driver.observe(waiting.popleft()[1], now)
        if odometry is not None and k % ODOMETRY == 0 and (failure.odometry or not is_failed):
            odometry.take('odom', now, np.array([x, 0, 0, 0, 0, 0, 1]), now)
        if k % CONTROL == 0:
            driver.press(now)
            command = driver.step(now)
        speed = max(command.speed, speed - BRAKING * STEP)
        commanded += speed * STEP
        x += speed * STEP * (failure.wheels or not is_failed)
        if is_failed and speed == 0 and command.reason:
            stopped_at = min(stopped_at, commanded)
        k += 1
    return stopped_at - evidence, command.reason, commanded - stopped_at, commanded - origin


def table() -> list[str]:
    """Return the lines of the table."""
    columns = [(spacing, rate) for spacing in (0.25, 0.5) for rate in (10.0, 5.0)]
    lines = [
        '| 1 m/s; meters between places, images per second | '
        + ' | '.join(f'{spacing:g} m, {rate:g}/s' for spacing, rate in columns) + ' | reason |',
        '|---' * (len(columns) + 2) + '|',
    ]  # fmt: skip
    for name, failure in FAILURES.items():
        cells, reasons = [], set()
        for column in columns:
            if is_slow(failure):
                meters = meters_per_image(failure, *column)
                reasons = {'it goes on'}
            else:
                drives = [drive(failure, *column, k / PHASES) for k in range(PHASES)]
                meters = max(one[3] if failure.rate else one[0] for one in drives)
                reasons |= {one[1].split(':')[0] for one in drives}
            cells.append(f'{meters:.2f} m')
        lines.append(f'| {name} | {" | ".join(cells)} | {", ".join(sorted(reasons))} |')
    return lines


def meters_per_image(failure: Failure, spacing: float, rate: float) -> float:
    """Return the mean meters between the images of a slow camera, in seconds after its change."""
    return drive(failure, spacing, rate, 0.5)[3] / AFTER / failure.rate


if __name__ == '__main__':
    print('\n'.join(table()))
