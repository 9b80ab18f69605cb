# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The velocities of the taught run at the places of its map.

They come from the poses of the map, or from a recorded file: CSV with the columns stamp (seconds,
of the clock that stamps the images), speed (m/s) and turn (rad/s, to the left), and the session of
the map that it is of, in a line ``# session: ID``. Both are integrated between two places, so that
a robot that repeats them drives the same distance and turns by the same angle. Time in which the
robot was at rest is left out.

The places of the other sessions of the map serve recognition: what matches them is at a position
along the taught session.
"""

import csv
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
import re

import numpy as np
from stavpr_nav.follower import TaughtRun
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import Map
from stavpr_ros.units import SECOND

COLUMNS = ['stamp', 'speed', 'turn']
STILL_SPEED, STILL_TURN = 0.02, 0.02  # m/s and rad/s; below both, the robot is at rest
REST_SECONDS = 1e-3  # seconds between two places that remain of a time at rest
MAX_GAP = 1.0  # seconds without a velocity that are bridged
MARGIN = 2.0  # seconds before the first and after the last velocity in which places may be
SESSION = '# session: '  # begins the line that names the session of a run
MAX_UNRELATED = 20  # places in a row of another session whose position is between their neighbors


def read_velocities(path: str | Path) -> tuple[np.ndarray, str]:
    """
    Read a recorded run; a torn last line is ignored.

    :returns: stamps, speeds and turns, shape (m, 3), float64; id of the session, '' = not named.
    :raises InputError: not such a file, numbers that are not finite, stamps that decrease.
    """
    try:
        with open(path, newline='', encoding='utf-8') as file:
            lines = file.readlines()
        head, *rows = csv.reader(line for line in lines if not line.startswith('#'))
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
    names = [line for line in lines if line.startswith(SESSION) and line.endswith('\n')]
    return table, names[-1].removeprefix(SESSION).strip() if names else ''


def taught_places(
    place_map: Map, velocities: np.ndarray | None = None, session: str = ''
) -> np.ndarray:
    """
    Return the places of the taught session, in the order of the run, shape (n,).

    They are of the first session whose stamps are within the velocities, if there are any. An
    update of the map may have divided a session: its parts are ``ID``, ``ID-2`` and so on.

    :param velocities: velocities of the run, see :func:`taught_run`.
    :param session: id of the session, '' = any.
    :raises InputError: the map has no such session.
    """
    index, sessions = place_map.session_index, place_map.sessions
    if index is None or len(sessions) == 1:
        return np.arange(len(place_map))

    numbers = np.unique(index[_is_covered(place_map.stamps / SECOND, velocities)]).tolist()
    name = session or next((sessions[number].id for number in numbers), '')
    of_name = re.compile(rf'{re.escape(name)}(-\d+)*')
    parts = [number for number in numbers if of_name.fullmatch(sessions[number].id)]
    if not parts:
        raise InputError(
            f'no session {session!r} of the map was recorded with the velocities: it has '
            f'{[s.id for s in sessions]}; correct the line {SESSION!r} of the run, or take '
            'map and run of one drive'
        )
    is_same = [replace(entry, id='') == replace(sessions[parts[0]], id='') for entry in sessions]
    return np.flatnonzero(np.isin(index, [number for number in parts if is_same[number]]))


def positions(place_map: Map, taught: np.ndarray) -> np.ndarray:
    """
    Return the position of each place of the map among the taught ones, (N,), int; -1 = unknown.

    Of a place of another session it is the one of the taught place that shows the same. Where a
    few are related to none, it is between the positions of their neighbors.

    :param taught: places of the taught session, ascending, shape (n,).
    """
    roots = np.arange(len(place_map)) if place_map.same_as is None else place_map.same_as
    numbers, of_root = np.arange(len(taught)), np.full(len(place_map), -1)
    of_root[roots[taught][::-1]] = numbers[::-1]  # the first one of several
    result = of_root[roots]
    result[taught] = numbers
    if (index := place_map.session_index) is None:
        return result
    for before, after in pairwise(np.flatnonzero(result >= 0).tolist()):
        gap, ahead = after - before, result[after] - result[before]
        is_short = 1 < gap <= MAX_UNRELATED and index[before] == index[after]
        if is_short and 0 <= ahead <= 2 * gap:
            steps = np.arange(1, gap) / gap
            result[before + 1 : after] = np.rint(result[before] + steps * ahead)
    return result


def taught_run(
    place_map: Map, velocities: np.ndarray | None = None, taught: np.ndarray | None = None
) -> TaughtRun:
    """
    Return the velocities of the taught run at its places of a map.

    :param velocities: stamps, speeds and turns, shape (m, 3); None = from the poses of the map.
    :param taught: the places, see :func:`taught_places`; None = all.
    :raises InputError: the places have no stamps; they have no poses, and none are needed only
        with velocities; these do not cover the places.
    """
    if taught is None:
        taught = np.arange(len(place_map))
    stamps = _stamps(place_map.stamps[taught] / SECOND, velocities)
    if len(stamps) < 2 or (np.diff(stamps) <= 0).any():
        raise InputError(f'{len(stamps)} places: expected two with increasing stamps')
    if velocities is None:
        meters, radians = _of_poses(None if place_map.poses is None else place_map.poses[taught])
        seconds = np.diff(stamps)
        is_moving = (abs(meters) > STILL_SPEED * seconds) | (abs(radians) > STILL_TURN * seconds)
        moving = seconds * is_moving
    else:
        meters, radians, moving = _of_velocities(velocities, stamps)
    if not (moving > 0).any():
        raise InputError('the robot is at rest in the whole taught run')
    seconds = np.maximum(moving, REST_SECONDS)
    speeds, turns = meters / seconds, radians / seconds
    # where the robot was at rest, the velocities are the next ones
    following = np.where(moving > REST_SECONDS, np.arange(len(moving)), len(moving))
    following = np.minimum.accumulate(following[::-1])[::-1]
    following[following == len(moving)] = np.flatnonzero(moving > REST_SECONDS)[-1]
    following = np.append(following, following[-1])
    times = np.concatenate([[0.0], np.cumsum(seconds)])
    seam = None
    if place_map.same_as is not None:
        roots = place_map.same_as[taught]
        first = int(np.argmax(roots == roots[-1]))
        seam = first if 2 * first < len(taught) - 1 else None
    return TaughtRun(times, speeds[following], turns[following], seam)


def _stamps(stamps: np.ndarray, velocities: np.ndarray | None) -> np.ndarray:
    """Return the stamps of places, between those beside where an update renewed the images."""
    is_own = _is_covered(stamps, stamps[[0, -1], None] if velocities is None else velocities)
    is_own[[0, -1]] = True
    return np.interp(np.arange(len(stamps)), np.flatnonzero(is_own), stamps[is_own])


def _is_covered(stamps: np.ndarray, velocities: np.ndarray | None) -> np.ndarray:
    """Return which stamps are within the velocities; all without them."""
    first, last = velocities[[0, -1], 0] if velocities is not None else (-np.inf, np.inf)
    return np.asarray((stamps >= first - MARGIN) & (stamps <= last + MARGIN))


def _of_poses(poses: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return meters forward and radians between the places, shape (n - 1,) each."""
    if poses is None or not np.isfinite(poses).all():
        raise InputError(
            'not all places of the map have a pose: record the map with odometry, or velocities '
            'with `ros2 run stavpr_nav teach`'
        )
    x, y, z, w = poses[:, 3:].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    radians = np.diff(yaw)
    heading = yaw[:-1] + radians / 2
    away = np.diff(poses[:, :2], axis=0)
    return away[:, 0] * np.cos(heading) + away[:, 1] * np.sin(heading), radians


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
    meters, radians, moving = (np.diff(np.interp(stamps, at, column)) for column in sums.T)
    return meters, radians, moving
