"""Drives changed on purpose: at another speed, with a stop, seen through a narrower window."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from stavpr_ros.errors import ImageError, SettingsError
from stavpr_ros.sources.frame import Frame

STOP = 30  # images that a stop adds
PERIOD = 60  # images in which the varying speed goes once from 1 over 2 and 1/2 back to 1
RATES = {'2x': (2, 1), '1.5x': (3, 2), '0.7x': (7, 10), '0.5x': (1, 2)}  # places per image, a fraction
KINDS = (*RATES, 'vary', 'stop')


class FrameSource(Protocol):
    """A folder, a bag, or anything else that has a length and gives frames anew each time."""

    def __len__(self) -> int:
        """Return the number of images."""

    def __iter__(self) -> Iterator[Frame]:
        """Give one image after the other."""


def warp_indices(n: int, kind: str) -> np.ndarray:
    """
    Tell which image of a drive is each image of the changed drive.

    :param n: images of the drive.
    :param kind: ``2x`` and ``1.5x``: so much faster, images are left out; ``0.7x`` and ``0.5x``: slower,
        images are repeated; ``vary``: speed 2 ** sin(2 pi i / 60) at image i, from 1/2 to 2; ``stop``: the
        image in the middle is repeated 30 times.
    :returns: shape (N,), int64, ascending.
    :raises SettingsError: an unknown kind, or no image.
    """
    if n < 1:
        raise SettingsError(f'a drive of {n} images cannot be changed: expected at least one')
    if kind in RATES:
        numerator, denominator = RATES[kind]
        count = -(-n * denominator // numerator)  # images whose place, rounded down, is still below n
        return np.arange(count, dtype=np.int64) * numerator // denominator
    if kind == 'vary':
        positions = [0.0]
        while positions[-1] < n:
            positions.append(positions[-1] + 2 ** math.sin(2 * math.pi * (len(positions) - 1) / PERIOD))
        return np.floor(positions[:-1]).astype(np.int64)
    if kind == 'stop':
        return np.insert(np.arange(n), n // 2, [n // 2] * STOP)
    raise SettingsError(f'warp {kind!r} is unknown: take one of {", ".join(KINDS)}')


class CroppedSource:
    """
    A source whose images have lost a strip on the left and one on the right.

    Everything else of a frame (stamp, identifier) stays.

    :param source: gives the whole images.
    :param left: fraction of the width that is cut away on the left, rounded to pixels.
    :param right: the same on the right.
    """

    def __init__(self, source: FrameSource, left: float, right: float) -> None:
        if not (left >= 0 and right >= 0 and left + right < 1):
            raise SettingsError(
                f'cropping {left} on the left and {right} on the right: expected fractions >= 0 that leave '
                'something, below 1 together'
            )
        self.source, self.left, self.right = source, left, right

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.source)

    def __iter__(self) -> Iterator[Frame]:
        """Crop one image after the other."""
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
    Cut fractions off the width of every image of a source.

    :returns: the source itself where nothing is cut away; else a :class:`CroppedSource`.
    :raises SettingsError: fractions that are negative or leave nothing.
    """
    return source if left == right == 0 else CroppedSource(source, left, right)
