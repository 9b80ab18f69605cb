# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changed traverses: another speed, a stop, narrower or mirrored images."""

from collections.abc import Callable, Iterator
from dataclasses import replace
import math
from typing import Protocol

import numpy as np
from stavpr_lab.evaluation.drive import DriveChanges, VARYING
from stavpr_ros.errors import ImageError, SettingsError
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.sources.frame import Frame

STOP = 30  # images that a stop adds
RATES = ('2x', '1.5x', '0.7x', '0.5x')  # places per image
KINDS = (*RATES, 'vary', 'stop')


class FrameSource(Protocol):
    """A folder, a bag, or another source with a length whose frames can be read repeatedly."""

    def __len__(self) -> int:
        """Return the number of images."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield one image after the other."""


def warp_changes(n: int, kind: str) -> DriveChanges:
    """
    Return the changes of a warp.

    :param n: images of the original traverse.
    :param kind: see :func:`warp_indices`.
    :raises SettingsError: an unknown kind.
    """
    if kind in RATES:
        return DriveChanges(speed=float(kind[:-1]))
    if kind == 'vary':
        return DriveChanges(speed=VARYING)
    if kind == 'stop':
        return DriveChanges(stops=((n // 2, STOP),))
    raise SettingsError(f'warp {kind!r} is unknown: take one of {", ".join(KINDS)}')


def warp_indices(n: int, kind: str) -> np.ndarray:
    """
    Return the image of the original traverse that each image of the changed one is.

    :param n: images of the original traverse.
    :param kind: ``2x`` and ``1.5x``: faster, images are left out; ``0.7x`` and ``0.5x``: slower,
        images are repeated; ``vary``: speed 2 ** sin(2 pi i / 60) at image i, from 1/2 to 2;
        ``stop``: the image in the middle is repeated 30 times.
    :returns: shape (N,), int64, ascending.
    :raises SettingsError: an unknown kind.
    """
    return warp_changes(n, kind).images(n)


class ChangedSource:
    """
    A source whose images are changed one by one; stamps and identifiers stay.

    :param change: returns the changed image of a frame.
    """

    def __init__(self, source: FrameSource, change: Callable[[Frame], np.ndarray]) -> None:
        self._source, self._change = source, change

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self._source)

    def __iter__(self) -> Iterator[Frame]:
        """Yield one changed image after the other."""
        for frame in self._source:
            yield replace(frame, image=np.ascontiguousarray(self._change(frame)))


def mirrored(source: FrameSource) -> FrameSource:
    """Mirror every image of a source left-right."""
    return ChangedSource(source, lambda frame: frame.image[:, ::-1])


def _pixels(width: float) -> int:
    return math.floor(width + 0.5)


def cropped(source: FrameSource, left: float, right: float) -> FrameSource:
    """
    Crop every image of a source.

    :param left, right: fractions of the width, rounded to pixels.
    :returns: the source itself where nothing is cropped.
    :raises SettingsError: negative fractions, or 1 and more together.
    """
    if not (left >= 0 and right >= 0 and left + right < 1):
        raise SettingsError(
            f'cropping {left} on the left and {right} on the right: expected fractions >= 0, '
            'below 1 together'
        )

    def crop(frame: Frame) -> np.ndarray:
        width = frame.image.shape[1]
        first, last = _pixels(left * width), width - _pixels(right * width)
        if first >= last:
            raise ImageError(
                f'{frame.identifier} is {width} pixels wide: cropping {left} on the left and '
                f'{right} on the right leaves none'
            )
        return frame.image[:, first:last]

    return source if left == right == 0 else ChangedSource(source, crop)


def select_places(place_map: PlaceMap, indices: np.ndarray) -> PlaceMap:
    """Return some places of a map, or images of a query, in any order, repeated or not."""
    return replace(
        place_map,
        features=place_map.features[indices],
        stamps=place_map.stamps[indices],
        ids=tuple(place_map.ids[i] for i in indices),
        poses=None if place_map.poses is None else place_map.poses[indices],
        thumbnails=tuple(place_map.thumbnails[i] for i in indices) if place_map.thumbnails else (),
    )
