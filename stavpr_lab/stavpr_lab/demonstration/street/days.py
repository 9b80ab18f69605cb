# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Days on the synthetic street: light, weather, traffic, shops and parts of the road change."""

from dataclasses import dataclass, replace
from functools import cached_property
from random import Random

import numpy as np
from stavpr_lab.demonstration.street.street import BUILDING, make_street, Street
from stavpr_lab.demonstration.street.surfaces import noise
from stavpr_lab.demonstration.street.traverses import (
    Conditions,
    DETOUR,
    EPOCH,
    LANE,
    LENGTH,
    Traverse,
    World,
)

DAY = 86_400 * 10**9  # ns
SHOPS = 0.02  # share of the buildings that are painted anew each day
COLORS = ('red', 'green', 'blue')


@dataclass(frozen=True)
class Days:
    """
    The days of a street.

    :param seed: decides the street and its days.
    :param length: meters of the street.
    :param images: number of images of a drive.
    :param size: width and height of the images.
    :param closed: first and last day on which a part of the road is closed, and where, meters.
    :param built: day from which on there is a row of new buildings, and where, meters.
    """

    seed: int = 7
    length: float = LENGTH
    images: int = 300
    size: tuple[int, int] = (160, 120)
    closed: tuple[int, int, float, float] = (10, 16, 330.0, 380.0)
    built: tuple[int, float, float] = (15, 100.0, 230.0)

    @cached_property
    def _streets(self) -> tuple[Street, Street]:
        return make_street(self.seed, self.length), make_street(self.seed + 50_021, DETOUR)

    def street(self, day: int) -> Street:
        """Return the street on a day: shops are painted anew, buildings replaced."""
        street, dice = self._streets[0], Random(self.seed)
        lots, other = street.lots.copy(), make_street(self.seed + 1, self.length).lots
        for _ in range(day):
            for lot in range(len(lots)):
                if dice.random() < SHOPS and lots['kind'][lot] == BUILDING:
                    for color in COLORS:
                        lots[color][lot] = 0.3 + 0.6 * dice.random()
                    lots['seed'][lot] = int(dice.random() * 2**30)
        begin, low, high = self.built
        if day >= begin:
            new = [lot for lot in other if lot['kind'] == BUILDING]
            for lot in np.flatnonzero((lots['start'] >= low) & (lots['start'] < high)).tolist():
                if lots['kind'][lot] == BUILDING:
                    own, replacement = lots[lot].copy(), new[lot % len(new)]
                    lots[lot] = replacement
                    for name in ('start', 'length'):
                        lots[name][lot] = own[name]
        return replace(street, lots=lots)

    def conditions(self, day: int) -> Conditions:
        """Return light, weather and traffic of a day; the first one has good light."""
        if not day:
            return Conditions()
        dice = Random(self.seed * 1009 + day)
        clouds = dice.random()
        dusk = dice.random() ** 2
        rain = dice.random() if clouds > 0.6 else 0.0
        return Conditions(
            sun=0.65 * (1 - clouds) * (1 - 0.6 * dusk),
            sun_azimuth=360 * dice.random(),
            sun_elevation=15 + 40 * dice.random(),
            ambient=0.7 - 0.5 * dusk,
            exposure=1.0 - 0.4 * dusk * dice.random(),
            warmth=0.12 * (dice.random() - 0.5),
            clouds=clouds,
            fog=0.001 + 0.014 * dice.random() ** 3,
            rain=rain,
            noise=0.006 + 0.02 * dusk,
            lamps=0.4 * dusk,
            autumn=min(1.0, day / 40),
            lane=LANE if dice.random() < 0.7 else -LANE,
            shake=0.12 + 0.13 * dice.random(),
            traffic=day + 1,
        )

    def drive(self, day: int) -> Traverse:
        """Return the drive of a day, at a varying speed; the first one is even."""
        first, last, leaves, returns = self.closed
        around = DETOUR if first <= day <= last else 0.0
        leaves, returns = (leaves, returns) if around else (0.0, 0.0)
        distance = self.length - (returns - leaves) + around
        speed = np.ones(self.images)
        if day:
            wave = [noise(k / self.images * 9.0, 0.0, self.seed + day) for k in range(self.images)]
            speed = 0.7 * 2.0 ** np.array(wave)
        meters = np.concatenate([[0.0], np.cumsum(speed)[:-1]]) * distance / speed.sum()
        detour = (meters >= leaves) & (meters < leaves + around)
        along = np.where(meters < leaves + around, meters - leaves * detour, meters - around)
        along = np.where(meters < leaves + around, along, along + (returns - leaves))
        world = _Day((self.street(day), self._streets[1]))
        size, epoch = self.size, EPOCH + day * DAY
        return Traverse(world, along, detour, self.conditions(day), epoch, size)


class _Day(World):
    """The streets of a day."""

    def __init__(self, streets: tuple[Street, Street]) -> None:
        self.__dict__['streets'] = streets
