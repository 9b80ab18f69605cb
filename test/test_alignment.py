# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Both alignments: examples by hand, equal to the oracle bit for bit, and invalid input."""

import math
import re

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import (
    aligned_index,
    best_match,
    image_distances,
    match_sequence,
    SequenceDistances,
    SequenceSettings,
    SpatialSettings,
)
from stavpr_ros.alignment.lm_dtw import trace_sequence
from stavpr_ros.errors import InputError, SettingsError

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


# Temporal alignment (LM-DTW): examples by hand, and every start equal to the oracle's

INF = math.inf


def path_of(D, start, settings):
    return [tuple(cell) for cell in trace_sequence(D, start, settings.k).tolist()]


def check_every_start(D, length, beta):
    """Compare match_sequence with the oracle, exactly; return the matches."""
    matches = match_sequence(D, SequenceSettings(length=length, beta=beta))
    q, m = oracle.match_sequence(D, beta, D.dtype.type)
    assert matches.distances.dtype == D.dtype
    np.testing.assert_array_equal(matches.distances, q)
    finite = np.isfinite(q)  # where every path is banned there is no length
    np.testing.assert_array_equal(matches.lengths[finite], m[finite])
    return matches


@pytest.mark.parametrize('dtype', DTYPES)
def test_match_sequence_by_hand(dtype):
    # l = 2, k = 4. Start 0: S row 1 = 4 6 7 12, row 2 by column:
    #   x=1: vertical 1 + 4 = 5, C = 2, q = 2.5
    #   x=2: cell 8: diagonal 8 + 4 = 12, vertical 14, horizontal 13: diagonal, C = 2, q = 6
    #   x=3: cell 0: diagonal 6, vertical 7, horizontal 12: diagonal, C = 3, q = 2
    #   x=4: cell 9: diagonal 16, vertical 21, horizontal 15: C = 4, q = 3.75 -> m = 3, q = 2
    # Start 1: 2 3 8 over 8 0 9: x=1: 10 / 2 = 5; x=2: diagonal 2 < vertical 3 -> m = 2, q = 1
    # Start 2: 1 6 over 0 9: x=1: 1 / 2 = .5 -> m = 1; start 3, one frame: 14 / 2 = 7 -> m = 1
    D = np.array([[4, 2, 1, 5], [1, 8, 0, 9]], dtype)
    sequence = SequenceSettings(length=2, beta=2.0)
    matches = match_sequence(D, sequence)
    assert matches.distances.tolist() == [2, 1, 0.5, 7]
    assert matches.lengths.tolist() == [3, 2, 1, 1]
    assert matches.lengths.dtype == np.int32
    assert path_of(D, 0, sequence) == [(0, 0), (0, 1), (1, 2)]
    assert path_of(D, 3, sequence) == [(0, 3), (1, 3)]


def test_first_of_equal_ends_and_starts_wins():
    # a map of zeros: every q_x is 0, so m = 1, and every start is equal, so start 0
    matches = match_sequence(np.zeros((3, 8)), SequenceSettings(length=3))
    path = path_of(np.zeros((3, 8)), 0, SequenceSettings(length=3))
    assert path == [(0, 0), (1, 0), (2, 0)]
    assert matches.lengths.tolist() == [1] * 8
    best = best_match(matches, 3)
    assert (best.first, best.last, best.middle) == (0, 0, 0)
    assert (best.second_best_index, best.second_best_distance) == (4, 0)
    # equal ends of different sums: x=1: (1 + 3) / 2; x=2: 2 / 2; x=3: 3 / 3: m = 2
    matches = match_sequence(np.array([[1.0, 5, 9], [3, 1, 1]]), SequenceSettings(length=2))
    assert (matches.distances[0], matches.lengths[0]) == (1, 2)


@pytest.mark.parametrize(
    ('length', 'beta', 'k'), [(20, 2.0, 40), (25, 2.2, 55), (10, 1.11, 12), (7, 1.05, 8)]
)
def test_places_searched_round_up_but_not_rounding_errors(length, beta, k):
    # 2.2 * 25 = 55.00000000000001 in floating point: 55, not 56
    assert SequenceSettings(length=length, beta=beta).k == k


def matches_of(q, m):
    return SequenceDistances(distances=np.array(q, float), lengths=np.array(m, np.int32))


def test_best_match_by_hand():
    # middles floor((s + s + m - 1) / 2): 0, 2, 2, 5, 4
    matches = matches_of([0.5, 0.3, 0.2, 0.3, 0.2], [1, 4, 1, 5, 1])
    best = best_match(matches, 1)
    assert (best.first, best.last, best.middle, best.distance) == (2, 2, 2, 0.2)  # first of two
    assert (best.second_best_index, best.second_best_distance) == (4, 0.2)  # 4 - 2 > 1
    assert best_match(matches, 2).second_best_index == 5  # 4 - 2 is not above 2
    alone = best_match(matches, 3)
    assert alone.second_best_index == -1
    assert math.isnan(alone.second_best_distance)
    best = best_match(matches_of([9, 9, 9, 0.1, 9, 9], [1, 1, 1, 2, 1, 1]), 1)
    assert (best.first, best.last, best.middle) == (3, 4, 3)  # rounded down


def test_best_match_of_banned_starts_is_none():
    best = best_match(matches_of([0.1, INF, INF, INF], [1, 1, 1, 1]), 1)
    assert best.second_best_index == -1
    for D in (np.empty((4, 0)), np.full((4, 6), INF)):
        assert best_match(match_sequence(D, SequenceSettings(length=4)), 1) is None


def test_aligned_index_is_floor_of_middle():
    path = np.array([(0, 3), (0, 4), (0, 5), (0, 6), (1, 7), (2, 7)], np.int32)
    assert [aligned_index(path, i) for i in range(3)] == [4, 7, 7]


@settings(max_examples=100)
@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.sampled_from([*range(2, 15), 20]),  # integers() would prefer small ones
    n=st.sampled_from(range(13)),
    beta=st.sampled_from([1.05, 1.1, 1.5, 2.0, 2.35, 3.0]),
    dtype=st.sampled_from(DTYPES),
    levels=st.sampled_from([0, 1, 2, 4, 10]),
    banned=st.sampled_from([0.0, 0.1, 0.6]),
    nms_radius=st.integers(0, 5),
)
def test_matches_and_paths_equal_oracle(seed, length, n, beta, dtype, levels, banned, nms_radius):
    D = random_distances(seed, (length, n), dtype, levels, banned)
    sequence = SequenceSettings(length=length, beta=beta)
    matches = check_every_start(D, length, beta)
    best = best_match(matches, nms_radius)
    expected = oracle.best_match(matches.distances, matches.lengths, nms_radius)
    if expected is None:
        assert best is None
        return
    assert (best.first, best.last, best.middle) == (expected[0], *expected[2:4])
    assert best.distance == expected.distance
    assert best.second_best_index == expected.second_best_index
    np.testing.assert_equal(best.second_best_distance, expected.second_best_distance)
    for start in {best.first, int(np.flatnonzero(np.isfinite(matches.distances))[-1])}:
        plain = oracle.align_sequence(D, start, beta, dtype)
        assert path_of(D, start, sequence) == plain.path
        assert plain.distance == matches.distances[start]
        path = trace_sequence(D, start, sequence.k)
        for frame in range(length):
            assert aligned_index(path, frame) == oracle.aligned_index(plain.path, frame)


@pytest.mark.parametrize('n', [7, 8, 9, 31, 33, 65, 129, 257])
def test_match_sequence_at_block_borders_equals_oracle(n):
    check_every_start(random_distances(n, (3, n), np.float32, 2, 0.05), 3, 2.0)
    check_every_start(random_distances(n, (2, n), np.float64, 2, 0.0), 2, 1.5)


def test_match_sequence_of_any_memory_layout_changes_nothing():
    D = random_distances(5, (4, 80), np.float32, 3, 0.1)
    before, sequence = D.copy(), SequenceSettings(length=4)
    expected = match_sequence(D, sequence).distances
    for same in (np.asfortranarray(D), np.repeat(D, 2, axis=1)[:, ::2]):
        np.testing.assert_array_equal(match_sequence(same, sequence).distances, expected)
    trace_sequence(D, 3, sequence.k)
    np.testing.assert_array_equal(D, before)


# Invalid input and settings: each error names the value

THREE = SequenceSettings(length=3)
NONE, OF_STRIPS = SpatialSettings(strategy='none'), 7 * np.eye(7)[..., None]


def without(value, *shape):
    """Return distances with one that is no number or too small."""
    d = np.ones(shape)
    d.flat[d.size // 2] = value
    return d


@pytest.mark.parametrize(
    ('work', 'distances', 'setting', 'named'),
    [
        *(
            (image_distances, np.ones(shape), ADAPTIVE, re.escape(str(shape)))
            for shape in ((7, 7), (7, 6, 3), (0, 0, 3))
        ),
        *(
            (match_sequence, np.ones(shape), THREE, re.escape(str(shape)))
            for shape in ((4, 9), (2, 9), (3,), (3, 9, 1))
        ),
        *(
            row
            for dtype in (np.int64, np.float16, bool)
            for row in (
                (image_distances, OF_STRIPS.astype(dtype), ADAPTIVE, np.dtype(dtype).name),
                (match_sequence, np.ones((3, 9), dtype), THREE, np.dtype(dtype).name),
            )
        ),
        *(
            row
            for value in (np.nan, -np.inf)
            for row in (
                (image_distances, without(value, 7, 7, 100), ADAPTIVE, None),
                (image_distances, without(value, 7, 7, 100), VANILLA, None),
                (image_distances, without(value, 7, 7, 100), WINDOW, None),
                (match_sequence, without(value, 3, 100), THREE, None),
            )
        ),
        (image_distances, np.zeros((5, 5, 2)), SpatialSettings(xi=6), '6.*5'),
        (image_distances, np.zeros((3, 3, 2)), WINDOW, 'W = 3'),
        (image_distances, np.zeros((7, 7, 2)), NONE, 'none'),
        (aligned_index, np.array([(0, 3), (1, 4)], np.int32), 2, '2'),
    ],
)
def test_distances_that_do_not_fit_are_rejected(work, distances, setting, named):
    with pytest.raises((InputError, SettingsError), match=named):
        work(distances, setting)


@pytest.mark.parametrize(
    ('settings', 'name', 'value'),
    [
        *((SpatialSettings, 'sigma', value) for value in (-0.5, math.inf)),
        *((SpatialSettings, 'xi', value) for value in (0, 2.5)),
        (SpatialSettings, 'strategy', 'diagonal'),
        *((SequenceSettings, 'length', value) for value in (1, 2.5)),
        *((SequenceSettings, 'beta', value) for value in (1.0, math.inf)),
    ],
)
def test_settings_out_of_range_are_rejected(settings, name, value):
    with pytest.raises(SettingsError, match=re.escape(str(value))):
        settings(**{name: value})
