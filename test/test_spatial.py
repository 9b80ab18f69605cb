# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Spatial alignment: worked examples, and every strategy bit for bit against the oracle."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import align_images, image_distances, SpatialSettings

ADAPTIVE = SpatialSettings()
VANILLA = SpatialSettings(strategy='vanilla')
WINDOW = SpatialSettings(strategy='sliding_window')
DTYPES = [np.float32, np.float64]
BLOCK_BORDERS = [0, 1, 7, 8, 31, 32, 33, 63, 64, 65, 127, 128, 129, 300]


def path_of(aligned):
    return [tuple(cell) for cell in aligned.path.tolist()]


def one(d, spatial):
    """Distance of a single pair through the batch kernel."""
    result = image_distances(np.ascontiguousarray(d[:, :, None]), spatial)
    assert result.shape == (1,)
    assert result.dtype == d.dtype
    return result[0]


def random_distances(seed, W, n, dtype, levels, banned=0.0):
    """
    Distances of few levels, so that ties abound, or any floats (levels = 0); a share of them +inf.

    Some lie below zero, as after a projection.
    """
    rng = np.random.default_rng(seed)
    if levels == 0:
        d = rng.uniform(-0.05, 1.5, (W, W, n))
    else:
        d = rng.integers(-1, levels + 1, (W, W, n)) / levels
    d[rng.random((W, W, n)) < banned] = np.inf
    return d.astype(dtype)


# ------------------------------------------------ worked by hand


@pytest.mark.parametrize('dtype', DTYPES)
def test_golden_example_adaptive(dtype):
    d = oracle.GOLDEN.astype(dtype)
    aligned = align_images(d, ADAPTIVE)
    tolerance = 5e-9 if dtype is np.float64 else 2e-6
    assert aligned.weight == pytest.approx(math.sqrt(3), abs=tolerance)
    assert aligned.accumulated == pytest.approx(3.42635861, abs=tolerance)
    assert aligned.cost == pytest.approx(11.92820323, abs=tolerance)
    assert aligned.distance == pytest.approx(0.28724851, abs=tolerance)
    assert path_of(aligned) == oracle.GOLDEN_PATH
    assert aligned.path.dtype == np.int32
    assert one(d, ADAPTIVE) == aligned.distance


@pytest.mark.parametrize('dtype', DTYPES)
def test_golden_example_vanilla(dtype):
    d = oracle.GOLDEN.astype(dtype)
    aligned = align_images(d, VANILLA)
    # the path's nine cells: .51 .44 .32 .23 .14 .17 .22 .37 .47 = 2.87; 2.87 / 9 = 0.31888889
    tolerance = 5e-9 if dtype is np.float64 else 1e-6
    assert aligned.weight == 1
    assert aligned.cost == 9
    assert aligned.distance == pytest.approx(0.31888889, abs=tolerance)
    assert path_of(aligned) == oracle.GOLDEN_PATH
    assert one(d, VANILLA) == aligned.distance


def test_diagonal_loses_a_tie_with_vertical():
    # S12 = 1 + 0 = 1, S21 = 3; at (2,2): diagonal 3 + 1, vertical 3 + 1, horizontal 3 + 3: vertical, C = 3
    d = np.array([[1.0, 0], [2, 3]])
    aligned = align_images(d, VANILLA)
    assert path_of(aligned) == [(0, 0), (0, 1), (1, 1)]
    assert aligned.distance == 4 / 3  # a diagonal step would give 4 / 2
    assert one(d, VANILLA) == 4 / 3


def test_diagonal_loses_a_tie_with_horizontal():
    # S12 = 3, S21 = 1; at (2,2): diagonal 3 + 1, vertical 3 + 3, horizontal 3 + 1: horizontal, C = 3
    d = np.array([[1.0, 2], [0, 3]])
    aligned = align_images(d, VANILLA)
    assert path_of(aligned) == [(0, 0), (1, 0), (1, 1)]
    assert aligned.distance == 4 / 3
    assert one(d, VANILLA) == 4 / 3


def test_vertical_wins_over_horizontal():
    # S = 0  1 10      (2,3): diagonal 1 + 1 = 2, C = 3
    #     1  9  2      (3,2): diagonal 1 + 1, vertical 1 + 9, horizontal 1 + 1: horizontal, C = 4
    #     1  2  3      (3,3): diagonal 1 + 9, vertical 1 + 2, horizontal 1 + 2: vertical, C = 3 + 1
    d = np.array([[0.0, 1, 9], [1, 9, 1], [0, 1, 1]])
    aligned = align_images(d, VANILLA)
    assert path_of(aligned) == [(0, 0), (0, 1), (1, 2), (2, 2)]
    assert aligned.distance == 3 / 4  # horizontal would give 3 / 5
    assert one(d, VANILLA) == 3 / 4


def test_tie_is_judged_on_the_rounded_sums():
    # S11 = 1 < S12 = 1 + ulp, but 4 + S11 and 4 + S12 both round to 5: a tie, vertical, C = 3
    for dtype in DTYPES:
        d = np.array([[1, np.finfo(dtype).eps], [1, 4]], dtype)
        aligned = align_images(d, VANILLA)
        assert path_of(aligned) == [(0, 0), (0, 1), (1, 1)]
        assert one(d, VANILLA) == dtype(5) / dtype(
            3
        )  # taking the minimum over S first gives 5 / 2


def test_adaptive_weight_by_hand():
    # W = 2, c = ceil(2 / 2) = 1, row 1 = .5 .1: I = 2, a = sqrt(1 + 1). S12 = .6, S21 = 1.5
    # (2,2): diagonal sqrt(2) * 1 + .5 = 1.914, vertical 1 + .6 = 1.6, horizontal 2.5: vertical, C = 3
    d = np.array([[0.5, 0.1], [1.0, 1.0]])
    aligned = align_images(d, ADAPTIVE)
    assert aligned.weight == math.sqrt(2)
    assert aligned.distance == pytest.approx(1.6 / 3)
    # sigma = 3: a = sqrt(1 + 3) = 2; with .2 at the end: diagonal 2 * .2 + .5 = .9 > vertical .2 + .6 = .8
    d = np.array([[0.5, 0.1], [1.0, 0.2]])
    aligned = align_images(d, SpatialSettings(sigma=3.0))
    assert aligned.weight == 2
    assert aligned.distance == pytest.approx(0.8 / 3)
    # vanilla: diagonal .2 + .5 = .7, C = 2; sigma = 0 is vanilla
    assert align_images(d, VANILLA).distance == pytest.approx(0.7 / 2)
    assert (
        align_images(d, SpatialSettings(sigma=0.0)).distance == align_images(d, VANILLA).distance
    )


def test_diagonal_step_costs_its_weight():
    # W = 3, c = 2, row 2 = .1 .5 .9: I = 1, a = sqrt(2); zeros on the rest of the diagonal, 9 elsewhere
    # S22 = min(.707, 9.5, .6): horizontal from S21 = .1, C = 3; S33: diagonal 0 + .6, C = 3 + sqrt(2)
    d = np.array([[0.0, 9, 9], [0.1, 0.5, 0.9], [9, 9, 0]])
    aligned = align_images(d, ADAPTIVE)
    assert path_of(aligned) == [(0, 0), (1, 0), (1, 1), (2, 2)]
    assert aligned.cost == pytest.approx(3 + math.sqrt(2))
    assert aligned.distance == pytest.approx(0.6 / (3 + math.sqrt(2)))


@pytest.mark.parametrize(
    ('row', 'places_away'),
    [
        ([9, 5, 9, 9], 0),  # W = 4: c = 2, not 3
        ([9, 9, 5, 9], 1),
        ([5, 9, 9, 5], 1),  # a tie: the first minimum, place 1, not place 4
        ([9, 9, 5, 5], 1),
        ([9, 9, 9, 5], 2),
    ],
)
def test_central_row_of_an_even_number_of_strips(row, places_away):
    d = np.full((4, 4), 7.0)
    d[1] = row
    assert align_images(d, ADAPTIVE).weight == math.sqrt(1 + places_away)


def test_distance_is_not_symmetric():
    # row 2 = 9 0 0: I = 2, a = 1: S22 = 0 by the diagonal, S23 = 0; S33 = 1 + 0 by vertical or horizontal
    # transposed, row 2 = 0 0 9: I = 1, a = sqrt(2)
    d = np.array([[0.0, 0, 9], [9, 0, 0], [9, 9, 1]])
    assert align_images(d, ADAPTIVE).weight == 1
    assert align_images(np.ascontiguousarray(d.T), ADAPTIVE).weight == math.sqrt(2)
    d = np.array([[1.0, 3, 3], [0, 1, 3], [3, 3, 1]])
    # row 2 = 0 1 3: a = sqrt(2): (2,2): diagonal 1.414 + 1, vertical 1 + 4, horizontal 1 + 1 = 2, C = 3
    # (3,3): diagonal 1.414 + 2, C = 3 + 1.414; transposed, row 2 = 3 1 3: a = 1: (2,2) is 2 both ways
    # round the free cell, vertical, C = 3; (3,3): diagonal 1 + 2, C = 4
    assert one(d, ADAPTIVE) == pytest.approx((2 + math.sqrt(2)) / (3 + math.sqrt(2)))
    assert one(np.ascontiguousarray(d.T), ADAPTIVE) == pytest.approx(3 / 4)


def test_single_strip():
    for dtype in DTYPES:
        d = np.array([[[0.25, 0.75]]], dtype)
        for spatial in (ADAPTIVE, VANILLA, SpatialSettings(xi=1)):
            assert image_distances(d, spatial).tolist() == [0.25, 0.75]
        assert path_of(align_images(d[:, :, 0], ADAPTIVE)) == [(0, 0)]


# ------------------------------------------------ restricted alignment


def test_restriction_leaves_29_of_49_cells():
    allowed = set()
    restricted = SpatialSettings(strategy='vanilla', xi=3)
    for i in range(7):
        for j in range(7):
            d = np.ones((7, 7))
            d[i, j] = -100  # whoever may use this cell does
            if one(d, restricted) < 0:
                allowed.add((i, j))
            assert (one(d, restricted) < 0) == ((i, j) in path_of(align_images(d, restricted)))
    assert allowed == {(i, j) for i in range(7) for j in range(7) if abs(i - j) < 3}
    assert len(allowed) == 29


def test_banned_cells_are_never_used():
    d = np.ones((7, 7))
    for i in range(7):
        for j in range(7):
            if abs(i - j) >= 3:
                d[i, j] = 0  # would be free
    aligned = align_images(d, SpatialSettings(xi=3))
    assert all(abs(i - j) < 3 for i, j in path_of(aligned))
    assert aligned.distance == 1.0
    assert one(d, SpatialSettings(xi=3)) == 1.0


def test_xi_of_one_is_the_mean_of_the_diagonal():
    d = np.full((7, 7), 0.0)
    np.fill_diagonal(
        d, [1, 2, 3, 4, 5, 6, 7]
    )  # row 4's minimum lies outside, I_4 = 4 and a = 1 all the same
    aligned = align_images(d, SpatialSettings(xi=1))
    assert (aligned.weight, aligned.cost, aligned.distance) == (1, 7, 4)
    assert path_of(aligned) == [(i, i) for i in range(7)]
    assert one(d, SpatialSettings(xi=1)) == 4


def test_xi_of_w_bans_nothing():
    d = oracle.GOLDEN
    assert one(d, SpatialSettings(xi=7)) == one(d, ADAPTIVE)


def test_central_minimum_is_sought_among_the_allowed():
    d = np.ones((7, 7))
    d[3, 0] = 0.1  # |4 - 1| = 3: banned at xi = 3
    d[3, 5] = 0.2
    assert align_images(d, ADAPTIVE).weight == 2  # I = 1: sqrt(1 + 3)
    assert align_images(d, SpatialSettings(xi=3)).weight == math.sqrt(3)  # I = 6: sqrt(1 + 2)
    assert one(d, SpatialSettings(xi=3)) == float(oracle.align_images(d, xi=3).distance)


# ------------------------------------------------ sliding window


def test_sliding_window_by_hand():
    d = np.full((5, 5), 9.0)
    # p = 1, q = 2: (1 + 2 + 3 + 4) / 4; every other start sees 9s only
    d[0, 1], d[1, 2], d[2, 3], d[3, 4] = 1, 2, 3, 4
    assert one(d, WINDOW) == 2.5
    d[np.diag_indices(5)] = [0, 1, 1, 1, 9]  # p = q = 1: 3 / 4; p = q = 2: 12 / 4
    assert one(d, WINDOW) == 0.75
    d[np.diag_indices(5)] = [9, 1, 1, 1, 0]  # the last start, p = q = 2
    assert one(d, WINDOW) == 0.75


def test_sliding_window_as_wide_as_the_image():
    d = np.full((4, 4), 0.0)
    d[np.diag_indices(4)] = [1, 2, 3, 6]  # one start only, so the zeros do not count
    assert one(d, WINDOW) == 3


# ------------------------------------------------ the kernels against the oracle, exactly


@pytest.mark.parametrize('dtype', DTYPES)
@pytest.mark.parametrize('W', range(1, 10))
def test_every_size_equals_the_oracle(W, dtype):
    # hypothesis likes the smallest of everything: this sweep is sure to meet every size and kind of ties
    for strategy in ('adaptive', 'vanilla', 'sliding_window')[: 3 if W >= 4 else 2]:
        for levels in (0, 2, 6):
            for xi in {None, 1, (W + 1) // 2, W}:
                d = random_distances(W, W, 5, dtype, levels)
                result = image_distances(d, SpatialSettings(strategy=strategy, xi=xi))
                np.testing.assert_array_equal(
                    result, oracle.image_distances(d, strategy, 1.0, xi, dtype)
                )


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    W=st.integers(1, 9),
    n=st.sampled_from([0, 1, 2, 3, 5, 9, 17]),
    dtype=st.sampled_from(DTYPES),
    levels=st.sampled_from([0, 1, 2, 4, 10]),
    strategy=st.sampled_from(['adaptive', 'vanilla', 'sliding_window']),
    sigma=st.sampled_from([1.0, 0.0, 0.5, 0.3, 7.0]),
    restriction=st.integers(0, 9),
    banned=st.sampled_from([0.0, 0.0, 0.1, 0.5]),
)
def test_image_distances_equal_the_oracle(
    seed, W, n, dtype, levels, strategy, sigma, restriction, banned
):
    if strategy == 'sliding_window':
        W = max(W, 4)
    xi = None if restriction == 0 else min(restriction, W)
    d = random_distances(seed, W, n, dtype, levels, banned)
    result = image_distances(d, SpatialSettings(strategy=strategy, sigma=sigma, xi=xi))
    expected = oracle.image_distances(d, strategy, sigma, xi, dtype)
    assert result.dtype == dtype
    np.testing.assert_array_equal(result, expected)


@pytest.mark.parametrize('n', BLOCK_BORDERS)
@pytest.mark.parametrize('strategy', ['adaptive', 'vanilla', 'sliding_window'])
def test_block_borders_equal_the_oracle(n, strategy):
    for dtype, W, xi in ((np.float32, 5, None), (np.float64, 4, 3)):
        d = random_distances(n, W, n, dtype, 3)
        result = image_distances(d, SpatialSettings(strategy=strategy, xi=xi))
        np.testing.assert_array_equal(result, oracle.image_distances(d, strategy, 1.0, xi, dtype))


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    W=st.integers(1, 9),
    dtype=st.sampled_from(DTYPES),
    levels=st.sampled_from([0, 1, 2, 4, 10]),
    strategy=st.sampled_from(['adaptive', 'vanilla']),
    sigma=st.sampled_from([1.0, 0.0, 0.5, 0.3]),
    restriction=st.integers(0, 9),
)
def test_alignment_of_a_pair_equals_the_oracle(
    seed, W, dtype, levels, strategy, sigma, restriction
):
    xi = None if restriction == 0 else min(restriction, W)
    spatial = SpatialSettings(strategy=strategy, sigma=sigma, xi=xi)
    d = random_distances(seed, W, 1, dtype, levels)
    aligned = align_images(d[:, :, 0], spatial)
    expected = oracle.align_images(d[:, :, 0], strategy, sigma, xi, dtype)
    assert path_of(aligned) == expected.path
    assert aligned.distance == expected.distance
    assert (aligned.accumulated, aligned.cost) == (expected.accumulated, expected.cost)
    assert aligned.weight == expected.weight
    assert image_distances(d, spatial)[0] == expected.distance


def test_answers_do_not_depend_on_the_number_of_threads():
    numba = pytest.importorskip('numba')
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip('one processor only')
    d = random_distances(3, 7, 5000, np.float32, 0)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            results.append(
                [image_distances(d, spatial) for spatial in (ADAPTIVE, VANILLA, WINDOW)]
            )
    finally:
        numba.set_num_threads(before)
    for alone, together in zip(*results, strict=True):
        assert alone.tobytes() == together.tobytes()
