# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Teach and repeat in the simulator: a short lap, a covered camera, another route."""

import math

import numpy as np
import pytest
from stavpr_lab.demonstration.repeat import (
    animate,
    CONDITIONS,
    plot,
    repeat,
    STEP,
    teach,
    View,
)
from stavpr_lab.demonstration.street.laps import RingWorld
from stavpr_lab.demonstration.street.rendering import FOCAL
from stavpr_lab.demonstration.street.street import CELL
from stavpr_lab.demonstration.street.traverses import GOOD_LIGHT, RAINY_DUSK, Traverse, World
from stavpr_ros.relative_pose.expansion import Expansion
from stavpr_ros.relative_pose.offset import describe_columns, OffsetFilter

COVERED = 20.0  # seconds


@pytest.fixture(scope='module')
def taught():
    return teach(RingWorld(7), 0.0, 60.0)


def cover(image, time):
    """Cover the camera after some seconds; noise is left."""
    dark = np.random.default_rng(round(time * 10)).normal(15, 3, image.shape)
    return image if time < COVERED else dark.clip(0, 255).astype(np.uint8)


def test_robot_returns_to_its_path_at_dusk_and_stops_when_covered(taught, tmp_path):
    images = []

    def change(image, time):
        images.append(image)
        return cover(image, time)

    drive = repeat(taught, CONDITIONS['dusk'], COVERED + 3, begin=10, change=change)
    assert drive.errors[0] == pytest.approx((1.0, math.radians(10)), abs=0.05)
    driven = np.cumsum(drive.speeds) * STEP
    assert driven[-1] > 25
    assert drive.within(0.5) >= 0.95
    assert drive.within(1.0, after=15.0) == 1.0
    assert drive.presses == 0
    covered = drive.times >= COVERED
    assert drive.speeds[covered][0] > 1
    assert drive.speeds[covered & (drive.times > COVERED + 1)].max() < 0.05
    assert drive.reasons[-1] == 'not localized on the route'
    plot(taught, {'dusk': drive}, tmp_path / 'repeat.png')
    assert (tmp_path / 'repeat.png').stat().st_size > 10_000
    animate(taught, drive, images[:15], tmp_path / 'repeat.webp')
    assert (tmp_path / 'repeat.webp').stat().st_size > 10_000


@pytest.mark.parametrize(('seed', 'seconds', 'meters'), [(11, 4, 8), (13, 1, 1.2)])
def test_robot_stops_where_the_camera_shows_another_route(taught, seed, seconds, meters):
    """Street 11 has the same cars as the taught one, at the same places."""
    world = RingWorld(seed)
    other, line, shown = View(world, CONDITIONS['day']), world.center_line[:-1], []

    def change(image, time):
        if time < 12:
            return image
        shown.append(other.image(line[round(0.5 / CELL) * len(shown)], len(shown)))
        return shown[-1]

    drive = repeat(taught, CONDITIONS['day'], 12.5 + seconds, begin=10, change=change)
    assert drive.speeds[drive.times < 12][-1] > 2
    assert drive.speeds[drive.times >= 12 + seconds].max() < 0.05
    assert drive.speeds[drive.times >= 12].sum() * STEP < meters


def test_robot_on_another_route_does_not_move(taught):
    drive = repeat(taught, CONDITIONS['day'], 4.0, begin=10, world=RingWorld(11))
    assert drive.speeds.max() == 0


def test_view_at_a_pose_of_the_street(taught):
    view, line = View(taught.world, CONDITIONS['day']), taught.world.center_line
    for along in (0.3, 123.4, 599.6):
        cell = int(along / CELL)
        x, y, heading = line[cell]
        ahead, right = along - cell * CELL, 1.3
        pose = np.array([
            x + ahead * math.cos(heading) + right * math.sin(heading),
            y + ahead * math.sin(heading) - right * math.cos(heading),
            heading,
        ])  # fmt: skip
        assert view.on_street(pose) == pytest.approx((along, right), abs=1e-6)


def test_heading_on_the_other_lane_at_dusk_in_rain():
    """The end of the street is not infinitely far: it is shifted as well, by about 1.5 degrees."""
    along, world = np.arange(100, 140, 2.0), World(21)
    taught, other = (
        Traverse(world, along, np.zeros(len(along), bool), light)
        for light in (GOOD_LIGHT, RAINY_DUSK)
    )
    estimator, errors = OffsetFilter(), []
    for k in range(len(along)):
        columns = [describe_columns(traverse[k].image) for traverse in (other, taught)]
        offset = estimator.update(*columns)
        truth = taught.camera(k)[2] - other.camera(k)[2]
        errors.append((offset.heading(FOCAL) - truth, math.atan(offset.shift / FOCAL) - truth))
    rms = np.degrees(np.sqrt(np.mean(np.square(errors), axis=0)))
    assert rms[0] < 1.2
    assert rms[0] < 0.8 * rms[1]


def test_lateral_offset_in_meters_at_dusk(taught):
    columns = [describe_columns(taught.place_map.thumbnail(k)) for k in range(70)]
    expansion = Expansion(columns.__getitem__, taught.run.distances[:70])
    view = View(taught.world, CONDITIONS['dusk'])
    for left in (1.0, -1.0):
        estimator, results = OffsetFilter(), []
        for k in range(30, 60, 2):
            x, y, heading = taught.poses[k]
            pose = x - left * math.sin(heading), y + left * math.cos(heading), heading
            offset = estimator.update(describe_columns(view.image(np.array(pose), k)), columns[k])
            results.append(expansion.lateral(offset, k, FOCAL))
        lateral, deviation = np.median(results, axis=0)
        assert lateral == pytest.approx(left, abs=0.4)
        assert 0.1 < deviation < 1.0
