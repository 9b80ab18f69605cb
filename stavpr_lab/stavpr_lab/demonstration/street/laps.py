# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Three laps on a synthetic street that closes on itself, with true poses and drifting odometry.

Lap 2 is on the other lane and has a detour and a stop, lap 3 is in the rain at dusk. Poses are
planar: x, y (m) and yaw (rad) of the robot's base, which is on the ground below the camera.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import pi

import numpy as np
from stavpr_lab.demonstration.simulated_odometry import add_drift, relative_poses
from stavpr_lab.demonstration.street.rendering import EYE, FOCAL, HORIZON
from stavpr_lab.demonstration.street.street import CELL, Street, VIEW
from stavpr_lab.demonstration.street.traverses import (
    AFTERNOON,
    DETOUR,
    DETOUR_FROM,
    DETOUR_TO,
    EPOCH,
    first_traverse,
    GOOD_LIGHT,
    LANE,
    LENGTH,
    PLACES,
    RAINY_DUSK,
    RATE,
    second_traverse,
    SIZE,
    Traverse,
    World,
)
from stavpr_ros.sources.frame import Frame

DUSK = replace(RAINY_DUSK, lane=LANE, traffic=3)
AGAIN = 330  # images of lap 2, and of lap 3
LANE_CHANGE = 15  # images
CARRIED = slice(480, 540)  # images left out where the robot is carried, on lap 2
NEXT_DAY = 86_400 * 10**9
CAMERA_IN_BASE = np.array([0.0, 0.0, EYE, -0.5, 0.5, -0.5, 0.5])
"""Pose of the camera's optical frame in the base's, x y z and quaternion x y z w."""


@dataclass(frozen=True)
class RingWorld(World):
    """A synthetic street whose end is its start."""

    @cached_property
    def streets(self) -> tuple[Street, Street]:
        """Return the closed street, and the detour."""
        open_street, detour = super().streets
        cells, end = round(LENGTH / CELL), round(VIEW / CELL) + 1
        lots, lot_of = open_street.lots, open_street.lot_of[:, :cells]
        again = lots.copy()
        again['start'] += LENGTH
        things = open_street.things[open_street.things['along'] < LENGTH]
        ahead = things[things['along'] < VIEW].copy()
        ahead['along'] += LENGTH
        curvature = _closed_curvature(self.seed, cells)
        ring = replace(
            open_street,
            lots=np.concatenate([lots, again]),
            lot_of=np.concatenate([lot_of, lot_of[:, :end] + np.int32(len(lots))], axis=1),
            curvature=np.concatenate([curvature, curvature[:end]]),
            things=np.concatenate([things, ahead]),
            rigid=True,
        )
        return ring, detour

    @cached_property
    def center_line(self) -> np.ndarray:
        """Return x, y and heading (to the left) at the start of each cell, (cells + 1, 3)."""
        street = self.streets[0]
        headings = -street.headings[: round(LENGTH / CELL) + 1]
        middle = (headings[1:] + headings[:-1]) / 2
        steps = CELL * np.stack([np.cos(middle), np.sin(middle)], axis=1)
        return np.column_stack(
            [np.concatenate([[[0.0, 0.0]], np.cumsum(steps, axis=0)]), headings]
        )


def _closed_curvature(seed: int, cells: int) -> np.ndarray:
    """Return the curvature (1/m, to the right) of a closed curve in each of its cells."""
    dice = np.random.default_rng(seed + 991)
    angle = np.linspace(0, 2 * pi, 20_001)
    radius = np.ones_like(angle)
    for waves, share in ((2, 0.22), (3, 0.08)):
        radius += dice.uniform(0.4, 1) * share * np.cos(waves * angle + dice.uniform(0, 2 * pi))
    points = radius * np.exp(1j * angle)
    length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    tangents = np.unwrap(np.angle(np.gradient(points, angle)))
    headings = np.interp(np.arange(cells + 1) / cells * length[-1], length, tangents)
    headings[-1] = headings[0] + 2 * pi
    side = 1 if dice.random() < 0.5 else -1
    curvature: np.ndarray = side * np.diff(headings) / CELL
    return curvature


def _lanes(before: float, after: float, images: int) -> np.ndarray:
    change = np.clip(np.arange(images) / LANE_CHANGE, 0, 1)
    return before + (after - before) * (1 - np.cos(pi * change)) / 2


def _detour(world: RingWorld, meters: np.ndarray) -> np.ndarray:
    """Return poses on the detour, an arc of :data:`DETOUR` meters, at distances from its start."""
    line = world.center_line[round(DETOUR_FROM / CELL) : round(DETOUR_TO / CELL) + 1]
    chord = line[-1, :2] - line[0, :2]
    outward = np.array([-chord[1], chord[0]]) / np.linalg.norm(chord)
    outward *= np.sign(outward @ (line[0, :2] - world.center_line[:, :2].mean(axis=0)))
    bulge = np.sin(np.linspace(0, pi, len(line)))[:, None] ** 2 * outward

    def lengths(height: float) -> np.ndarray:
        steps = np.linalg.norm(np.diff(line[:, :2] + height * bulge, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    low, high = 0.0, DETOUR
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (middle, high) if lengths(middle)[-1] < DETOUR else (low, middle)
    points, at = line[:, :2] + low * bulge, lengths(low)
    tangents = np.unwrap(np.arctan2(*np.gradient(points, axis=0).T[::-1]))
    columns = (points[:, 0], points[:, 1], tangents)
    return np.column_stack([np.interp(meters, at, column) for column in columns])


def true_poses(world: RingWorld, traverse: Traverse) -> np.ndarray:
    """Return the poses of the base at the images of a traverse, shape (images, 3)."""
    line, along = world.center_line, traverse.along
    cell = (along / CELL).astype(int)
    centers = np.column_stack([
        *(np.interp(along, np.arange(len(line)) * CELL, line[:, i]) for i in (0, 1)),
        line[cell, 2],  # the renderer looks along the start of the cell
    ])  # fmt: skip
    if traverse.detour.any():
        centers[traverse.detour] = _detour(world, along[traverse.detour])
    cameras = np.array([traverse.camera(k) for k in range(len(traverse))])
    across, yaw = cameras[:, 0], cameras[:, 2]
    right = np.column_stack([np.sin(centers[:, 2]), -np.cos(centers[:, 2])])
    return np.column_stack([centers[:, :2] + across[:, None] * right, centers[:, 2] - yaw])


@dataclass(frozen=True)
class LapDrive:
    """
    A drive of N images.

    :param truth: poses of the base in the world, shape (N, 3).
    :param odometry: the same as measured; with sessions, each starts at the origin, shape (N, 3).
    :param stamps: shape (N,), ns.
    :param laps: the traverses.
    :param images: (lap, number of its image) of each image, shape (N, 2).
    :param sessions: number of the session of each image, shape (N,).
    """

    truth: np.ndarray
    odometry: np.ndarray
    stamps: np.ndarray
    laps: tuple[Traverse, ...]
    images: np.ndarray
    sessions: np.ndarray

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.stamps)

    def frame(self, i: int) -> Frame:
        """Render image i."""
        lap, number = self.images[i].tolist()
        return Frame(self.laps[lap][number].image, int(self.stamps[i]), '')


def intrinsics() -> np.ndarray:
    """Return the camera matrix of rendered images, without distortion, shape (3, 3)."""
    width, height = SIZE
    focal = FOCAL * width
    return np.array([[focal, 0, width / 2 - 0.5], [0, focal, HORIZON * height - 0.5], [0, 0, 1.0]])


def drive_laps(
    seed: int = 7, draw: int = 0, drift: float = 1.0, carried: bool = False, sessions: int = 1,
    size: tuple[int, int] = SIZE,
) -> LapDrive:  # fmt: skip
    """
    Drive the three laps.

    :param seed: decides the world.
    :param draw: number of the draw of the odometry's errors.
    :param drift: factor on the errors of the odometry.
    :param carried: leave out images on lap 2: the odometry misses that the robot is moved.
    :param sessions: 1, or 2: lap 3 is on the next day and its odometry starts anew.
    """
    world = RingWorld(seed)
    first = np.linspace(0, LENGTH, PLACES, endpoint=False)
    third = np.linspace(0, LENGTH, AGAIN, endpoint=False)
    laps = (
        Traverse(world, first, np.zeros(PLACES, bool), GOOD_LIGHT, size=size),
        second_traverse(world, AGAIN, size, AFTERNOON, _lanes(LANE, -LANE, AGAIN)),
        Traverse(
            world, third, np.zeros(AGAIN, bool), DUSK, size=size, lanes=_lanes(-LANE, LANE, AGAIN)
        ),
    )
    truth = np.concatenate([true_poses(world, lap) for lap in laps])
    truth[:, 2] = np.unwrap(truth[:, 2])
    images = np.array([(i, k) for i, lap in enumerate(laps) for k in range(len(lap))])
    is_recorded = np.ones(len(truth), bool)
    is_recorded[CARRIED] = not carried
    truth, images = truth[is_recorded], images[is_recorded]
    session = (images[:, 0] == 2).astype(int) * (sessions - 1)
    stamps = EPOCH + np.arange(len(truth), dtype=np.int64) * round(1e9 / RATE)
    is_driven = np.ones(len(truth), bool)
    is_driven[CARRIED.start] = not carried
    odometry = add_drift(truth, is_driven, np.random.default_rng([seed, draw]), drift)
    for number in range(1, sessions):
        own = session == number
        odometry[own] = relative_poses(odometry[own][0], odometry[own])
    return LapDrive(truth, odometry, stamps + session * NEXT_DAY, laps, images, session)


def compile_kernels() -> None:
    """Compile the renderer, by an image of each kind of drive, for ``stavpr warm``."""
    world = World()
    first_traverse(world)[0]
    second_traverse(world)[0]
    drive_laps().frame(0)
