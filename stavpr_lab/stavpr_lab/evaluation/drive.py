# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A recorded query driven differently: faster, with stops, dropped images, backward, off the map.

A :class:`Drive` is the indices of the images that are shown and of the places that the map keeps,
and their ground truth; :func:`stavpr_ros.mapping.select_places` applies them.
:func:`crop` changes the images themselves.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
import math
from typing import Protocol, Self

import numpy as np
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.errors import ImageError, SettingsError
from stavpr_ros.sources.frame import Frame

VARYING = 'varying'
STOP = 30  # images that a stop adds, where no number is given
KINDS = ('2x', '1.5x', '0.7x', '0.5x', 'vary', 'stop')  # the drives of the accuracy table
SPEEDS = 0.01, 100.0  # slowest and fastest, places per image
INTERVAL = 100_000_000  # ns between two images, before any are left out
PERIOD = 60  # images of one period of the varying speed: 1, 2, 1, 1/2, 1
UNSEEN_DISTANCE = 5  # places from the map within which a removed place may look like a mapped one


def _images_at(n: int, speed: float | str) -> np.ndarray:
    """Return the images of a drive at a speed of :class:`DriveChanges`, ascending, int64."""
    if isinstance(speed, str):
        positions = [0.0]
        while positions[-1] < n:
            phase = 2 * math.pi * (len(positions) - 1) / PERIOD
            positions.append(positions[-1] + 2 ** math.sin(phase))
        return np.floor(positions[:-1]).astype(np.int64)
    # as a fraction, so that ten images at 0.7 are exactly seven
    ratio = Fraction(speed).limit_denominator(1000)
    count = math.ceil(n / ratio)
    return np.arange(count, dtype=np.int64) * ratio.numerator // ratio.denominator


@dataclass(frozen=True)
class DriveChanges:
    """
    How a query is driven; they apply in the order speed, stops, reverse, drop.

    :param removed: stretches (first, last) of the map, first .. last - 1, that it is made without.
    :param reverse: the last image comes first.
    :param drop: probability with which each image is left out.
    :param seed: decides which images are left out.
    :param stops: (image, count): at this image of the recorded query, it is repeated count times.
    :param speed: recorded images per shown image: image i is floor(speed * i); below 1, images are
        repeated. ``varying``: 2 ** sin(2 pi i / 60) at image i, from 1/2 to 2.
    :raises SettingsError: a value is out of its range.
    """

    removed: tuple[tuple[int, int], ...] = ()
    reverse: bool = False
    drop: float = 0.0
    seed: int = 0
    stops: tuple[tuple[int, int], ...] = ()
    speed: float | str = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.drop < 1:
            raise SettingsError(f'drop = {self.drop}: expected a probability from 0 to below 1')
        if self.seed < 0:
            raise SettingsError(f'seed = {self.seed} of the dropped images must be at least 0')
        for image, count in self.stops:
            if count < 1:
                raise SettingsError(f'stop {image}:{count}: expected at least one image more')
        if isinstance(self.speed, str):
            if self.speed != VARYING:
                raise SettingsError(f'speed {self.speed!r}: expected a number or {VARYING}')
        elif not SPEEDS[0] <= self.speed <= SPEEDS[1]:
            raise SettingsError(
                f'speed {self.speed:g}: expected {SPEEDS[0]:g} .. {SPEEDS[1]:g} images '
                'of the query per image'
            )

    @classmethod
    def from_name(cls, name: str, n: int) -> Self:
        """
        Return the changes that a row or an option names, for a query of n images.

        :param name: ``same``; a speed, such as ``0.5x``, or ``vary``, ``varying``; ``stop`` or
            ``stop 100``: images that are added in the middle; ``drop 0.3``.
        :raises SettingsError: an unknown name, or a value out of its range.
        """
        if name in ('vary', VARYING):
            return cls(speed=VARYING)
        aliases = {'same': '1x', 'stop': f'stop {STOP}'}
        kind, _, value = aliases.get(name, name).rpartition(' ')
        try:
            number = float(value.removesuffix('x'))
        except ValueError as error:
            raise SettingsError(
                f'drive {name!r} is unknown: take same, {", ".join(KINDS)} or drop P'
            ) from error
        if kind == 'stop':
            return cls(stops=((n // 2, int(number)),))
        return cls(drop=number) if kind == 'drop' else cls(speed=number)

    def images(self, n: int) -> np.ndarray:
        """
        Return the images that are shown, of n recorded ones, shape (N,), int64.

        :raises SettingsError: a stop at an image that there is not, or no image is left.
        """
        return self._numbered_images(n)[0]

    def _numbered_images(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the images that are shown, and their numbers before any are left out, (N,)."""
        images = _images_at(n, self.speed)
        for at, count in self.stops:
            if not 0 <= at < n:
                raise SettingsError(f'stop {at}:{count}: the query has the images 0 .. {n - 1}')
            position = int(np.argmin(np.abs(images - at)))  # at high speed, the nearest one
            images = np.insert(images, position, np.full(count, images[position]))
        if self.reverse:
            images = images[::-1]
        numbers = np.arange(len(images))
        if self.drop:
            remains = np.random.default_rng(self.seed).random(len(images)) >= self.drop
            images, numbers = images[remains], numbers[remains]
        if not len(images):
            raise SettingsError(f'drop = {self.drop} leaves none of {n} images')
        return images, numbers

    def places(self, n: int) -> np.ndarray:
        """
        Return the places that the map keeps, of n recorded ones, ascending, int64.

        :raises SettingsError: stretches outside the map, that overlap, or that leave no place.
        """
        remains = np.ones(n, bool)
        for first, last in self.removed:
            if not 0 <= first < last <= n:
                raise SettingsError(
                    f'removed places {first}:{last}: expected 0 <= FIRST < LAST <= {n}, the '
                    'number of places of the map'
                )
            if not remains[first:last].all():
                raise SettingsError(f'removed places {first}:{last} overlap with others')
            remains[first:last] = False
        if not remains.any():
            raise SettingsError(f'all {n} places of the map are removed: keep at least one')
        return np.flatnonzero(remains)

    def apply(self, ground_truth: GroundTruth) -> 'Drive':
        """
        Return the drive of a query.

        :param ground_truth: accepted places of the query on the map, as both were recorded.
        :raises SettingsError: a change that does not fit the query or the map.
        """
        images, numbers = self._numbered_images(ground_truth.N)
        places, recorded = self.places(ground_truth.n), ground_truth.select(images)
        stamps = (numbers + 1) * INTERVAL
        return Drive(images, places, recorded.on_places(places), recorded, stamps, self.removed)


@dataclass(frozen=True, eq=False)
class Drive:
    """
    A query of N images on a map of n places, as changed from the recording.

    :param images: the recorded image that each one is, shape (N,), int64.
    :param places: the recorded place that each place of the map is, ascending, shape (n,), int64.
    :param truth: ground truth in places of this map (which are numbered without gaps).
    :param recorded: ground truth in places of the recorded map.
    :param stamps: ns, (N,), int64: one interval apart, with gaps where images are left out.
    :param removed: stretches (first, last) of the recorded map that this one lacks.
    """

    images: np.ndarray
    places: np.ndarray
    truth: GroundTruth
    recorded: GroundTruth
    stamps: np.ndarray
    removed: tuple[tuple[int, int], ...] = ()

    def unseen(self) -> list[np.ndarray]:
        """
        Return the images whose place was removed, for each removed stretch, shape (N,), bool.

        The place of an image is the middle of its run of correct places. Only images without any
        correct place in the map count, whose place is more than ``UNSEEN_DISTANCE`` places from
        each one that the map keeps. An image of several places counts for the first of them.
        """
        truth = self.recorded
        run_query, firsts, lasts = truth.runs
        middle = (firsts + lasts) // 2
        at = np.searchsorted(self.places, middle)
        before = self.places[np.maximum(at - 1, 0)]
        after = self.places[np.minimum(at, len(self.places) - 1)]
        distance = np.minimum(np.abs(middle - before), np.abs(middle - after))
        near = np.bincount(run_query[distance <= UNSEEN_DISTANCE], minlength=truth.N) > 0
        near |= truth.on_places(self.places).has_match
        place = np.full(truth.N, -1)
        place[run_query[::-1]] = middle[::-1]  # the first run comes last and stays
        return [(place >= first) & (place < last) & ~near for first, last in self.removed]


class FrameSource(Protocol):
    """A folder, a bag, or another source with a length whose frames can be read repeatedly."""

    def __len__(self) -> int:
        """Return the number of images."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield one image after the other."""


class ChangedSource:
    """
    A source whose images are changed; stamps and identifiers stay.

    :param change: returns the new image of a frame, RGB.
    """

    def __init__(self, source: FrameSource, change: Callable[[Frame], np.ndarray]) -> None:
        self._source, self._change = source, change

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self._source)

    def __iter__(self) -> Iterator[Frame]:
        """Yield one changed image after the other."""
        for frame in self._source:
            yield replace(frame, image=self._change(frame))


def _pixels(width: float) -> int:
    return math.floor(width + 0.5)


def crop(source: FrameSource, left: float, right: float) -> FrameSource:
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

    def cut(frame: Frame) -> np.ndarray:
        width = frame.image.shape[1]
        first, last = _pixels(left * width), width - _pixels(right * width)
        if first >= last:
            raise ImageError(
                f'{frame.identifier} is {width} pixels wide: cropping {left} on the left and '
                f'{right} on the right leaves none'
            )
        return np.ascontiguousarray(frame.image[:, first:last])

    return source if left == right == 0 else ChangedSource(source, cut)
