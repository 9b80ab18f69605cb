# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Changed traverses: another speed, a stop, narrower images."""

from collections.abc import Iterator
from dataclasses import replace
import math
from typing import Protocol

import numpy as np
from stavpr_ros.errors import ImageError, SettingsError
from stavpr_ros.sources.frame import Frame

STOP = 30  # images that a stop adds
PERIOD = 60  # images of one period of the varying speed: 1, 2, 1, 1/2, 1
RATES = {
    '2x': (2, 1),
    '1.5x': (3, 2),
    '0.7x': (7, 10),
    '0.5x': (1, 2),
}  # places per image, a fraction
KINDS = (*RATES, 'vary', 'stop')


class FrameSource(Protocol):
    """A folder, a bag, or another source with a length whose frames can be read repeatedly."""

    def __len__(self) -> int:
        """Return the number of images."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield one image after the other."""


def warp_indices(n: int, kind: str) -> np.ndarray:
    """
    Return the image of the original traverse that each image of the changed one is.

    :param n: images of the original traverse.
    :param kind: ``2x`` and ``1.5x``: faster, images are left out; ``0.7x`` and ``0.5x``: slower,
        images are repeated; ``vary``: speed 2 ** sin(2 pi i / 60) at image i, from 1/2 to 2;
        ``stop``: the image in the middle is repeated 30 times.
    :returns: shape (N,), int64, ascending.
    :raises SettingsError: an unknown kind, or no image.
    """
    if n < 1:
        raise SettingsError(f'a traverse of {n} images: expected at least one')
    if kind in RATES:
        numerator, denominator = RATES[kind]
        count = -(
            -n * denominator // numerator
        )  # images whose place, rounded down, is still below n
        return np.arange(count, dtype=np.int64) * numerator // denominator
    if kind == 'vary':
        positions = [0.0]
        while positions[-1] < n:
            positions.append(
                positions[-1] + 2 ** math.sin(2 * math.pi * (len(positions) - 1) / PERIOD)
            )
        return np.floor(positions[:-1]).astype(np.int64)
    if kind == 'stop':
        return np.insert(np.arange(n), n // 2, [n // 2] * STOP)
    raise SettingsError(f'warp {kind!r} is unknown: take one of {", ".join(KINDS)}')


class CroppedSource:
    """
    A source whose images are cropped on the left and on the right; stamps and identifiers stay.

    :param source: of the whole images.
    :param left: fraction of the width that is cropped on the left, rounded to pixels.
    :param right: the same on the right.
    """

    def __init__(self, source: FrameSource, left: float, right: float) -> None:
        if not (left >= 0 and right >= 0 and left + right < 1):
            raise SettingsError(
                f'cropping {left} on the left and {right} on the right: expected fractions >= 0, '
                'below 1 together'
            )
        self.source, self.left, self.right = source, left, right

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.source)

    def __iter__(self) -> Iterator[Frame]:
        """Yield one cropped image after the other."""
        for frame in self.source:
            yield replace(frame, image=self._crop(frame))

    def _crop(self, frame: Frame) -> np.ndarray:
        width = frame.image.shape[1]
        first, last = _pixels(self.left * width), width - _pixels(self.right * width)
        if first >= last:
            raise ImageError(
                f'{frame.identifier} is {width} pixels wide: cropping {self.left} on the left and '
                f'{self.right} on the right leaves none'
            )
        return np.ascontiguousarray(frame.image[:, first:last])


def _pixels(width: float) -> int:
    return math.floor(width + 0.5)


def cropped(source: FrameSource, left: float, right: float) -> FrameSource:
    """
    Crop every image of a source.

    :param left, right: fractions of the width.
    :returns: the source itself where nothing is cropped; else a :class:`CroppedSource`.
    :raises SettingsError: negative fractions, or 1 and more together.
    """
    return source if left == right == 0 else CroppedSource(source, left, right)
