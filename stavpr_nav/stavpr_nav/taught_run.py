# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The velocities of the taught run at the places of its map.

They come from the poses of the map, or from a recorded file: CSV with the columns stamp (seconds,
of the clock that stamps the images), speed (m/s) and turn (rad/s, to the left). Both are
integrated between two places, so that a robot that repeats them drives the same distance and turns
by the same angle. Time in which the robot was at rest is left out.
"""

import csv
from pathlib import Path

import numpy as np
from stavpr_nav.follower import TaughtRun
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.units import SECOND

COLUMNS = ['stamp', 'speed', 'turn']
STILL_SPEED, STILL_TURN = 0.02, 0.02  # m/s and rad/s; below both, the robot is at rest
STANDING = 1e-3  # seconds between two places that are left of a time at rest
MAX_GAP = 1.0  # seconds without a velocity that are bridged
MARGIN = 2.0  # seconds before the first and after the last velocity in which places may be


def read_velocities(path: str | Path) -> np.ndarray:
    """
    Read a recorded run; a torn last line is ignored.

    :returns: stamps, speeds and turns, shape (m, 3), float64.
    :raises InputError: not such a file, numbers that are not finite, stamps that decrease.
    """
    try:
        with open(path, newline='', encoding='utf-8') as file:
            head, *rows = csv.reader(file)
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f'{path} cannot be read as a taught run: {error}') from error
    if rows and len(rows[-1]) != len(COLUMNS):
        rows.pop()
    try:
        table = np.array(rows, np.float64)
    except ValueError as error:
        raise InputError(f'{path}: {error}; expected numbers') from error
    if head != COLUMNS or len(table) < 2:
        raise InputError(
            f'{path} has the columns {",".join(head)} and {len(table)} lines: expected '
            f'{",".join(COLUMNS)} and two lines'
        )
    if not np.isfinite(table).all() or (np.diff(table[:, 0]) < 0).any():
        raise InputError(f'{path}: numbers must be finite, and stamps must not decrease')
    return table


def taught_run(place_map: PlaceMap, velocities: np.ndarray | None = None) -> TaughtRun:
    """
    Return the velocities of the taught run at the places of a map.

    :param velocities: stamps, speeds and turns, shape (m, 3); None = from the poses of the map.
    :raises InputError: the map has several sessions, or no stamps; it has no poses, and none are
        needed only with velocities; these do not cover the places.
    """
    stamps = place_map.stamps / SECOND
    if len(stamps) < 2 or (np.diff(stamps) <= 0).any() or len(place_map.sessions) > 1:
        raise InputError(
            f'{len(stamps)} places of {max(1, len(place_map.sessions))} sessions: expected one '
            'session with increasing stamps; `stavpr map sessions --keep` selects it'
        )
    if velocities is None:
        moved, turned = _of_poses(place_map)
        seconds = np.diff(stamps)
        is_moving = (abs(moved) > STILL_SPEED * seconds) | (abs(turned) > STILL_TURN * seconds)
        moving = seconds * is_moving
    else:
        moved, turned, moving = _of_velocities(velocities, stamps)
    if not (moving > 0).any():
        raise InputError('the robot is at rest in the whole taught run')
    seconds = np.maximum(moving, STANDING)
    speeds, turns = moved / seconds, turned / seconds
    # where the robot was at rest, the velocities are the next ones
    following = np.where(moving > STANDING, np.arange(len(moving)), len(moving))
    following = np.minimum.accumulate(following[::-1])[::-1]
    following[following == len(moving)] = np.flatnonzero(moving > STANDING)[-1]
    following = np.append(following, following[-1])
    times = np.concatenate([[0.0], np.cumsum(seconds)])
    return TaughtRun(times, speeds[following], turns[following], place_map.seam)


def _of_poses(place_map: PlaceMap) -> tuple[np.ndarray, np.ndarray]:
    """Return meters forward and radians between the places, shape (n - 1,) each."""
    poses = place_map.poses
    if poses is None or not np.isfinite(poses).all():
        raise InputError(
            'not all places of the map have a pose: record the map with odometry, or velocities '
            'with `ros2 run stavpr_nav teach`'
        )
    x, y, z, w = poses[:, 3:].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    turned = np.diff(yaw)
    heading = yaw[:-1] + turned / 2
    away = np.diff(poses[:, :2], axis=0)
    return away[:, 0] * np.cos(heading) + away[:, 1] * np.sin(heading), turned


def _of_velocities(
    velocities: np.ndarray, stamps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return meters forward, radians and seconds in motion between the places, (n - 1,) each."""
    at = velocities[:, 0]
    if stamps[0] < at[0] - MARGIN or stamps[-1] > at[-1] + MARGIN:
        raise InputError(
            f'the velocities are of {at[0]:.1f} to {at[-1]:.1f} s, the places of {stamps[0]:.1f} '
            f'to {stamps[-1]:.1f} s: record both in the same drive, by the same clock'
        )
    steps = np.diff(at)
    constant = velocities[:-1, 1:] * (steps <= MAX_GAP)[:, None]  # until the next one
    is_moving = (abs(constant) > (STILL_SPEED, STILL_TURN)).any(axis=1)
    columns = np.column_stack([constant, is_moving]) * steps[:, None]
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(columns, axis=0)])
    moved, turned, moving = (np.diff(np.interp(stamps, at, each)) for each in sums.T)
    return moved, turned, moving
