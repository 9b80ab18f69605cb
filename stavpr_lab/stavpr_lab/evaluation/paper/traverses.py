# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Traverses of public data sets whose images have positions, in their published layouts."""

from collections.abc import Callable, Sequence
import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from stavpr_lab.evaluation.drive import ChangedSource, FrameSource
from stavpr_ros.errors import SourceError
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.frame import Frame
from stavpr_ros.sources.order import natural_key

SPACING = 2.0  # meters between images of RobotCar, which has 16 a second


@dataclass(frozen=True)
class PosedTraverse:
    """
    Images with positions.

    :param source: n images in the order of the drive.
    :param poses: x y z (meters), quaternion x y z w of each image, shape (n, 7).
    :param counted: whether an image counts as a query, shape (n,), bool.
    """

    source: FrameSource
    poses: np.ndarray
    counted: np.ndarray


Reader = Callable[[Path], PosedTraverse]


def read_traverse(reader: Reader, folder: Path) -> PosedTraverse:
    """
    Read a traverse in one of the layouts below.

    :raises SourceError: a file is missing, or is not in the layout.
    """
    try:
        return reader(folder)
    except (OSError, KeyError, ValueError, IndexError, csv.Error) as error:
        raise SourceError(
            f'{folder} is not in its published layout (docs/datasets.md): {type(error).__name__}: '
            f'{error}'
        ) from error


def utm_names(folder: Path) -> PosedTraverse:
    """Read the format of VPR-datasets-downloader: images ``@easting@northing@...@.jpg``."""
    images = FolderSource(folder)
    # the eighth field, pano_id, and later ones follow the order of the recording
    images.files.sort(key=lambda file: list(map(natural_key, file.name.split('@')[7:])))
    positions = [[float(field) for field in file.name.split('@')[1:3]] for file in images.files]
    return PosedTraverse(images, _poses(positions), np.ones(len(images), bool))


def msls(folder: Path) -> PosedTraverse:
    """Read ``query`` or ``database`` of a city of Mapillary Street-Level Sequences."""
    names = ('raw', 'postprocessed', 'subtask_index')
    tables = [_table(folder / f'{name}.csv') for name in names]
    rows = [row | derived | task for row, derived, task in zip(*tables, strict=True)]
    rows = [row for row in rows if row['pano'] == 'False']
    images = FolderSource(folder / 'images')
    images.files = [folder / 'images' / f'{row["key"]}.jpg' for row in rows]
    positions = [[float(row['easting']), float(row['northing'])] for row in rows]
    headings = [float(row['ca']) for row in rows]
    return PosedTraverse(
        images, _poses(positions, headings), np.array([row['all'] == 'True' for row in rows])
    )


def robotcar(folder: Path) -> PosedTraverse:
    """Read ``stereo/left`` and ``gps/ins.csv`` of Oxford RobotCar: an image every 2 m."""
    images, rows = FolderSource(folder / 'stereo/left'), _table(folder / 'gps/ins.csv')
    stamps = np.array([int(file.stem) for file in images.files])
    times = np.array([int(row['timestamp']) for row in rows])
    coordinates = ([float(row[name]) for row in rows] for name in ('easting', 'northing'))
    positions = np.stack([np.interp(stamps, times, column) for column in coordinates], axis=1)
    numbers: list[int] = []
    for i in np.flatnonzero((stamps >= times[0]) & (stamps <= times[-1])).tolist():
        if not numbers or np.hypot(*(positions[i] - positions[numbers[-1]])) >= SPACING:
            numbers.append(i)
    images.files = [images.files[i] for i in numbers]
    source = ChangedSource(images, _demosaic)
    return PosedTraverse(source, _poses(positions[numbers]), np.ones(len(numbers), bool))


def _demosaic(frame: Frame) -> np.ndarray:
    """Convert the Bayer pattern of the stereo camera, GBRG, to RGB; colors stay as they are."""
    image = frame.image
    is_gray = (image == image[:, :, :1]).all()
    return cv2.cvtColor(image[:, :, 0], cv2.COLOR_BayerGBRG2RGB) if is_gray else image


def _poses(
    positions: Sequence[Sequence[float]] | np.ndarray, degrees: Sequence[float] = (0.0,)
) -> np.ndarray:
    """Return poses (n, 7) from positions (n, 2), meters, and headings about the vertical axis."""
    xy = np.reshape(positions, (-1, 2))
    half = np.radians(np.broadcast_to(degrees, len(xy))) / 2
    zeros = np.zeros((len(xy), 3))
    return np.column_stack([xy, zeros, np.sin(half), np.cos(half)])


def _table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding='utf-8', newline='') as file:
        return list(csv.DictReader(file))
