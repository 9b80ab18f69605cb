# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of poses: a line an image."""

from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
import re

import numpy as np
from stavpr_ros.sources.notes import note_once
from stavpr_ros.sources.table import by_name, FILE, is_counted, is_stamps, Table

EXPECTED = (
    'a line an image, in meters: x y z; x y z qx qy qz qw; stamp x y z qx qy qz qw (TUM); or a '
    '3x4 matrix in rows, 12 numbers (KITTI)'
)
NUMBERS = 3, 7, 12  # numbers that a pose may have
POSITION = re.compile(r'((.*[._])?(position|pos|translation|p|t)(_.*)?[._]?)?([xyz])')
ROTATION = re.compile(r'(.*[._])?(orientation|quaternion|quat|rotation|rot|q)(_.*)?[._]?([xyzw])')
DEGREES = re.compile(
    r'(.*[._])?((lat|lon|lng|long)(itude)?|yaw|pitch|roll|theta|heading|bearing)(_.*)?'
)
KEY = re.compile(
    r'(.*[._])?(image|img|frame|file|name|id|idx|index|number|seq|stamp|time|t)[a-z]*(_.*)?'
)
NUMBER = re.compile(r'\d+(?:\.\d+)?')
MAX_LISTED = 3  # names that an error lists
STEPS, MIN_MOVES, ALIKE = (0.004, 40.0), 9, 0.9  # meters an image; images; cosine
NORMS = 0.9, 1.1  # range of the norm of a quaternion of a few digits
MAX_STEP, MAX_EXTENT = 3e-4, 0.5  # positions in degrees: median step, extent; too small in meters


def read_poses(path: Path, images: Sequence[str] = ()) -> tuple[np.ndarray, bool]:
    """
    Read the poses of images from a table, :data:`EXPECTED` a line, or with names of its columns.

    :param images: names of the images. Where the table names them, by files, numbers or stamps,
        the poses are in their order; lines of no image are left out, with a warning.
    :returns: shape (images, 7), float64, and whether the file has orientations.
    :raises SourceError: the file cannot be read, has numbers of another unit or kind, or names
        images, but not all of ``images``.
    """
    table = Table(path, 'poses', EXPECTED)
    names = [re.sub(r'\s*[\[(].*', '', name).replace(' ', '_').casefold() for name in table.names]
    columns = _columns(names)
    if columns is None and any(map(DEGREES.fullmatch, names)):
        raise table.error(
            f'its columns are {", ".join(names)}: project latitudes and longitudes to meters '
            '(UTM), and convert angles to a quaternion'
        )
    rows = table.numbers(columns)
    rows_of = _rows_of(table, names, columns, images)
    if not np.isfinite(rows).all():
        raise table.error('a number is not finite', int(np.argmin(np.isfinite(rows).all(axis=1))))
    if columns is None:
        first, width = rows[:, 0], rows.shape[1]
        by_number = rows_of is not None and not table.labels
        numbered = by_number or is_stamps(first) or is_counted(first)
        if width == 8 and not by_number and (np.diff(first) < 0).any():
            raise table.error('it has 8 columns, but the first one falls and is no stamp')
        if width - 1 in NUMBERS and (numbered or width == 8):
            rows = rows[:, 1:]
        elif width not in NUMBERS:
            angles = '; angles must be a quaternion' if width == 6 else ''
            raise table.error(f'it has {width} numbers in a line{angles}')
    positions = rows[:, 3::4] if rows.shape[1] == 12 else rows[:, :3]
    if any(map(is_stamps, positions.T)):
        raise table.error('one of its positions is a stamp')
    if _in_degrees(positions[:, :2]):
        raise table.error(
            'its positions move by fractions of a millimeter an image, as latitudes and '
            'longitudes do, project them to meters (UTM); if they are meters, subtract the first'
        )
    oriented = rows.shape[1] > 3
    if rows.shape[1] == 12:
        rows = _of_matrices(table, rows.reshape(-1, 3, 4))
    elif not oriented:
        rows = np.hstack([rows, np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1))])
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    if ((norms < NORMS[0]) | (norms > NORMS[1])).any():
        row = int(np.argmax(abs(norms - 1)))
        raise table.error(f'a quaternion of norm {norms[row]:.3g} instead of 1', row)
    rows = rows if rows_of is None else rows[rows_of]
    if doubt := _doubt(rows, oriented):
        note_once(f'poses {path}: {doubt}')
    return rows, oriented


def _rows_of(
    table: Table, names: list[str], columns: list[int] | None, images: Sequence[str]
) -> np.ndarray | None:
    """Return the row of each image by its name, number or stamp; None = they are not named."""
    keys, image_keys = table.labels, list(images)
    if not keys:
        ids = [0] if columns is None and table.width - 1 in NUMBERS else []
        if columns is not None:
            ids = [i for i, name in enumerate(names) if i not in columns and KEY.fullmatch(name)]
        if not ids:
            return None
        keys = [str(key) for key in table.numbers(ids[:1])[:, 0].tolist()]
        numbers = [NUMBER.findall(PureWindowsPath(image).stem) for image in images]
        image_keys = [str(float(number[-1])) if number else '' for number in numbers]
    rows = by_name(image_keys, keys)
    missing = [image for image, row in zip(images, rows, strict=True) if row < 0]
    is_text = table.labels and (len(missing) < len(images) or FILE.fullmatch(keys[0]))
    if not images or len({*image_keys}) < len({*images}) or (missing and not is_text):
        return None
    if missing:
        raise table.error(
            f'it names {_join(keys)}, but {len(missing)} images not, {_join(missing)}'
        )
    if others := [keys[row] for row in sorted({*range(len(keys))} - {*rows.tolist()})]:
        note_once(f'poses {table.path}: {len(others)} lines are of no image: {_join(others)}')
    return rows


def _join(names: Sequence[str]) -> str:
    return ', '.join(names[:MAX_LISTED]) + (' ...' if len(names) > MAX_LISTED else '')


def _doubt(poses: np.ndarray, oriented: bool) -> str:
    """Return what is seldom true of poses in meters with quaternions x y z w; '' = nothing."""
    moves = np.diff(poses[:, :3], axis=0)
    steps = np.linalg.norm(moves, axis=1)
    if len(moves) < MIN_MOVES or not steps.any():
        return 'all positions are equal: are they of this drive?' if len(moves) else ''
    step = float(np.median(steps[steps > 0]))
    if not STEPS[0] <= step <= STEPS[1]:
        return f'the positions move by {step:.3g} m an image: are they in another unit?'
    heading, yaw = np.arctan2(moves[:, 1], moves[:, 0]), poses[:-1, 2]
    for unit, name in ((1.0, 'radians'), (np.pi / 180, 'degrees')):
        if np.mean(np.cos(unit * yaw - heading)) > ALIKE and np.ptp(unit * yaw) > 1 - ALIKE:
            return f'z follows the direction of travel: is it a yaw in {name}?'
    if oriented and abs(poses[:, 4:6]).max() < 1 - ALIKE and np.mean(poses[:, 3] ** 2) > 0.5:
        return 'the quaternions turn about x, upside down: are they w x y z?'
    return ''


def _columns(names: list[str]) -> list[int] | None:
    """Return the columns of a pose by their names; None = they name none."""
    columns: dict[str, int] = {}
    for i, name in enumerate(names):
        if match := ROTATION.fullmatch(name):
            columns.setdefault(f'q{match[4]}', i)
        elif match := POSITION.fullmatch(name):
            columns.setdefault(match[5], i)
    if not columns.keys() >= set('xyz'):
        return None
    rotation = [columns.get(f'q{axis}', -1) for axis in 'xyzw']
    return [columns[axis] for axis in 'xyz'] + (rotation if min(rotation) >= 0 else [])


def _of_matrices(table: Table, matrices: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    turns = matrices[:, :, :3]
    errors = abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (errors > 1 - NORMS[0]) | (np.linalg.det(turns) < 0)
    if bad.any():
        raise table.error('its 12 numbers have no rotation matrix', int(np.argmax(bad)))
    return np.hstack([matrices[:, :, 3], Rotation.from_matrix(turns).as_quat()])


def _in_degrees(positions: np.ndarray) -> bool:
    """Return whether x and y of a drive are latitudes and longitudes in any order."""
    if len(positions) < 10 or (abs(positions) > 180).any() or abs(positions).max() < 1:
        return False
    step = float(np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    extent = float(np.ptp(positions, axis=0).max())
    return 0 < step < MAX_STEP and 5 * step < extent < MAX_EXTENT
