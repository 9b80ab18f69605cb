# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of poses: a line an image."""

import csv
from pathlib import Path

import numpy as np
from stavpr_ros.errors import SourceError
from stavpr_ros.regular_file import require_regular


def read_poses(path: Path) -> tuple[np.ndarray, bool]:
    """
    Read poses as ``build_map --poses`` takes them: x,y,z or x,y,z,qx,qy,qz,qw a line, meters.

    :returns: shape (images, 7), float64, and whether the file has orientations.
    :raises SourceError: the file cannot be read.
    """
    try:
        require_regular(path)
        with path.open(newline='') as file:
            lines = [row for row in csv.reader(file) if row and row[0][:1] != '#']
            rows = [[float(value) for value in row] for row in lines]
    except (OSError, ValueError) as error:
        raise SourceError(f'poses {path} cannot be read: {error}') from error
    if {len(row) for row in rows} not in ({3}, {7}):
        raise SourceError(f'poses {path}: expected 3 or 7 numbers on every line')
    poses = np.array(rows)
    if not np.isfinite(poses).all():
        raise SourceError(f'poses {path}: expected finite numbers')
    has_rotations = poses.shape[1] == 7
    if not has_rotations:
        poses = np.hstack([poses, np.tile([0.0, 0.0, 0.0, 1.0], (len(poses), 1))])
    return poses, has_rotations
