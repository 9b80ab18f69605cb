# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A synthetic street and two traverses of it, for the demonstration and for tests without data.

The second traverse has other light and weather, the other lane, other cars and a varying speed
with a stop, and leaves the street for a detour that is not on the first. Everything follows from
one seed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import radians, sin

import numpy as np
from stavpr_lab.demonstration.street.rendering import render
from stavpr_lab.demonstration.street.street import (
    CAR,
    CELL,
    LEFT,
    make_street,
    RIGHT,
    SIDE_STREET,
    Street,
    THING,
    VAN,
)
from stavpr_lab.demonstration.street.surfaces import hash01, noise
from stavpr_ros.sources.frame import Frame

RATE = 5.0  # images per second
LANE = 1.0  # meters from the center line to the middle of a lane
EPOCH = 1_750_000_000 * 10**9  # stamp of the first traverse's first image, ns
SECOND_EPOCH = EPOCH + 123 * 86_400 * 10**9  # four months later
LENGTH = 600.0  # meters of the street
# of the second traverse: its length, and where it leaves the street and comes back, meters
DETOUR, DETOUR_FROM, DETOUR_TO = 110.0, 330.0, 380.0
PLACES = 300  # images of the first traverse
SIZE = (320, 240)  # width and height of the images


@dataclass(frozen=True)
class Conditions:
    """
    Light, weather, camera and traffic of one traverse.

    :param sun: strength of direct sunlight; 0 is none.
    :param sun_azimuth: direction of the sun, degrees to the right of the street's first direction.
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


GOOD_LIGHT = Conditions()
AFTERNOON = Conditions(
    sun=0.25, sun_azimuth=250.0, sun_elevation=20.0, clouds=0.7, ambient=0.55, warmth=0.08,
    lane=-LANE, traffic=2,
)  # fmt: skip
RAINY_DUSK = Conditions(
    sun=0.0, ambient=0.5, exposure=0.82, warmth=-0.07, clouds=1.0, fog=0.005, rain=0.4,
    noise=0.009, lamps=0.12, autumn=0.6, lane=-LANE, shake=0.25, traffic=2,
)  # fmt: skip


@dataclass(frozen=True)
class World:
    """
    A synthetic street, and another one that is the detour of the second traverse.

    :param seed: equal seeds give equal worlds.
    """

    seed: int = 7

    @cached_property
    def streets(self) -> tuple[Street, Street]:
        """Return the street of the first traverse, and the detour between two sharp turns."""
        return make_street(self.seed, LENGTH), make_street(self.seed + 50_021, DETOUR)


class Traverse:
    """
    A traverse of a world: a sequence of images, rendered on access.

    :param along: meters along the street that the camera of each image is in, shape (images,).
    :param detour: whether that is the detour, shape (images,), bool.
    :param epoch: stamp of the first image, ns.
    :param size: width and height of the images.
    :param lanes: of each image, meters to the right of the center line, shape (images,); None =
        the lane of the conditions.

    ``position`` is in meters along the street of the first traverse; NaN in the detour.
    """

    def __init__(
        self, world: World, along: np.ndarray, detour: np.ndarray, conditions: Conditions,
        epoch: int = EPOCH, size: tuple[int, int] = SIZE, lanes: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        self.along, self.detour, self._size = along, detour, size
        self._lanes = np.full(len(along), conditions.lane) if lanes is None else lanes
        self.position = np.where(detour, np.nan, along)
        self.stamps = epoch + np.arange(len(along), dtype=np.int64) * round(1e9 / RATE)
        self._conditions = c = conditions
        self._streets = world.streets
        self._parked = [
            _park_cars(street, c.traffic + turn) for turn, street in enumerate(self._streets)
        ]
        # in the order of the constants of ``rendering``
        self._light = np.array([
            c.sun, 0.0, 0.0, sin(radians(c.sun_elevation)), c.ambient, c.lamps, c.clouds,
            min(1.0, c.rain * 1.2), c.autumn, radians(c.sun_azimuth), 1000 + c.traffic * 77,
            c.fog, c.exposure, c.warmth, c.rain, c.noise,
        ])  # fmt: skip

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.stamps)

    def __iter__(self) -> Iterator[Frame]:
        """Render the images one after the other."""
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> Frame:
        """Render image k."""
        return Frame(self._render(k), int(self.stamps[k]), '')

    def camera(self, k: int) -> tuple[float, float, float]:
        """Return meters to the right of the center line, and pitch and yaw as in `render`."""
        c, along = self._conditions, float(self.along[k])
        # Sway and shake depend on the place: during a stop, only traffic moves.
        sway = noise(along / 17.0, 0.0, c.traffic) - 0.5
        bump = hash01(int(along * 10), 3, c.traffic) + hash01(int(along * 10), 4, c.traffic) - 1.0
        across = float(self._lanes[k]) + 0.5 * sway
        return across, radians(c.shake) * 2.4 * bump, radians(1.2) * sway

    def _render(self, k: int) -> np.ndarray:
        turn = int(self.detour[k])
        traffic = np.concatenate([self._parked[turn], self._driving(k)])
        return render(
            self._streets[turn], float(self.along[k]), *self.camera(k), self._light, traffic,
            k * 7919 + self._conditions.traffic, *self._size,
        )  # fmt: skip

    def _driving(self, k: int) -> np.ndarray:
        """Place the cars that drive ahead: in both lanes, coming nearer and falling back."""
        c, along = self._conditions, float(self.along[k])
        rows = []
        for car in range(3):
            wave = noise(k / 40.0, car * 9.0, c.traffic + 40)
            lane = c.lane if car == 0 else -c.lane
            gap = 18.0 + 75.0 * wave if car == 0 else -25.0 + 120.0 * wave
            kind = VAN if hash01(car, 1, c.traffic) < 0.15 else CAR
            if gap > 2 and hash01(int(k / 60), car, c.traffic) < 0.75:
                rows.append((kind, along + gap, lane, 1.0, 9000 + car * 31 + c.traffic * 7))
        return np.array(rows, THING)


def first_traverse(world: World) -> Traverse:
    """Traverse along the street in good light, at one speed: the map."""
    along = np.linspace(0, LENGTH, PLACES, endpoint=False)
    return Traverse(world, along, np.zeros(PLACES, bool), GOOD_LIGHT)


def second_traverse(
    world: World,
    images: int = 330,
    size: tuple[int, int] = SIZE,
    conditions: Conditions = RAINY_DUSK,
    lanes: np.ndarray | None = None,
) -> Traverse:
    """Traverse along the street again, with a detour, a stop and other conditions: the query."""
    distance = LENGTH - (DETOUR_TO - DETOUR_FROM) + DETOUR
    speed = _vary_speed(world.seed, images)
    meters = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) * distance / speed.sum()
    back = DETOUR_FROM + DETOUR
    detour = (meters >= DETOUR_FROM) & (meters < back)
    along = np.where(meters < back, meters - DETOUR_FROM * detour, meters - back + DETOUR_TO)
    return Traverse(world, along, detour, conditions, SECOND_EPOCH, size, lanes)


def nearest_places(first: Traverse, second: Traverse) -> np.ndarray:
    """
    Return the place of the first traverse that is nearest to each image of the second.

    :returns: shape (images,), int64; -1 where the second is in the detour.
    """
    away = np.abs(second.position[:, None] - first.position)
    return np.where(np.isnan(second.position), -1, np.argmin(away, axis=1))


def _vary_speed(seed: int, images: int) -> np.ndarray:
    """Draw a speed for each image, from half to twice the mean, with a stop of 12 images."""
    wave = np.array([noise(k / images * 9.0, 0.0, seed + 5) for k in range(images)])
    wave = (wave - wave.min()) / (wave.max() - wave.min())
    speed = 0.5 * 4.0**wave
    stop, wait = round(images * 0.28), max(1, images // 27)
    away = np.maximum(0, np.abs(np.arange(images) - stop - wait / 2) - wait / 2)
    return speed * np.clip(away / (images * 0.02), 0, 1)


def _park_cars(street: Street, seed: int) -> np.ndarray:
    """Park cars on both sides, groups and gaps, none across a side street."""
    rows = []
    for row, side in ((LEFT, -1), (RIGHT, 1)):
        for spot in range(int((street.length + 200) / 5.6)):
            along = spot * 5.6 + hash01(spot, side + 5, seed)
            lots = street.lot_of[row, [int(along / CELL), int((along + 5) / CELL)]]
            crowd = noise(spot / 7.0, float(side), seed + 3)
            if (street.lots['kind'][lots] != SIDE_STREET).all() and hash01(
                spot, side + 8, seed
            ) < crowd * 0.7:
                kind = VAN if hash01(spot, side + 11, seed) < 0.12 else CAR
                rows.append((kind, along, side * 4.55, 1.0, spot * 2 + (side > 0) + 4000 * seed))
    return np.array(rows, THING)
