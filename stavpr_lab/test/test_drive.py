# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives by hand: which images are shown, which places are kept, and their ground truth."""

import numpy as np
import pytest
from scores import truth_matrix
from stavpr_lab.evaluation.drive import crop, DriveChanges, INTERVAL
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.errors import SettingsError

# four images in six places: 0 -> 1; 1 -> 2, 3; 2 -> nothing; 3 -> 0, 5
PAIRS = [(0, 1), (1, 2), (1, 3), (3, 0), (3, 5)]


def by_hand(pairs=PAIRS, N=4, n=6):
    return GroundTruth.from_pairs(*np.array(pairs).T, N, n)


@pytest.mark.parametrize(
    ('changes', 'images'),
    [
        ({}, [0, 1, 2, 3, 4, 5, 6]),
        ({'speed': 3}, [0, 3, 6]),
        ({'speed': 1.5}, [0, 1, 3, 4, 6]),
        ({'speed': 0.5}, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6]),
        ({'speed': 4.5}, [0, 4]),
        ({'stops': ((2, 3), (6, 1))}, [0, 1, 2, 2, 2, 2, 3, 4, 5, 6, 6]),
        ({'reverse': True}, [6, 5, 4, 3, 2, 1, 0]),
        ({'reverse': True, 'stops': ((5, 2),), 'speed': 3}, [6, 6, 6, 3, 0]),  # 6 is next to 5
    ],
)
def test_images_of_seven_by_hand(changes, images):
    assert DriveChanges(**changes).images(7).tolist() == images


def test_images_at_seven_tenths_of_the_speed_are_exact():
    """floor(0.7 i), also where 0.7 i is a whole number that binary fractions miss."""
    images = DriveChanges(speed=0.7).images(1000)
    assert images.tolist() == [i * 7 // 10 for i in range(1429)]


def test_images_at_varying_speed_are_between_half_and_double():
    """Steps of 2 ** sin(2 pi i / 60): 1, 1.08, 1.16, ...; 2 near i = 15, 1/2 near i = 45."""
    images = DriveChanges(speed='varying').images(2000)
    assert (images[16] - images[13], images[49] - images[41]) == (6, 4)
    steps = 2 ** np.sin(2 * np.pi * np.arange(len(images)) / 60)
    assert images.tolist() == [int(steps[:i].sum()) for i in range(len(images))]
    assert images[-1] <= 1999 < images[-1] + 3


def test_images_are_dropped_with_the_probability_and_by_the_seed():
    images = DriveChanges(drop=0.3, seed=5).images(4000)
    assert images.tolist() == DriveChanges(drop=0.3, seed=5).images(4000).tolist()
    assert images.tolist() != DriveChanges(drop=0.3, seed=6).images(4000).tolist()
    assert (np.diff(images) > 0).all()
    assert 0.67 < len(images) / 4000 < 0.73


def test_stamps_have_gaps_where_images_are_dropped():
    """Not where the drive is slower: each image is an interval after the one before."""
    truth = GroundTruth.identity(40, 40, 0)
    slow = DriveChanges(speed=0.5).apply(truth)
    np.testing.assert_array_equal(slow.stamps, (np.arange(80) + 1) * INTERVAL)
    dropped = DriveChanges(drop=0.3, seed=5).apply(truth)
    np.testing.assert_array_equal(dropped.stamps, (dropped.images + 1) * INTERVAL)


def test_apply_moves_the_ground_truth_with_images_and_places():
    """Reversed, standing at image 1, without places 1 and 2: 0, 3, 4, 5 become 0, 1, 2, 3."""
    changes = DriveChanges(removed=((1, 3),), reverse=True, stops=((1, 1),))
    drive = changes.apply(by_hand())
    assert drive.images.tolist() == [3, 2, 1, 1, 0]
    assert drive.places.tolist() == [0, 3, 4, 5]
    assert drive.truth.pairs.tolist() == [[0, 0], [0, 3], [2, 1], [3, 1]]
    assert (drive.truth.N, drive.truth.n) == (5, 4)


def test_apply_equals_the_matrix_of_any_ground_truth():
    rng = np.random.default_rng(0)
    for seed in range(20):
        matrix = rng.random((30, 25)) < 0.08
        truth = GroundTruth.from_pairs(*np.nonzero(matrix), 30, 25)
        first, other = sorted(rng.choice(25, 2, replace=False).tolist())
        removed, stops = ((first, other),), ((seed, 4),)
        drive = DriveChanges(removed, drop=0.2, seed=seed, speed=0.6, stops=stops).apply(truth)
        expected = np.delete(matrix[drive.images], np.arange(first, other), axis=1)
        np.testing.assert_array_equal(truth_matrix(drive.truth), expected)


def test_unseen_images_are_more_than_five_places_from_the_map():
    """Places 10..29 and 40..44 of 60 are removed; 25 and 42 are 5 and 3 from a kept one."""
    changes = DriveChanges(removed=((10, 30), (40, 45)))
    for tolerance in (0, 3):
        first, second = changes.apply(GroundTruth.identity(60, 60, tolerance)).unseen()
        assert np.flatnonzero(first).tolist() == list(range(15, 25))
        assert not second.any()
    # with a tolerance of 8, all others have a correct place among 0 .. 9 or from 30 on
    wide = changes.apply(GroundTruth.identity(60, 60, 8)).unseen()[0]
    assert np.flatnonzero(wide).tolist() == [18, 19, 20, 21]


def test_unseen_images_of_adjacent_stretches_count_once():
    truth = GroundTruth.identity(40, 40)
    first, second = DriveChanges(removed=((0, 12), (12, 20))).apply(truth).unseen()
    assert np.flatnonzero(first).tolist() == list(range(12))
    assert np.flatnonzero(second).tolist() == [12, 13, 14]


def test_unseen_images_of_two_places_have_lost_both():
    """Image 0 shows 20 and 50, image 1 20 and 51, image 2 nothing; 50 and 51 are ten apart."""
    truth = by_hand([(0, 20), (0, 50), (1, 20)], 3, 60)
    both = DriveChanges(removed=((10, 30), (40, 60))).apply(truth).unseen()
    assert [mask.tolist() for mask in both] == [[True, True, False], [False] * 3]
    for others in ({}, {'reverse': True}):
        one = DriveChanges(removed=((10, 30),), **others).apply(truth).unseen()
        assert one[0].tolist() == [False, True, False]


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'drop': 1.0}, 'drop = 1.0: expected a probability'),
        ({'drop': float('nan')}, 'drop = nan'),
        ({'seed': -1}, 'seed = -1'),
        ({'stops': ((2, 0),)}, 'stop 2:0: expected at least one'),
        ({'stops': ((7, 1),)}, 'stop 7:1: the query has the images 0 .. 6'),
        ({'speed': 0.0}, r'speed 0: expected 0\.01 \.\. 100'),
        ({'speed': float('nan')}, 'speed nan'),
        ({'speed': 'fast'}, 'a number or varying'),
        ({'removed': ((2, 2),)}, 'removed places 2:2: expected 0 <= FIRST < LAST <= 7'),
        ({'removed': ((0, 8),)}, 'removed places 0:8'),
        ({'removed': ((0, 3), (2, 4))}, 'removed places 2:4 overlap'),
        ({'removed': ((0, 3), (3, 7))}, 'all 7 places'),
    ],
)
def test_changes_out_of_range_raise(changes, message):
    with pytest.raises(SettingsError, match=message):
        DriveChanges(**changes).apply(GroundTruth.identity(7, 7))


# ---------------------------------------------------------------------------------- cropping


@pytest.mark.parametrize(
    'fractions', [(-0.1, 0), (0, -0.1), (0.5, 0.5), (1, 0), (float('nan'), 0)]
)
def test_cropped_by_invalid_fractions_raises(fractions):
    with pytest.raises(SettingsError, match='fractions >= 0'):
        crop([], *fractions)
