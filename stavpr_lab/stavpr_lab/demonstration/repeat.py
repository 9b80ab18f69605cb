# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Teach and repeat in a simulator: a robot with differential drive on the synthetic street.

The image is rendered where the robot is; recognition, offset and control law get nothing but the
images. Wheels slip and pull to one side, images arrive late, and single images are lost. Poses are
x, y (meters) and heading (radians, to the left). ``python3 -m stavpr_lab.demonstration.repeat
FOLDER`` drives ten laps by day, at dusk and in the rain, and the stops, and writes a table and a
plot from above; ``--length 150 --laps 1`` drives one shorter lap, and writes its animation too.
"""

import argparse
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from stavpr_lab.demonstration import FEATURES
from stavpr_lab.demonstration.street.laps import RingWorld
from stavpr_lab.demonstration.street.rendering import render
from stavpr_lab.demonstration.street.street import CELL
from stavpr_lab.demonstration.street.surfaces import noise
from stavpr_lab.demonstration.street.traverses import (
    AFTERNOON,
    Conditions,
    EPOCH,
    GOOD_LIGHT,
    LANE,
    LENGTH,
    RAINY_DUSK,
    Traverse,
)
from stavpr_lab.style import CYCLE, DASHES, legend_above, page
from stavpr_nav.evidence import ImageComparison
from stavpr_nav.follower import FollowerSettings, RouteFollower, TaughtRun
from stavpr_nav.observation import Observation
from stavpr_ros import Localizer
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, Map
from stavpr_ros.palette import GRAY, QUIET
from stavpr_ros.progress import Progress
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter
from stavpr_ros.sources.frame import Frame
from tqdm import tqdm

RATE, SPEED = 5.0, 2.5  # images per second; m/s of the taught run
STEP = 0.05  # seconds of the simulation, and of the control
LATENCY, LOSS = 0.15, 0.05  # seconds until an image is processed; share of images that are lost
SLIP, SLIP_TURN = 0.05, 0.05  # deviations of the wheels' slip, shares; constant over seconds
CONVERGENCE = 20.0  # meters at the start that are not counted
OPERATOR_DELAY = 1.0  # seconds until the operator lets a robot go on that stopped without evidence
BRAKING, LAG = 5.0, 0.15  # m/s^2; time constant of the drive, seconds
CONDITIONS = {
    'day': replace(GOOD_LIGHT, traffic=5),
    'dusk': replace(RAINY_DUSK, lane=LANE, rain=0.0, fog=0.002, traffic=3),
    'rain': replace(AFTERNOON, lane=LANE, rain=0.4, fog=0.004, clouds=1.0, sun=0.0, traffic=4),
}


class Lap(NamedTuple):
    """Light, pull to the left (rad/m), and where the robot starts (meters left of the path)."""

    light: str
    pull: float
    left: float


LAPS = [
    Lap('day', 0.01, 1), Lap('dusk', 0.01, -1), Lap('rain', 0.01, 1), Lap('day', -0.01, -1),
    Lap('dusk', -0.01, 1), Lap('rain', -0.01, -1), Lap('day', 0.02, 1), Lap('dusk', 0.0, -1),
    Lap('rain', 0.0, 1), Lap('day', 0.0, -1),
]  # fmt: skip
START_ANGLE = math.radians(10)  # at the start, away from the path
CHANGE_TIME = 15.0  # seconds until the image changes in the drives that have to stop
INTERVAL, MILLISECONDS, QUALITY = 5, 150, 40  # images per drawn one; time of each; of WebP


class View(Traverse):
    """The street as a camera at any pose shows it."""

    def __init__(self, world: RingWorld, conditions: Conditions) -> None:
        super().__init__(world, np.zeros(1), np.zeros(1, bool), conditions)
        self._line = world.center_line[:-1]

    def image(self, pose: np.ndarray, number: int) -> np.ndarray:
        """Render the image at a pose, RGB; cars drive and the camera shakes by its number."""
        along, across = self.on_street(pose)
        yaw = self._line[int(along / CELL), 2] - pose[2]
        shake = math.radians(self._conditions.shake) * math.sin(number * 2.4)
        self.along = np.full(number + 1, along)
        traffic = np.concatenate([self._parked[0], self._driving(number)])
        return render(
            self._streets[0], along, across, shake, math.remainder(yaw, 2 * math.pi), self._light,
            traffic, number * 7919 + self._conditions.traffic, *self._size,
        )  # fmt: skip

    def on_street(self, pose: np.ndarray) -> tuple[float, float]:
        """Return meters along the street, and to the right of its center line."""
        away = pose[:2] - self._line[:, :2]
        cell = int(np.argmin(np.einsum('ij,ij->i', away, away)))
        for _ in range(2):  # the nearest start of a cell may be of the next one
            x, y, heading = self._line[cell]
            ahead = (pose[0] - x) * math.cos(heading) + (pose[1] - y) * math.sin(heading)
            if ahead >= 0:
                break
            cell = (cell - 1) % len(self._line)
        across = (pose[0] - x) * math.sin(heading) - (pose[1] - y) * math.cos(heading)
        return cell * CELL + min(max(ahead, 0.0), CELL * 0.999), across


@dataclass(frozen=True, eq=False)
class Taught:
    """
    A taught route.

    :param poses: at the places, shape (n, 3).
    """

    world: RingWorld
    place_map: Map
    run: TaughtRun
    poses: np.ndarray

    def error(self, pose: np.ndarray) -> tuple[float, float]:
        """Return how far left of the path a pose is, meters, and its heading error, radians."""
        away = pose[:2] - self.poses[:, :2]
        place = int(np.argmin(np.einsum('ij,ij->i', away, away)))
        heading = self.poses[place, 2]
        left = away[place] @ [-math.sin(heading), math.cos(heading)]
        return float(left), math.remainder(pose[2] - heading, 2 * math.pi)


def teach(world: RingWorld, begin: float = 0.0, length: float = LENGTH) -> Taught:
    """Drive along a part of the street by day, and record images and velocities."""
    along = begin + np.arange(0, length, SPEED / RATE)
    line, cells = world.center_line, np.arange(len(world.center_line)) * CELL
    across = LANE + 0.5 * (np.array([noise(meters / 17.0, 0.0, 1) for meters in along]) - 0.5)
    x, y, heading = (np.interp(along, cells, column) for column in line.T)
    x, y = x + across * np.sin(heading), y - across * np.cos(heading)
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    poses = np.column_stack([x, y, heading])
    times = np.arange(len(along)) / RATE
    view = View(world, GOOD_LIGHT)
    frames = (
        Frame(view.image(pose, k), EPOCH + round(times[k] * 1e9), '')
        for k, pose in enumerate(poses)
    )
    speeds = np.hypot(np.gradient(x), np.gradient(y)) * RATE
    run = TaughtRun(times, speeds, np.gradient(heading) * RATE)
    place_map = build_map(frames, FeatureExtractor(FEATURES), progress=False)
    return Taught(world, place_map, run, poses)


class Robot:
    """
    A robot with differential drive, whose wheels slip.

    :param pull: rad/m that it turns to the left by itself.
    """

    def __init__(self, pose: np.ndarray, dice: np.random.Generator, pull: float = 0.0) -> None:
        self.pose, self._dice, self._pull = pose.copy(), dice, pull
        self.speed = self.turn = 0.0
        self._slip = np.zeros(2)

    def move(self, speed: float, turn: float) -> None:
        """Move for one step of the simulation."""
        share = 1 - math.exp(-STEP / LAG)
        self.speed = max(self.speed + share * (speed - self.speed), self.speed - BRAKING * STEP)
        self.turn += share * (turn - self.turn)
        keep = math.exp(-STEP / 2.0)  # the slip changes over 2 s
        fresh = self._dice.normal(size=2) * (SLIP, SLIP_TURN) * math.sqrt(1 - keep**2)
        self._slip = keep * self._slip + fresh
        speed = self.speed * (1 + self._slip[0])
        turn = self.turn * (1 + self._slip[1]) + self._pull * speed
        middle = self.pose[2] + turn * STEP / 2
        self.pose += STEP * np.array([speed * math.cos(middle), speed * math.sin(middle), turn])


class Autopilot:
    """The software on the robot: it gets images, and returns velocities."""

    def __init__(self, taught: Taught) -> None:
        settings = FollowerSettings(max_speed=SPEED, max_acceleration=2.0)
        self.follower = RouteFollower(taught.run, settings)
        self._map, self._offset = taught.place_map, OffsetFilter()
        self._comparison = ImageComparison()
        self._localizer = Localizer(self._map)
        self.observation: Observation | None = None

    def process(self, image: np.ndarray, stamp: float) -> Observation:
        """Return what an image shows."""
        match = self._localizer(image, EPOCH + round((stamp + 1e5) * 1e9))
        place, probability, offset = match.newest, match.probability, None
        if place < 0:
            place, probability = self.follower.expected_place(), math.nan
        if place >= 0:
            thumbnail = self._map.thumbnail(place)
            assert thumbnail is not None
            offset = self._offset.update(describe_columns(image), describe_columns(thumbnail))
        else:
            self._offset.reset()
        return Observation(stamp, place, probability, offset, self._comparison.is_new(image))


@dataclass(frozen=True, eq=False)
class Drive:
    """
    A drive of the robot, by steps of the simulation.

    :param times: seconds, shape (n,).
    :param poses: shape (n, 3); errors: meters to the left of the path and radians, shape (n, 2).
    :param speeds: m/s, shape (n,).
    :param reasons: why the robot did not move, n texts.
    :param presses: times that the operator let it go on.
    """

    times: np.ndarray
    poses: np.ndarray
    errors: np.ndarray
    speeds: np.ndarray
    reasons: list[str]
    presses: int = 0

    def within(self, meters: float, after: float = CONVERGENCE) -> float:
        """Return the share of the distance within a bound of the path, after a start."""
        distances = np.cumsum(self.speeds) * STEP
        part = distances > after
        weights = self.speeds[part]
        return float((weights * (abs(self.errors[part, 0]) <= meters)).sum() / weights.sum())


def repeat(
    taught: Taught, conditions: Conditions, seconds: float, begin: int = 0,
    left: float = 1.0, turned: float = START_ANGLE, seed: int = 0, pull: float = 0.01,
    change: Callable[[np.ndarray, float], np.ndarray] = lambda image, time: image,
    world: RingWorld | None = None, has_operator: bool = True,
) -> Drive:  # fmt: skip
    """
    Repeat a taught route in the simulator.

    :param begin: place at which the robot starts, ``left`` meters and ``turned`` radians off; the
        operator states it.
    :param pull: rad/m that the robot turns to the left by itself.
    :param change: returns the image that the camera delivers at a time.
    :param world: another one than the taught one.
    :param has_operator: an operator lets the robot go on that waits without evidence of motion.
    """
    dice = np.random.default_rng(seed)
    view = View(world or taught.world, conditions)
    pose = taught.poses[begin] + [0, 0, turned]
    heading = taught.poses[begin, 2]
    pose[:2] += left * np.array([-math.sin(heading), math.cos(heading)])
    robot, pilot = Robot(pose, dice, pull), Autopilot(taught)
    pilot.follower.start(begin)
    waiting: deque[tuple[float, Observation]] = deque()
    rows, reasons, presses, blocked_at = [], [], 0, math.inf
    for k in range(round(seconds / STEP)):
        time = k * STEP
        if k % round(1 / RATE / STEP) == 0 and dice.random() >= LOSS:
            image = change(view.image(robot.pose, k), time)
            waiting.append((time + LATENCY, pilot.process(image, time)))
        while waiting and waiting[0][0] <= time:
            pilot.follower.observe(waiting.popleft()[1], time)
        command = pilot.follower.command(time)
        robot.move(command.speed, command.turn)
        rows.append((time, *robot.pose, *taught.error(robot.pose), robot.speed))
        reasons.append(command.reason)
        blocked_at = min(blocked_at, time) if pilot.follower.evidence.is_missing else math.inf
        if has_operator and time - blocked_at >= OPERATOR_DELAY:
            presses, blocked_at = presses + 1, math.inf
            pilot.follower.restart()
        if command.reason == 'end of the route' and robot.speed < 0.01:
            break
    table = np.array(rows)
    return Drive(table[:, 0], table[:, 1:4], table[:, 4:6], table[:, 6], reasons, presses)


def plot(taught: Taught, drives: list[tuple[str, Drive]], path: Path) -> None:
    """Draw the drives from above, and their error over the distance, a color for each light."""
    with page(path, 11, 5) as figure:
        above, over = figure.subplots(1, 2)
        above.plot(*taught.poses[:, :2].T, color=GRAY, lw=6, alpha=0.5, label='taught')
        for light, color, line in zip(CONDITIONS, CYCLE, ('-', '--', '-.'), strict=False):
            for k, drive in enumerate(drive for name, drive in drives if name == light):
                label = '' if k else light
                style = {'color': color, 'ls': line, 'lw': 1.2, 'label': label}
                above.plot(*drive.poses[:, :2].T, **style)
                over.plot(np.cumsum(drive.speeds) * STEP, drive.errors[:, 0], **style)
        above.set(xlabel='x (m)', ylabel='y (m)')
        above.set_aspect('equal', adjustable='datalim')
        over.set(xlabel='driven (m)', ylabel='left of the taught path (m)', ylim=(-2, 2))
        for limit in (-0.5, 0.5):
            over.axhline(limit, color=QUIET, lw=1.3, ls=DASHES)
        legend_above(above, 4)


def animate(taught: Taught, drive: Drive, images: list[np.ndarray], path: Path) -> None:
    """Write the images of a drive beside the path from above, as WebP."""
    frames, file = [], path.with_name('frame.png')
    for number in range(0, len(images), INTERVAL):
        step = min(len(drive.times) - 1, number * len(drive.times) // len(images))
        with page(file, 7, 2.6) as figure:
            camera, above = figure.subplots(1, 2)
            camera.imshow(images[number])
            camera.set_axis_off()
            camera.set_title(drive.reasons[step] or f'{drive.speeds[step]:.1f} m/s')
            above.plot(*taught.poses[:, :2].T, color=GRAY, lw=6, alpha=0.5)
            above.plot(*drive.poses[: step + 1, :2].T)
            above.plot(*drive.poses[step, :2], 'o')
            above.set(aspect='equal', xlabel='x (m)', ylabel='y (m)')
            above.set_title(f'{drive.errors[step, 0]:+.2f} m left of the path')
        frames.append(Image.open(file).convert('RGB'))
    file.unlink()
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0,
        quality=QUALITY,
    )  # fmt: skip


def stops(taught: Taught) -> dict[str, float]:
    """Return the seconds until the robot is at rest, after the camera shows something else."""
    other = View(RingWorld(11), GOOD_LIGHT)
    dice = np.random.default_rng(0)
    images: list[np.ndarray] = []

    def cover(image: np.ndarray) -> np.ndarray:
        return dice.normal(15, 3, image.shape).clip(0, 255).astype(np.uint8)

    def replace_route(_: np.ndarray) -> np.ndarray:
        x, y, heading = other._line[round(SPEED / RATE / CELL * len(images))]
        images.append(other.image(np.array([x, y - LANE, heading]), len(images)))
        return images[-1]

    def freeze(image: np.ndarray) -> np.ndarray:
        images.append(image)
        return images[0]

    changes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        'is covered': cover,
        'shows another route': replace_route,
        'repeats one image': freeze,
    }
    result = {}
    for name, change in changes.items():
        images.clear()

        def switch(
            image: np.ndarray,
            time: float,
            change: Callable[[np.ndarray], np.ndarray] = change,
        ) -> np.ndarray:
            return change(image) if time >= CHANGE_TIME else image

        drive = repeat(taught, GOOD_LIGHT, CHANGE_TIME + 5, 10, change=switch, has_operator=False)
        is_later = drive.times >= CHANGE_TIME
        at_rest = np.flatnonzero(is_later & (drive.speeds < 0.05))
        result[name] = float(drive.times[at_rest[0]] - CHANGE_TIME) if len(at_rest) else math.inf
    return result


def main() -> None:
    """Drive the laps and the stops, and write tables, a plot and an animation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--length', type=float, default=LENGTH, help='of a lap, meters')
    parser.add_argument('--laps', type=int, default=len(LAPS))
    arguments = parser.parse_args()
    length, folder = arguments.length, arguments.folder
    taught, drives = teach(RingWorld(), 0.0, length), []
    images: list[np.ndarray] = []
    lines = [
        '| lap | pull, rad/m | driven | time | at rest | presses | within 0.5 m | within 1 m '
        '| largest | mean | RMS |',
        '|---|---|---|---|---|---|---|---|---|---|---|',
    ]
    for seed, lap in enumerate(Progress(LAPS[: arguments.laps], desc='repeat', unit='lap')):

        def keep(image: np.ndarray, _: float) -> np.ndarray:
            if arguments.laps == 1:
                images.append(image)
            return image

        drive = repeat(
            taught, CONDITIONS[lap.light], 2 * length / SPEED + 60, 10, lap.left,
            math.copysign(START_ANGLE, lap.left), seed, lap.pull, keep,
        )  # fmt: skip
        drives.append((lap.light, drive))
        meters = np.cumsum(drive.speeds) * STEP
        error = drive.errors[meters > CONVERGENCE, 0]
        lines.append(
            f'| {lap.light} | {lap.pull:+.2f} | {meters[-1]:.0f} m | {drive.times[-1]:.0f} s '
            f'| {(drive.speeds < 0.02).sum() * STEP:.0f} s | {drive.presses} '
            f'| {drive.within(0.5):.1%} | {drive.within(1.0):.1%} '
            f'| {abs(error).max(initial=0):.2f} m '
            f'| {error.mean():+.2f} m | {np.sqrt(np.mean(error**2)):.2f} m |'
        )
        tqdm.write(lines[-1])
    lines += ['', '| the camera, at 2.5 m/s | at rest after |', '|---|---|']
    lines += [f'| {name} | {seconds:.1f} s |' for name, seconds in stops(taught).items()]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / 'repeat_table.md').write_text('\n'.join(lines) + '\n')
    print('\n'.join(lines))
    plot(taught, drives, folder / 'repeat.png')
    if images:
        animate(taught, drive, images, folder / 'repeat.webp')


if __name__ == '__main__':
    main()
