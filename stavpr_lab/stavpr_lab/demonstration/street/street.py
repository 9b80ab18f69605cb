# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The layout of a synthetic street: places of buildings, hedges, trees and lamps.

A street is cut into cells of half a meter along its center line. For each of its four rows (the
near and the far row on the left and on the right) a cell names its lot, so that
the renderer finds the lot at a ray without searching. Positions are (along the route, to the right
of its center line), in meters.
"""

from dataclasses import dataclass
from functools import cached_property
from random import Random

import numpy as np

CELL = 0.5  # meters of the route that share one entry of the tables
VIEW = 260.0  # how far the renderer looks along the route, meters
ROAD_HALF_WIDTH = 5.6  # two lanes and a row of parked cars on each side
LEFT, RIGHT = range(2)  # the near rows; the far rows follow in the same order

LOT = np.dtype([
    *((name, 'f8') for name in ('start', 'length', 'setback', 'height')), ('kind', 'i8'),
    *((name, 'f8') for name in ('red', 'green', 'blue', 'ground_floor', 'floor', 'pitch')),
    ('window', 'f8'), ('style', 'i8'), ('gable', 'f8'), ('seed', 'i8'), ('trim', 'f8'),
])  # fmt: skip
BUILDING, SIDE_STREET, PARK = range(3)
PLASTER, BRICK, OFFICE, HALL = range(4)

# A thing in the street; its size is a factor.
THING = np.dtype([
    ('kind', 'i8'), ('along', 'f8'), ('across', 'f8'), ('scale', 'f8'), ('seed', 'i8'),
])  # fmt: skip
TREE, LAMP, SIGN, CAR, VAN = range(5)

PALETTE = (
    (0.74, 0.70, 0.62), (0.80, 0.76, 0.68), (0.62, 0.36, 0.28), (0.55, 0.29, 0.23),
    (0.82, 0.68, 0.44), (0.70, 0.55, 0.36), (0.58, 0.62, 0.64), (0.44, 0.47, 0.50),
    (0.60, 0.67, 0.58), (0.78, 0.58, 0.48), (0.86, 0.83, 0.78), (0.52, 0.58, 0.66),
    (0.47, 0.40, 0.36), (0.71, 0.46, 0.36), (0.88, 0.79, 0.58),
)  # fmt: skip


@dataclass(frozen=True)
class Street:
    """
    One street as the tables that the renderer reads.

    :param length: meters of the route; the tables reach :data:`VIEW` further.
    :param lots: shape (lots,), :data:`LOT`.
    :param lot_of: lot in each cell of the four rows, shape (4, cells), int32.
    :param curvature: curvature of the center line, positive to the right, shape (cells,), 1/meter.
    :param things: trees, lamps, signs, shape (things,), :data:`THING`.
    :param seed: decides its layout and its ground.
    :param rigid: bends turn the street, so that images agree with poses; else they only move it
        sideways with depth.
    """

    length: float
    lots: np.ndarray
    lot_of: np.ndarray
    curvature: np.ndarray
    things: np.ndarray
    seed: int
    rigid: bool = False

    @cached_property
    def headings(self) -> np.ndarray:
        """Return the direction at the start of each cell, radians from where it began."""
        return np.concatenate([[0.0], np.cumsum(self.curvature) * CELL])


def make_street(seed: int, length: float) -> Street:
    """
    Make a street from a seed.

    :param seed: any integer; equal seeds give equal streets on every machine.
    :param length: meters of the route.
    """
    cells = int(np.ceil((length + VIEW) / CELL)) + 1
    lots: list[tuple[float, ...]] = []
    lot_of = np.zeros((4, cells), np.int32)
    for row in range(4):
        # `random()` alone is the same in every version of Python: nothing else of Random is used.
        dice = Random(seed * 4 + row)
        at = -int(dice.random() * 16)
        while at < cells:
            lot = _draw_lot(dice, row, at * CELL)
            stop = at + int(lot[1] / CELL)  # its length
            lot_of[row, max(at, 0) : stop] = len(lots)
            lots.append(lot)
            at = stop
    table = np.array(lots, LOT)
    return Street(
        length=length,
        lots=table,
        lot_of=lot_of,
        curvature=_draw_curvature(Random(seed + 7919), cells),
        things=_plant(Random(seed + 104729), table, lot_of),
        seed=seed,
    )


def _between(dice: Random, low: float, high: float) -> float:
    return low + (high - low) * dice.random()


def _draw_lot(dice: Random, row: int, start: float) -> tuple[float, ...]:
    """Draw one building, side street or park; its length is a whole number of cells."""
    near = row in (LEFT, RIGHT)
    kind = BUILDING
    if near:
        roll = dice.random()
        kind = SIDE_STREET if roll < 0.1 else PARK if roll < 0.24 else BUILDING
    style = (PLASTER, PLASTER, BRICK, BRICK, BRICK, OFFICE, HALL)[int(dice.random() * 7)]
    length = _between(dice, 7, 19) if style != HALL else _between(dice, 14, 26)
    height = {
        PLASTER: _between(dice, 6, 19),
        BRICK: _between(dice, 6, 21),
        OFFICE: _between(dice, 15, 32),
        HALL: _between(dice, 5, 8),
    }[style]
    setback = _between(dice, 15.0, 18.0)
    gable = float(dice.random() < 0.3 and style in (PLASTER, BRICK))
    if not near:
        setback, height = _between(dice, 36, 46), height + _between(dice, 2, 9)
    if kind == SIDE_STREET:
        length, setback = _between(dice, 7, 11), 1e6
    elif kind == PARK:
        length, setback = _between(dice, 9, 24), _between(dice, 14.4, 15.8)
        height, gable = _between(dice, 0.8, 1.6), 0
    color = PALETTE[int(dice.random() * len(PALETTE))]
    light = _between(dice, 0.82, 1.12)
    return (start, round(length / CELL) * CELL, setback, height, kind,
            *(part * light for part in color), _between(dice, 3.6, 4.6), _between(dice, 2.7, 3.6),
            _between(dice, 1.9, 3.9), _between(dice, 0.38, 0.68), style, gable,
            int(dice.random() * 2**30), dice.random())  # fmt: skip


def _draw_curvature(dice: Random, cells: int) -> np.ndarray:
    """Draw a curvature (1/m) that changes gently: knots every 45 m, joined smoothly."""
    step = round(45 / CELL)
    knots = [_between(dice, -1, 1) * 0.009 for _ in range(cells // step + 3)]
    at = np.arange(cells) / step
    low = at.astype(int)
    weight = (1 - np.cos((at - low) * np.pi)) / 2
    values = np.array(knots)
    return values[low] * (1 - weight) + values[low + 1] * weight


def _plant(dice: Random, lots: np.ndarray, lot_of: np.ndarray) -> np.ndarray:
    """Draw the trees, lamps and signs on the pavements and in the parks."""
    things = []
    end = lot_of.shape[1] * CELL
    for row, side in ((LEFT, -1), (RIGHT, 1)):
        at, avenue = _between(dice, 0, 20), 0.0
        while at < end:
            kind = lots['kind'][lot_of[row, int(at / CELL)]]
            if kind == PARK:
                across, size = side * _between(dice, 16.5, 24), _between(dice, 0.9, 1.6)
                things.append((TREE, at, across, size, dice.random() * 2**30))
                at += _between(dice, 2.5, 6)
                continue
            avenue = avenue * 0.75 + dice.random() * 0.25  # trees come in groups
            roll = dice.random()
            if kind == BUILDING and roll < max(avenue * 0.9, 0.78):
                pick = TREE if roll < avenue * 0.9 else LAMP if roll < 0.65 else SIGN
                size, across = _between(dice, 0.6, 1.1), side * _between(dice, 6.1, 6.5)
                things.append((pick, at, across, size, dice.random() * 2**30))
            at += _between(dice, 7, 15)
    return np.array(sorted(things, key=lambda thing: thing[1]), THING)
