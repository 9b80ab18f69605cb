# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes: each rule by hand, all of them against a plain loop, image change against noise."""

import dataclasses
from itertools import islice, pairwise
import math

import cv2
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping import image_change, KeyframeSelector, KeyframeSettings, small_gray
from stavpr_ros.sources import open_source

SECOND = 10**9
CHANGE = 0.004  # between a standing camera and the slowest of these drives
BLACK = np.zeros((24, 32, 3), np.uint8)


def pose(x=0.0, degrees=0.0):
    half = math.radians(degrees) / 2
    return np.array([x, 0, 0, 0, 0, math.sin(half), math.cos(half)])


def selector(stamp=10 * SECOND, where=None, image=BLACK, **rules):
    """Make one that has just had a keyframe."""
    made = KeyframeSelector(KeyframeSettings(**rules))
    made.accept(stamp, where, image)
    return made


@pytest.mark.parametrize(
    ('name', 'values'),
    [
        *(
            (name.name, (-1e-9, math.nan, math.inf))
            for name in dataclasses.fields(KeyframeSettings)
        ),
        ('angle', (180.1,)),
        ('change', (2.1,)),
    ],
)
def test_keyframe_settings_out_of_range_are_rejected(name, values):
    for value in values:
        with pytest.raises(SettingsError, match=name):
            KeyframeSettings(**{name: value})


def test_selector_with_new_settings_keeps_keyframe(route):
    """The last keyframe is kept, with the values that only later rules need."""
    made = selector(where=pose(), image=route[0])
    for rules in ({'interval': 1}, {'distance': 1}):
        made.settings = KeyframeSettings(**rules)
        assert made.too_soon(10 * SECOND, pose())
    made.settings = KeyframeSettings(change=0.1)
    reason = made.too_alike(route[0])
    assert 'differs by 0.0000 from the last keyframe: less than 0.1' in reason
    made.reset()
    assert made.too_alike(route[0]) == ''
    made.settings = KeyframeSettings(interval=1, distance=1)
    assert made.too_soon(10 * SECOND, pose()) == ''


def test_selector_with_invalid_pose_changes_nothing():
    made = selector(where=pose(), distance=1)
    for call in (
        lambda wrong: made.too_soon(1, wrong),
        lambda wrong: made.accept(1, wrong, BLACK),
    ):
        with pytest.raises(InputError):
            call(np.full(7, np.nan))
    assert made.too_soon(1, pose(0.5))


STEPS = st.tuples(
    st.integers(0, 4), st.integers(-3, 9), st.integers(-9, 9), st.integers(0, 4), st.booleans()
)


@given(
    steps=st.lists(STEPS, max_size=30),
    rules=st.tuples(
        st.sampled_from([0.0, 2.0, 3.5]),
        st.sampled_from([0.0, 2.0, 3.5]),
        st.sampled_from([0.0, 1.5, 6.5]),
        st.sampled_from([0.0, 0.3]),
    ),
)
def test_selector_equals_plain_loop(steps, rules):
    """Stamps (0 = unknown, some earlier), poses (some unknown) and views, with any rules."""
    seconds, meters, degrees, change = rules
    views = [np.random.default_rng(i).integers(0, 256, (24, 32, 3), np.uint8) for i in range(5)]
    made = KeyframeSelector(KeyframeSettings(*rules))
    kept, expected, last = [], [], None
    x, angle, now = 0, 0, 20
    for i, (dt, dx, turn, view, known) in enumerate(steps):
        now, x, angle = now + dt - 1, x + dx, angle + turn
        stamp = now if dt else 0
        where = pose(x, angle) if known else None
        # the code
        if not made.too_soon(stamp * SECOND, where) and not made.too_alike(views[view]):
            made.accept(stamp * SECOND, where, views[view])
            kept.append(i)
        # the plain loop
        fine = not ((meters or degrees) and not known)
        if fine and last is not None:
            last_stamp, last_x, last_angle, last_known, last_view = last
            if seconds and stamp and last_stamp and last_stamp <= stamp < last_stamp + seconds:
                fine = False
            if (meters or degrees) and last_known:
                moved = bool(meters) and abs(x - last_x) >= meters
                apart = abs(angle - last_angle) % 360  # whole degrees, the rule is between them
                turned = bool(degrees) and min(apart, 360 - apart) > degrees
                fine = fine and (moved or turned)
            if change and view == last_view:
                fine = False
        if fine:
            last = stamp, x, angle, known, view
            expected.append(i)
    assert kept == expected


def test_image_change_by_hand():
    ramp = np.tile(np.arange(32, dtype=np.float32), (24, 1))
    flat = np.full((24, 32), 80, np.float32)
    tall = np.tile(np.arange(24, dtype=np.float32)[:, None], (1, 32))
    assert image_change(ramp, ramp) == pytest.approx(0, abs=1e-6)
    assert image_change(ramp, 100 + 3 * ramp) == pytest.approx(0, abs=1e-6)
    assert image_change(ramp, -ramp) == pytest.approx(2)
    assert image_change(ramp, tall) == pytest.approx(1)  # no correlation
    assert image_change(ramp, ramp + tall) == pytest.approx(1 - math.sqrt(1023 / (1023 + 575)))
    assert image_change(flat, flat + 40) == 0
    assert image_change(flat, ramp) == image_change(ramp, flat) == 1
    rng = np.random.default_rng(0)  # a covered camera sends noise, which differs in every image
    dark = [small_gray(rng.integers(0, 20, (480, 640, 3), np.uint8)) for _ in range(2)]
    assert image_change(*dark) == 0


@pytest.mark.parametrize(
    'traverse', ['gardens_point/day_right', 'corridor/ref', 'rtabmap_hallway_loop/samples']
)
def test_image_change_separates_moving_from_standing_camera(data_folder, traverse):
    frames = list(islice(open_source(data_folder / traverse), 40))
    small = [small_gray(frame.image) for frame in frames]
    moving = min(image_change(a, b) for a, b in pairwise(small))
    assert moving > 1.2 * CHANGE
    standing = [change for frame in frames[::10] for change in standing_changes(frame.image)]
    assert max(standing) < 0.8 * CHANGE


def standing_changes(image):
    """Yield changes of the same scene: fresh noise, other exposure, compressed."""
    rng = np.random.default_rng(1)

    def take(noise=10.0, gain=1.0, quality=50):
        seen = np.clip(gain * image + rng.normal(0, noise, image.shape), 0, 255).astype(np.uint8)
        coded = cv2.imencode('.jpg', seen, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return small_gray(np.ascontiguousarray(cv2.imdecode(coded, cv2.IMREAD_COLOR)))

    first = take(noise=3)
    yield from (image_change(first, take(noise=noise)) for noise in (3, 6, 10))
    yield from (image_change(first, take(gain=gain)) for gain in (0.9, 1.1))


@pytest.mark.parametrize(
    'size', [(480, 640), (24, 32), (72, 32), (270, 480), (720, 1280), (24 * 258, 32)]
)
def test_small_gray_has_the_area_averages_of_opencv(size):
    image = np.random.default_rng(0).integers(200, 256, (*size, 3), np.uint8)
    small = cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA)
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    np.testing.assert_allclose(small_gray(image), cv2.GaussianBlur(gray, (0, 0), 0.5), 1e-6)
