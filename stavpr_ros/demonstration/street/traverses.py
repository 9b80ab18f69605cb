# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A synthetic street and two traverses of it, for the demonstration and for tests without data.

The second traverse has other light and weather, the other lane, other cars and a varying speed
with a stop, and leaves the street for a detour that is not on the first. Everything follows from
one seed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import radians
from typing import overload

import numpy as np
from stavpr_ros.demonstration.street.rendering import light_vector, render, View
from stavpr_ros.demonstration.street.street import (
    CAR,
    CELL,
    LEFT_NEAR,
    LOT_KIND,
    make_street,
    SIDE_STREET,
    Street,
    VAN,
)
from stavpr_ros.demonstration.street.surfaces import hash01, noise
from stavpr_ros.errors import InputError, SettingsError

RATE = 5.0  # images per second
LANE = 1.0  # meters from the center line to the middle of a lane
EPOCH = 1_750_000_000 * 10**9  # stamp of the first traverse's first image, ns
SECOND_EPOCH = EPOCH + 123 * 86_400 * 10**9  # four months later


@dataclass(frozen=True)
class Conditions:
    """
    Light, weather, camera and traffic of one traverse.

    :param sun: strength of direct sunlight; 0 is none.
    :param sun_azimuth: where the sun stands, degrees to the right of the street's first direction.
    :param sun_elevation: degrees.
    :param ambient: strength of the light from everywhere.
    :param exposure: gain of the camera.
    :param warmth: shift to red (positive) or blue (negative).
    :param clouds: 0 to 1.
    :param fog: extinction, 1/meter.
    :param rain: 0 to 1: drops, wet ground.
    :param noise: deviation of the sensor noise, as a part of full scale.
    :param lamps: share of the windows that are lit.
    :param autumn: color of the leaves, 0 (summer) to 1.
    :param lane: meters to the right of the center line.
    :param shake: deviation of the pitch, degrees.
    :param traffic: seed of parked and driving cars.
    """

    sun: float = 0.65
    sun_azimuth: float = 62.0
    sun_elevation: float = 46.0
    ambient: float = 0.7
    exposure: float = 1.0
    warmth: float = 0.04
    clouds: float = 0.2
    fog: float = 0.0012
    rain: float = 0.0
    noise: float = 0.006
    lamps: float = 0.0
    autumn: float = 0.0
    lane: float = LANE
    shake: float = 0.12
    traffic: int = 1

    def __post_init__(self) -> None:
        if not 0 < self.sun_elevation < 90:
            raise SettingsError(
                f'sun_elevation is {self.sun_elevation}; expected degrees between 0 and 90'
            )
        if abs(self.lane) > 4:
            raise SettingsError(f'lane is {self.lane} m; expected -4 to 4, the width of the road')
        for name in (
            'sun',
            'ambient',
            'exposure',
            'fog',
            'rain',
            'noise',
            'lamps',
            'autumn',
            'shake',
            'clouds',
        ):
            if not getattr(self, name) >= 0:
                raise SettingsError(f'{name} is {getattr(self, name)}; expected 0 or more')


GOOD_LIGHT = Conditions()
RAINY_DUSK = Conditions(
    sun=0.0, ambient=0.5, exposure=0.82, warmth=-0.07, clouds=1.0, fog=0.005, rain=0.4,
    noise=0.009, lamps=0.12, autumn=0.6, lane=-LANE, shake=0.25, traffic=2,
)  # fmt: skip


@dataclass(frozen=True)
class WorldFrame:
    """
    One image of a traverse.

    :param image: RGB, shape (height, width, 3), uint8.
    :param stamp: nanoseconds.
    :param position: meters along the first traverse's route; nan off that route.
    """

    image: np.ndarray
    stamp: int
    position: float


@dataclass(frozen=True)
class World:
    """
    A synthetic street, and another one that is the detour of the second traverse.

    :param seed: any integer from 0; equal seeds give equal worlds.
    :param length: meters of the street.
    :param detour_length: meters of the detour.
    :param detour_from: where the detour leaves the street, meters.
    :param detour_to: where it comes back, meters.
    """

    seed: int = 7
    length: float = 600.0
    detour_length: float = 110.0
    detour_from: float = 330.0
    detour_to: float = 380.0

    def __post_init__(self) -> None:
        if not (isinstance(self.seed, int) and 0 <= self.seed < 2**31):
            raise SettingsError(
                f'seed of the world is {self.seed!r}; expected an integer from 0 to 2**31 - 1'
            )
        if not 0 < self.detour_from <= self.detour_to < self.length:
            raise SettingsError(
                f'detour from {self.detour_from} m to {self.detour_to} m; expected both inside '
                'the '
                f'street of {self.length} m, in this order'
            )

    @cached_property
    def street(self) -> Street:
        """Return the street of the first traverse."""
        return make_street(self.seed, self.length)

    @cached_property
    def detour(self) -> Street:
        """Return the street of the detour, entered and left by sharp turns."""
        return make_street(self.seed + 50_021, self.detour_length)


@dataclass(frozen=True)
class Route:
    """
    Position of each image of a traverse.

    :param along: meters along the street that the camera is in, shape (images,).
    :param detour: whether that is the detour, shape (images,), bool.
    """

    along: np.ndarray
    detour: np.ndarray


class Traverse(Sequence[WorldFrame]):
    """
    A traverse of a world: a sequence of images, rendered on access.

    :param world: the world.
    :param route: where the images are taken.
    :param conditions: how it looks.
    :param epoch: stamp of the first image, ns.
    :param size: width and height of the images.
    """

    def __init__(
        self, world: World, route: Route, conditions: Conditions, epoch: int = EPOCH,
        size: tuple[int, int] = (320, 240),
    ) -> None:  # fmt: skip
        if min(size) < 16:
            raise SettingsError(
                f'size of the images is {size}; expected a width and a height of 16 or more'
            )
        self.route, self.conditions, self.size = route, conditions, size
        self.position = np.where(route.detour, np.nan, route.along)
        self.stamps = epoch + np.arange(len(route.along), dtype=np.int64) * round(1e9 / RATE)
        c = conditions
        self._streets = (world.street, world.detour)
        self._headings = [
            np.concatenate([[0.0], np.cumsum(street.curvature) * CELL]) for street in self._streets
        ]
        self._parked = [
            _park_cars(street, c.traffic + turn) for turn, street in enumerate(self._streets)
        ]
        self._light = light_vector(
            c.sun, radians(c.sun_azimuth), radians(c.sun_elevation), c.ambient, c.lamps, c.clouds,
            min(1.0, c.rain * 1.2), c.autumn, 1000 + c.traffic * 77, c.fog, c.exposure,
            c.warmth, c.rain, c.noise,
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.stamps)

    @overload
    def __getitem__(self, index: int) -> WorldFrame: ...
    @overload
    def __getitem__(self, index: slice) -> list[WorldFrame]: ...

    def __getitem__(self, index: int | slice) -> WorldFrame | list[WorldFrame]:
        """Render one image, or a list of them."""
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f'image {index} of a traverse of {len(self)}')
        k = index % len(self)
        return WorldFrame(self._render(k), int(self.stamps[k]), float(self.position[k]))

    def __iter__(self) -> Iterator[WorldFrame]:
        """Render the images one after the other."""
        return (self[k] for k in range(len(self)))

    def _render(self, k: int) -> np.ndarray:
        c, along, turn = self.conditions, float(self.route.along[k]), int(self.route.detour[k])
        # Sway and shake depend on the place: while the vehicle stands, only traffic moves.
        sway = noise(along / 17.0, 0.0, c.traffic) - 0.5
        bump = hash01(int(along * 10), 3, c.traffic) + hash01(int(along * 10), 4, c.traffic) - 1.0
        view = View(along, c.lane + 0.5 * sway, radians(c.shake) * 2.4 * bump, radians(1.2) * sway)
        traffic = np.concatenate([self._parked[turn], self._driving(k)])
        heading = float(self._headings[turn][int(along / CELL)])
        return render(
            self._streets[turn],
            heading,
            view,
            self._light,
            traffic,
            k * 7919 + c.traffic,
            *self.size,
        )

    def _driving(self, k: int) -> np.ndarray:
        """Place the cars that drive ahead: some in each lane, coming nearer and falling back."""
        c, along = self.conditions, float(self.route.along[k])
        rows = []
        for car in range(3):
            wave = noise(k / 40.0, car * 9.0, c.traffic + 40)
            lane = c.lane if car == 0 else -c.lane
            gap = 18.0 + 75.0 * wave if car == 0 else -25.0 + 120.0 * wave
            kind = VAN if hash01(car, 1, c.traffic) < 0.15 else CAR
            if gap > 2 and hash01(int(k / 60), car, c.traffic) < 0.75:
                rows.append((kind, along + gap, lane, 1.0, 9000 + car * 31 + c.traffic * 7))
        return np.array(rows, np.float64).reshape(-1, 5)


def first_traverse(
    world: World, places: int = 300, size: tuple[int, int] = (320, 240)
) -> Traverse:
    """Traverse along the street in good light, at one speed: the map."""
    _check_count('places', places)
    along = np.linspace(0, world.length, places, endpoint=False)
    return Traverse(world, Route(along, np.zeros(places, bool)), GOOD_LIGHT, EPOCH, size)


def second_traverse(
    world: World,
    images: int = 330,
    size: tuple[int, int] = (320, 240),
    conditions: Conditions = RAINY_DUSK,
) -> Traverse:
    """Traverse along the street again, with a detour, a stop and other conditions: the query."""
    _check_count('images', images)
    distance = world.length - (world.detour_to - world.detour_from) + world.detour_length
    speed = _vary_speed(world.seed, images)
    driven = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) * distance / speed.sum()
    back = world.detour_from + world.detour_length
    detour = (driven >= world.detour_from) & (driven < back)
    along = np.where(
        driven < back, driven - world.detour_from * detour, driven - back + world.detour_to
    )
    return Traverse(world, Route(along, detour), conditions, SECOND_EPOCH, size)


def nearest_places(first: Traverse, second: Traverse) -> np.ndarray:
    """
    Return the place of the first traverse that is nearest to each image of the second.

    :returns: shape (images,), int64; -1 where the second is off the first's route.
    """
    if len(first) == 0 or np.isnan(first.position).any():
        missing = int(np.isnan(first.position).sum())
        raise InputError(
            f'a first traverse of {len(first)} places, {missing} of them without a position; '
            'expected at least one place, and a position for all: a traverse without detour'
        )
    away = np.abs(second.position[:, None] - first.position[None, :])
    return np.where(
        np.isnan(second.position), -1, np.argmin(np.nan_to_num(away, nan=np.inf), axis=1)
    )


def _check_count(name: str, count: int) -> None:
    if count < 2:
        raise SettingsError(f'{name} is {count}; expected 2 or more')


def _vary_speed(seed: int, images: int) -> np.ndarray:
    """Draw a speed for each image, from half to twice the usual, with a stop of some 12 images."""
    wave = np.array([noise(k / images * 9.0, 0.0, seed + 5) for k in range(images)])
    wave = (wave - wave.min()) / (wave.max() - wave.min())
    speed = 0.5 * 4.0**wave
    stop, wait = round(images * 0.28), max(1, images // 27)
    away = np.maximum(0, np.abs(np.arange(images) - stop - wait / 2) - wait / 2)
    return speed * np.clip(away / (images * 0.02), 0, 1)


def _park_cars(street: Street, seed: int) -> np.ndarray:
    """Park cars on both sides, groups and gaps, none across a side street."""
    rows = []
    for side in (-1, 1):
        row = LEFT_NEAR if side < 0 else LEFT_NEAR + 1
        for spot in range(int((street.length + 200) / 5.6)):
            along = spot * 5.6 + hash01(spot, side + 5, seed)
            lots = street.lot_of[row, [int(along / CELL), int((along + 5) / CELL)]]
            crowd = noise(spot / 7.0, float(side), seed + 3)
            if (street.lots[lots, LOT_KIND] != SIDE_STREET).all() and hash01(
                spot, side + 8, seed
            ) < crowd * 0.7:
                kind = VAN if hash01(spot, side + 11, seed) < 0.12 else CAR
                rows.append((kind, along, side * 4.55, 1.0, spot * 2 + (side > 0) + 4000 * seed))
    return np.array(rows, np.float64).reshape(-1, 5)
