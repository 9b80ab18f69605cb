# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Heading errors by registration: signs, subpixel shifts, images that determine none."""

import cv2
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from stavpr_ros.errors import ImageError
from stavpr_ros.mapping import thumbnail_of
from stavpr_ros.relative_pose import offset as module
from stavpr_ros.relative_pose.expansion import AHEAD, Expansion
from stavpr_ros.relative_pose.offset import (
    A,
    B,
    BLOCKS,
    describe_columns,
    DRIFT,
    EVIDENCE,
    JUMP,
    MIN_OVERLAP,
    Offset,
    OffsetFilter,
    PARTS,
    SHIFTS,
    STEP,
)
from stavpr_ros.sources import open_source

WIDTH, HEIGHT, PANORAMA = 192, 144, 400


def panorama(seed=0):
    """Return a wide image of random rectangles, (144, 400, 3)."""
    rng = np.random.default_rng(seed)
    image = np.full((HEIGHT, PANORAMA, 3), 128, np.uint8)
    for _ in range(300):
        x, y, w, h = rng.integers((0, 0, 4, 4), (PANORAMA, HEIGHT, 40, 60)).tolist()
        color = tuple(rng.integers(0, 255, 3).tolist())
        cv2.rectangle(image, (x, y), (x + w, y + h), color, -1)
    return image


def warp(image, shift=0.0, beside=0.0):
    """Return the middle of a panorama, shifted to the right; pixels, in all and beside."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    u = abs(x + 0.5 - WIDTH / 2) / (WIDTH / 2)
    source = (PANORAMA - WIDTH) / 2 + x - shift - beside * u
    return cv2.remap(image, source.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)


def offset(query, place) -> Offset:
    return OffsetFilter().update(describe_columns(query), describe_columns(place))


def plain_evidence(query, place):
    """Return the evidence, and whether enough blocks overlap, (models, shifts), from the text."""
    means = np.full((BLOCKS, len(SHIFTS)), np.nan)
    for block, columns in enumerate(np.split(np.arange(WIDTH), BLOCKS)):
        for k, shift in enumerate(SHIFTS):
            pairs = [(x, x + shift) for x in columns if 0 <= x + shift < WIDTH]
            if 2 * len(pairs) >= len(columns):
                products = [place[x].astype(float) @ query[y].astype(float) for x, y in pairs]
                means[block, k] = np.mean(products)
    evidence, is_enough = np.zeros((2, len(A), len(SHIFTS)))
    centers = (np.arange(BLOCKS) + 0.5) / BLOCKS * 2 - 1
    for model, (a, b) in enumerate(zip(A, B, strict=True)):
        beside = np.rint((a * centers + b) * abs(centers) * WIDTH / 2 * PARTS) / PARTS
        at = beside[:, None] + np.arange(len(SHIFTS))
        shown = np.array([plain_mean(*block) for block in zip(means, at, strict=True)])
        for k in range(len(SHIFTS)):
            used = shown[~np.isnan(means[:, k]), k]
            if len(used):
                evidence[model, k] = EVIDENCE * used.sum() / np.sqrt(BLOCKS * len(used))
            is_enough[model, k] = len(used) >= MIN_OVERLAP * BLOCKS
    return evidence, is_enough


def plain_mean(row, at):
    """Return a mean between pixels; beside the shifts at which the block overlaps, the last."""
    covered = np.flatnonzero(~np.isnan(row))
    cubic = CubicHermiteSpline(covered, row[covered], np.gradient(row[covered]))
    return cubic(np.clip(at, covered[0], covered[-1]))


def plain_drifted(earlier):
    padded = np.pad(earlier, ((0, 0), (STEP, STEP)), mode='edge')
    steps = range(-STEP, STEP + 1)
    parts = [padded[:, STEP + by :][:, : len(SHIFTS)] - 0.5 * (by / DRIFT) ** 2 for by in steps]
    return np.maximum(np.max(parts, axis=0), earlier.max() - JUMP)


def test_kernels_equal_plain_sums():
    image = panorama(3)
    query, place = describe_columns(warp(image, 9, 4)), describe_columns(warp(image))
    evidence, is_enough = module.block_evidence(query, place, OffsetFilter()._beside)
    expected, enough = plain_evidence(query, place)
    np.testing.assert_allclose(evidence, expected, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(is_enough, enough)
    np.testing.assert_array_equal(module._drift(evidence), plain_drifted(evidence))


@pytest.mark.parametrize('shift', [-48.0, -7.5, 0.0, 3.3, 60.0])
def test_shift_is_positive_where_the_scene_is_further_right(shift):
    image = panorama()
    result = offset(warp(image, shift), warp(image))
    assert result.is_valid
    assert result.shift * WIDTH == pytest.approx(shift, abs=1.0)
    assert result.deviation * WIDTH < 3
    assert abs(result.parallax) < 0.02


@pytest.mark.parametrize('beside', [-1.8, -0.9, 0.0, 0.9, 1.8])
@pytest.mark.parametrize('shift', [-9.0, 0.0, 9.0])
def test_parallax_below_a_step_is_seen_and_no_shift_counts_as_parallax(beside, shift):
    """A parallax of .9 pixels is .2 m on a street: less than half a step of B."""
    results = []
    for seed in range(6):
        image = panorama(seed)
        results.append(offset(warp(image, shift, beside), warp(image)).parallax * WIDTH)
    assert np.mean(results) == pytest.approx(beside, abs=0.5)


@pytest.mark.parametrize('beside', [-12.0, 12.0])
def test_near_scene_beside_the_path_is_parallax_not_heading(beside):
    image = panorama(1)
    result = offset(warp(image, 5.0, beside), warp(image))
    assert result.is_valid
    assert result.shift * WIDTH == pytest.approx(5.0, abs=3)
    assert result.parallax * WIDTH == pytest.approx(beside, rel=0.4)


def test_camera_that_turns_at_once_is_followed():
    image, one = panorama(2), OffsetFilter()
    place = describe_columns(warp(image))
    for shift in [0.0] * 8 + [40.0] * 2:
        result = one.update(describe_columns(warp(image, shift)), place)
    assert result.is_valid
    assert result.shift * WIDTH == pytest.approx(40, abs=2)


def test_repeating_structure_is_resolved_by_earlier_images():
    """A peak of one image alone is wrong; the sum over the images keeps the right one."""
    column = panorama(4)[:, 100:124]
    repeated = np.tile(column, (1, 17, 1))[:, :PANORAMA]
    history, single = OffsetFilter(), OffsetFilter()
    for seed in range(3):
        image = panorama(seed)
        history.update(describe_columns(warp(image, 12)), describe_columns(warp(image)))
    pair = describe_columns(warp(repeated, 12)), describe_columns(warp(repeated))
    assert history.update(*pair).shift * WIDTH == pytest.approx(12, abs=3)
    assert not single.update(*pair).is_valid
    history.reset()
    assert not history.update(*pair).is_valid


def test_covered_camera_has_no_valid_offset_from_its_first_image():
    image, estimator = panorama(2), OffsetFilter()
    rng = np.random.default_rng(0)
    place = describe_columns(warp(image))
    for _ in range(5):
        assert estimator.update(place, place).is_valid
    noise = rng.normal(20, 3, (HEIGHT, WIDTH, 3)).clip(0, 255).astype(np.uint8)
    for covered in (noise, np.zeros_like(noise)):
        assert not estimator.update(describe_columns(covered), place).is_valid


def forward(image, outward):
    """Return the middle of a panorama after a move forward; pixels outward at both sides."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    u = (x + 0.5 - WIDTH / 2) / (WIDTH / 2)
    source = (PANORAMA - WIDTH) / 2 + x - outward * u * (AHEAD + abs(u))
    return cv2.remap(image, source.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)


@pytest.mark.parametrize('spacing', [0.5, 0.25])
def test_lateral_offset_follows_from_the_expansion_between_places(spacing):
    """With an expansion of 0.06 half widths per meter, 1 m has a parallax of 0.06 f widths."""
    image, damaged = panorama(1), 3
    steps = 0.06 * spacing * (np.arange(8) - 4) * WIDTH / 2
    places = [describe_columns(forward(image, outward)) for outward in steps]

    def columns(k):
        if k == damaged:
            raise ImageError('damaged', kind='damaged')
        return places[k]

    one = Offset(0.0, 0.01, 0.03, 1e6, 0.6, parallax_deviation=0.003)
    expansion = Expansion(columns, np.arange(8) * spacing)
    lateral, deviation = expansion.lateral(one, 4, 0.5)
    assert lateral == pytest.approx(1.0, rel=0.2)
    assert 0.1 < deviation < 0.5
    assert np.isnan(expansion.lateral(one, 4, np.nan)).all()


def test_lateral_offset_is_uncertain_where_places_are_at_rest():
    place = describe_columns(warp(panorama()))
    one = Offset(0.0, 0.01, 0.03, 1e6, 0.6, parallax_deviation=0.003)
    lateral, deviation = Expansion(lambda _: place, np.zeros(12)).lateral(one, 4, 0.5)
    assert deviation > lateral


def test_crops_of_real_images_by_day_and_night(data_folder):
    """The shift of a crop adds to the shift that the images have; pixels of 1024."""
    folders = [data_folder / 'walk_by_night' / name for name in ('left_day', 'right_night')]
    places, queries = ([frame.image for frame in open_source(folder)] for folder in folders)
    own, cropped, errors = OffsetFilter(), OffsetFilter(), []

    def crop(image, share):
        width = image.shape[1]
        first = round(width * (0.13 + share))
        return describe_columns(thumbnail_of(image[:, first : first + round(width * 0.73)]))

    for place, query in zip(places[:60], queries[:60], strict=True):
        columns = crop(place, 0)
        both = own.update(crop(query, 0), columns), cropped.update(crop(query, 0.08), columns)
        if all(result.is_valid for result in both):
            errors.append((both[1].shift - both[0].shift + 0.08 / 0.73) * 1024)
    assert len(errors) >= 20
    assert np.sqrt(np.mean(np.square(errors))) < 10
