# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Spatial alignment: examples by hand, and every strategy bit for bit against the oracle."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import image_distances, SpatialSettings

ADAPTIVE = SpatialSettings()
VANILLA = SpatialSettings(strategy='vanilla')
WINDOW = SpatialSettings(strategy='sliding_window')
DTYPES = [np.float32, np.float64]
# around whole vectors of 8 and 16 places, and around the part of one thread
BLOCK_BORDERS = [0, 1, 7, 9, 16, 17, 33, 129, 257]


def one(d, spatial):
    """Return the distance of a single pair by the batch kernel."""
    result = image_distances(np.ascontiguousarray(d[:, :, None]), spatial)
    assert (result.shape, result.dtype) == ((1,), d.dtype)
    return result[0]


def random_distances(seed, shape, dtype, levels, banned=0.0):
    """
    Return distances of few levels, with many ties, or any (levels = 0); a share of them +inf.

    Some lie below zero, as after a projection.
    """
    rng = np.random.default_rng(seed)
    if levels == 0:
        d = rng.uniform(-0.05, 1.5, shape)
    else:
        d = rng.integers(-1, levels + 1, shape) / levels
    d[rng.random(shape) < banned] = np.inf
    return d.astype(dtype)


@pytest.mark.parametrize('dtype', DTYPES)
def test_distance_of_published_figure_by_hand(dtype):
    d = oracle.GOLDEN.astype(dtype)
    tolerance = 5e-9 if dtype is np.float64 else 2e-6
    # I = 2, a = sqrt(3): 3.42635861 / 11.92820323
    assert one(d, ADAPTIVE) == pytest.approx(0.28724851, abs=tolerance)
    # vanilla, nine cells: .51 .44 .32 .23 .14 .17 .22 .37 .47 = 2.87; 2.87 / 9 = 0.31888889
    assert one(d, VANILLA) == pytest.approx(0.31888889, abs=tolerance)


@pytest.mark.parametrize(
    ('d', 'distance'),
    [
        # S12 = 1, S21 = 3; (2,2): diagonal 3 + 1, vertical 3 + 1 (C = 3), horizontal 3 + 3
        ([[1.0, 0], [2, 3]], 4 / 3),
        # S12 = 3, S21 = 1; (2,2): diagonal 3 + 1, vertical 3 + 3, horizontal 3 + 1 (C = 3)
        ([[1.0, 2], [0, 3]], 4 / 3),
        # S = 0  1 10   (2,3): diagonal 1 + 1 = 2, C = 3
        #     1  9  2   (3,2): diagonal 1 + 1, vertical 1 + 9, horizontal 1 + 1: horizontal, C = 4
        #     1  2  3   (3,3): diagonal 1 + 9, vertical 1 + 2, horizontal 1 + 2: vertical, C = 4
        ([[0.0, 1, 9], [1, 9, 1], [0, 1, 1]], 3 / 4),
    ],
)
def test_diagonal_step_loses_ties_and_vertical_step_wins_others(d, distance):
    assert one(np.array(d), VANILLA) == distance


@pytest.mark.parametrize('dtype', DTYPES)
def test_ties_are_those_of_rounded_sums(dtype):
    # S11 = 1 < S12 = 1 + ulp, but 4 + S11 and 4 + S12 both round to 5: a tie, vertical, C = 3
    d = np.array([[1, np.finfo(dtype).eps], [1, 4]], dtype)
    assert one(d, VANILLA) == dtype(5) / dtype(3)  # the minimum over S first: 5 / 2


def test_adaptive_weight_by_hand():
    # W = 2, c = ceil(2 / 2) = 1, row 1 = .5 .1: I = 2, a = sqrt(1 + 1). S12 = .6, S21 = 1.5
    # (2,2): diagonal sqrt(2) * 1 + .5 = 1.914, vertical 1 + .6 = 1.6, horizontal 2.5: C = 3
    assert one(np.array([[0.5, 0.1], [1.0, 1.0]]), ADAPTIVE) == pytest.approx(1.6 / 3)
    # sigma = 3: a = 2; with .2 at the end: diagonal 2 * .2 + .5 = .9 > vertical .2 + .6 = .8
    d = np.array([[0.5, 0.1], [1.0, 0.2]])
    assert one(d, SpatialSettings(sigma=3.0)) == pytest.approx(0.8 / 3)
    # vanilla: diagonal .2 + .5 = .7, C = 2; sigma = 0 is vanilla
    assert one(d, VANILLA) == pytest.approx(0.7 / 2)
    assert one(d, SpatialSettings(sigma=0.0)) == pytest.approx(0.7 / 2)


@pytest.mark.parametrize(
    ('row', 'places_away'),
    [
        ([9, 5, 9, 9], 0),  # W = 4: c = 2, not 3
        ([5, 9, 9, 5], 1),  # a tie: the first minimum, strip 1, not strip 4
        ([9, 9, 9, 5], 2),
    ],
)
def test_adaptive_weight_of_even_number_of_strips_by_hand(row, places_away):
    d = np.full((4, 4), 7.0)
    d[1] = row
    d[np.diag_indices(4)] = [0, row[1], -1, -1]  # three diagonal steps: the path
    a = np.sqrt(1 + places_away)
    assert one(d, ADAPTIVE) == pytest.approx((a * row[1] - 2 * a) / (1 + 3 * a))


def test_band_allows_29_of_49_cells():
    allowed = set()
    restricted = SpatialSettings(strategy='vanilla', xi=3)
    for i in range(7):
        for j in range(7):
            d = np.ones((7, 7))
            d[i, j] = -100  # on the path wherever it is allowed
            if one(d, restricted) < 0:
                allowed.add((i, j))
    assert allowed == {(i, j) for i in range(7) for j in range(7) if abs(i - j) < 3}
    assert len(allowed) == 29


def test_sliding_window_by_hand():
    d = np.full((5, 5), 9.0)
    # p = 1, q = 2: (1 + 2 + 3 + 4) / 4; every other start has 9s only
    d[0, 1], d[1, 2], d[2, 3], d[3, 4] = 1, 2, 3, 4
    assert one(d, WINDOW) == 2.5
    d[np.diag_indices(5)] = [9, 1, 1, 1, 0]  # the last start, p = q = 2
    assert one(d, WINDOW) == 0.75
    d = np.zeros((4, 4))
    d[np.diag_indices(4)] = [1, 2, 3, 6]  # one start only, so the zeros do not count
    assert one(d, WINDOW) == 3


def test_rigid_shift_by_hand():
    d = np.ones((3, 3))
    d[0, 1], d[1, 2] = 0.25, 0.5  # the place is one strip to the right
    assert one(d, SpatialSettings('rigid')) == 0.375 + 1 / 32
    assert one(d, SpatialSettings('rigid', xi=1)) == 1
    d[2, 0] = 0.125  # two strips to the left
    assert one(d, SpatialSettings('rigid')) == 0.125 + 2 / 32
    assert one(d, SpatialSettings('rigid', xi=2)) == 0.375 + 1 / 32


def check(d, strategy, sigma=1.0, xi=None):
    """Compare the kernel with the oracle."""
    dtype = d.dtype.type
    spatial = SpatialSettings(strategy=strategy, sigma=sigma, xi=xi)
    result = image_distances(d, spatial)
    assert result.dtype == dtype
    np.testing.assert_array_equal(result, oracle.image_distances(d, strategy, sigma, xi, dtype))


@settings(max_examples=120)
@given(
    seed=st.integers(0, 2**32 - 1),
    W=st.sampled_from(range(1, 10)),  # integers() would prefer small ones
    n=st.sampled_from([0, 1, 2, 5, 9]),
    dtype=st.sampled_from(DTYPES),
    levels=st.sampled_from([0, 1, 2, 4, 10]),
    strategy=st.sampled_from(['adaptive', 'vanilla', 'rigid', 'sliding_window']),
    sigma=st.sampled_from([1.0, 0.0, 0.5, 0.3, 7.0]),
    restriction=st.integers(0, 9),
    banned=st.sampled_from([0.0, 0.0, 0.1, 0.5]),
)
def test_image_distances_equal_oracle(
    seed, W, n, dtype, levels, strategy, sigma, restriction, banned
):
    if strategy == 'sliding_window':
        W = max(W, 4)
    xi = None if restriction == 0 else min(restriction, W)
    check(random_distances(seed, (W, W, n), dtype, levels, banned), strategy, sigma, xi)


@pytest.mark.parametrize('n', BLOCK_BORDERS)
@pytest.mark.parametrize('strategy', ['adaptive', 'sliding_window'])
def test_image_distances_at_block_borders_equal_oracle(n, strategy):
    check(random_distances(n, (5, 5, n), np.float32, 3), strategy)
    check(random_distances(n, (4, 4, n), np.float64, 3), strategy, xi=3)
