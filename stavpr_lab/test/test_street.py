# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The synthetic street: reproducible, geometrically sane, with known ground truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from stavpr_lab.demonstration.street.laps import drive_laps, RingWorld
from stavpr_lab.demonstration.street.rendering import center_line_ahead
from stavpr_lab.demonstration.street.street import CELL
from stavpr_lab.demonstration.street.traverses import (
    GOOD_LIGHT,
    nearest_places,
    second_traverse,
    Traverse,
    World,
)

SIZE = (96, 72)
STILL = replace(GOOD_LIGHT, noise=0.0, shake=0.0)


@pytest.fixture(scope='module')
def world():
    return World(7)


def view(world, along, conditions, size=SIZE):
    """Render one image on the street."""
    return Traverse(world, np.array([along]), np.array([False]), conditions, size=size)[0].image


def test_world_with_same_seed_renders_same_bytes():
    one, same, other = (second_traverse(World(seed), 40, SIZE) for seed in (3, 3, 4))
    assert all(np.array_equal(one[k].image, same[k].image) for k in (0, 17, 39))
    assert not np.array_equal(one[17].image, other[17].image)


def shift_of_patch(before, after, x, y, size=36, reach=14):
    """Find how many pixels a patch has moved sideways."""
    patch = before[y : y + size, x : x + size]
    strip = after[y : y + size, x - reach : x + size + reach]
    return int(cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED).argmax()) - reach


def test_render_with_lateral_step_shows_parallax(world):
    """Houses at the sides are about 20 m away, the vanishing point 60 m and more."""
    near, far = [], []
    for along in np.arange(20.0, 320.0, 20.0):
        before = view(world, along, replace(STILL, lane=0.0), (320, 240))
        after = view(world, along, replace(STILL, lane=0.6), (320, 240))
        near += [shift_of_patch(before, after, x, 60) for x in (24, 260)]
        far.append(shift_of_patch(before, after, 142, 116))
    # the camera steps to the right, the image moves to the left
    assert -9 <= np.median(near) <= -3
    assert abs(np.median(far)) <= 2
    assert abs(np.median(near)) >= 2 * abs(np.median(far))


def test_nearest_places_by_hand(world):
    def traverse(along, detour):
        return Traverse(world, np.array(along), np.array(detour), STILL, size=SIZE)

    first = traverse([0.0, 2.0, 4.0, 6.0], [False] * 4)
    second = traverse([0.9, 1.1, 50.0, 6.9, 3.0], [False, False, True, False, False])
    assert nearest_places(first, second).tolist() == [0, 1, -1, 3, 1]  # the lower one on a tie
    assert np.isnan(second.position[2])


@pytest.mark.parametrize('image', [40, 260, 620])
def test_center_line_ahead_of_closed_street_agrees_with_poses(image):
    drive = drive_laps(5)
    lap, number = drive.images[image].tolist()
    traverse = drive.laps[lap]
    street, along = traverse._streets[0], float(traverse.along[number])
    ahead = center_line_ahead(street, along)[:80]
    x, y, yaw = drive.truth[image]
    across, _, turned = traverse.camera(number)
    yaw += turned  # the camera is turned in the street
    forward, right = np.array([np.cos(yaw), np.sin(yaw)]), np.array([np.sin(yaw), -np.cos(yaw)])
    found = [x, y] + ahead[:, :1] * forward + (ahead[:, 1:2] - across) * right
    line = RingWorld(5).center_line
    cells = (int(along / CELL) + 1 + np.arange(80)) % (len(line) - 1)
    assert np.abs(found - line[cells, :2]).max() < 1e-3  # the ends meet to 0.2 mm
