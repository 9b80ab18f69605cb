# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Temporal alignment (LM-DTW): worked examples, and every start bit for bit against the oracle."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import (
    align_sequence,
    aligned_index,
    best_match,
    match_sequence,
    SequenceDistances,
    SequenceSettings,
)

DTYPES = [np.float32, np.float64]
INF = math.inf


def path_of(aligned):
    return [tuple(cell) for cell in aligned.path.tolist()]


def check_every_start(D, length, beta):
    """Hold match_sequence and align_sequence against the oracle, exactly; give back the matches."""
    sequence = SequenceSettings(length=length, beta=beta)
    matches = match_sequence(D, sequence)
    q, m = oracle.match_sequence(D, beta, D.dtype.type)
    assert matches.distances.dtype == D.dtype
    np.testing.assert_array_equal(matches.distances, q)
    finite = np.isfinite(
        q
    )  # where every path is banned there is nothing whose length could be asked for
    np.testing.assert_array_equal(matches.lengths[finite], m[finite])
    return matches


def random_distances(seed, length, n, dtype, levels, banned):
    """Distances of few levels, so that ties abound, or any floats (levels = 0); a share of them banned."""
    rng = np.random.default_rng(seed)
    if levels == 0:
        D = rng.uniform(-0.05, 1.5, (length, n))
    else:
        D = rng.integers(-1, levels + 1, (length, n)) / levels
    D[rng.random((length, n)) < banned] = INF
    return D.astype(dtype)


# ------------------------------------------------ worked by hand


@pytest.mark.parametrize('dtype', DTYPES)
def test_every_start_by_hand(dtype):
    # l = 2, k = 4. Start 0: S row 1 = 4 6 7 12, row 2 by column:
    #   x=1: vertical 1 + 4 = 5, C = 2, q = 2.5
    #   x=2: cell 8: diagonal 8 + 4 = 12, vertical 8 + 6 = 14, horizontal 8 + 5 = 13: diagonal, C = 2, q = 6
    #   x=3: cell 0: diagonal 0 + 6 = 6, vertical 0 + 7 = 7, horizontal 0 + 12 = 12: diagonal, C = 3, q = 2
    #   x=4: cell 9: diagonal 16, vertical 21, horizontal 15: horizontal, C = 4, q = 3.75   -> m = 3, q = 2
    # Start 1: 2 3 8 over 8 0 9: x=1: 10 / 2 = 5; x=2: diagonal 2 < vertical 3: 2 / 2 = 1   -> m = 2, q = 1
    # Start 2: 1 6 over 0 9: x=1: 1 / 2 = .5                                                -> m = 1, q = .5
    # Start 3 has one frame: 5 over 9 = 14, C = 2                                           -> m = 1, q = 7
    D = np.array([[4, 2, 1, 5], [1, 8, 0, 9]], dtype)
    sequence = SequenceSettings(length=2, beta=2.0)
    matches = match_sequence(D, sequence)
    assert matches.distances.tolist() == [2, 1, 0.5, 7]
    assert matches.lengths.tolist() == [3, 2, 1, 1]
    assert matches.lengths.dtype == np.int32
    aligned = align_sequence(D, 0, sequence)
    assert aligned.distance == 2
    assert aligned.path.dtype == np.int32
    assert path_of(aligned) == [(0, 0), (0, 1), (1, 2)]
    assert path_of(align_sequence(D, 3, sequence)) == [(0, 3), (1, 3)]


def test_free_end_takes_the_best_column_not_the_last():
    # zeros on the diagonal from place 0: q_1 = 1 / 2, q_2 = 1 / 3, q_3 = 0 / 3 = 0, then (0 + 1) / 4 and on
    D = np.ones((3, 6))
    D[0, 0] = D[1, 1] = D[2, 2] = 0
    matches = match_sequence(D, SequenceSettings(length=3, beta=2.0))
    assert matches.distances[0] == 0
    assert matches.lengths[0] == 3
    assert path_of(align_sequence(D, 0, SequenceSettings(length=3))) == [(0, 0), (1, 1), (2, 2)]


def test_first_of_equal_ends_wins():
    # a map of zeros: every q_x is 0, so m = 1, and every start is equal, so start 0
    D = np.zeros((3, 8))
    matches = match_sequence(D, SequenceSettings(length=3))
    assert matches.lengths.tolist() == [1] * 8
    best = best_match(matches, 3)
    assert (best.start, best.length, best.first, best.last, best.middle) == (0, 1, 0, 0, 0)
    assert (best.second_best_index, best.second_best_distance) == (4, 0)


def test_ends_that_tie_with_different_sums():
    # start 0, x=1: (1 + 3) / 2 = 2; x=2: diagonal 1 + 1, vertical 1 + 6, horizontal 1 + 4: 2 / 2 = 1
    # x=3: diagonal 1 + 6, vertical 1 + 15, horizontal 1 + 2 = 3, C = 3: 3 / 3 = 1 again: m = 2
    D = np.array([[1.0, 5, 9], [3, 1, 1]])
    matches = match_sequence(D, SequenceSettings(length=2))
    assert (matches.distances[0], matches.lengths[0]) == (1, 2)


def test_vertical_wins_over_horizontal():
    D = np.array([[0.0, 1, 9], [1, 9, 1], [0, 1, -7]])
    # S = 0  1 10      (2,3): diagonal 1 + 1 = 2, C = 3
    #     1  9  2      (3,2): diagonal 1 + 1, vertical 1 + 9, horizontal 1 + 1: horizontal, C = 4
    #     1  2 -5      (3,3): diagonal -7 + 9, vertical -7 + 2, horizontal -7 + 2: vertical, C = 3 + 1
    # q = 1 / 3, 2 / 4, -5 / 4; by the horizontal step the last would be -5 / 5
    aligned = align_sequence(D, 0, SequenceSettings(length=3))
    assert aligned.distance == -5 / 4
    assert path_of(aligned) == [(0, 0), (0, 1), (1, 2), (2, 2)]
    assert match_sequence(D, SequenceSettings(length=3)).distances[0] == -5 / 4


def test_tie_of_all_three_is_vertical():
    # S12 = 1 + 0, S21 = 1 + 0; at (2,2) all three sums are -5 + 1: vertical, so the path goes through the
    # second map frame, not through the second query frame
    D = np.array([[1.0, 0], [0, -5]])
    aligned = align_sequence(D, 0, SequenceSettings(length=2))
    assert path_of(aligned) == [(0, 0), (0, 1), (1, 1)]
    assert aligned.distance == -4 / 3


def test_tie_is_judged_on_the_rounded_sums():
    # as in the spatial example: 4 + 1 and 4 + (1 + ulp) both round to 5: vertical, C = 3
    for dtype in DTYPES:
        D = np.array([[1, np.finfo(dtype).eps], [9, 4]], dtype)
        matches = match_sequence(D, SequenceSettings(length=2))
        assert matches.lengths[0] == 2
        assert matches.distances[0] == dtype(5) / dtype(3)


def test_one_map_frame_may_absorb_the_whole_query():
    D = np.ones((20, 30))
    D[:, 11] = 0
    best = best_match(match_sequence(D, SequenceSettings()), 3)
    assert (best.start, best.length, best.distance) == (11, 1, 0)


def test_starts_at_the_end_of_the_map_have_fewer_frames():
    # l = 4, n = 3 < l: starts 0, 1, 2 see 3, 2, 1 frames; start 2: (2 + 2 + 2 + 2) / 4
    D = np.array([[9.0, 9, 2]] * 4)
    matches = check_every_start(D, 4, 2.0)
    assert (matches.distances[2], matches.lengths[2]) == (2, 1)
    # start 1: 9, diagonal to 2, then down: 15 / 4; by way of (1,2) it would be 17 / 5, less, but the
    # recursion minimizes S, not q
    assert matches.distances[1] == 15 / 4


@pytest.mark.parametrize(
    ('length', 'beta', 'k'),
    [
        (20, 2.0, 40),
        (25, 2.2, 55),
        (50, 1.1, 55),
        (10, 1.1, 11),
        (10, 1.11, 12),
        (3, 1.5, 5),
        (7, 1.05, 8),
    ],
)
def test_frames_searched(length, beta, k):
    # 2.2 * 25 = 1.1 * 50 = 55.00000000000001 in floating point: 55, not 56
    assert SequenceSettings(length=length, beta=beta).k == k


def test_the_frame_beyond_k_is_out_of_reach():
    # free along row 1, then only the 56th frame is cheap for the rest: k = 55 must not see it
    D = np.full((25, 56), 5.0)
    D[0, :] = 0
    D[1:, 55] = 0
    matches = match_sequence(D, SequenceSettings(length=25, beta=2.2))
    assert matches.distances[0] > 0
    assert matches.distances[1] == 0
    wider = match_sequence(D, SequenceSettings(length=25, beta=2.24))  # k = 56
    assert (wider.distances[0], wider.lengths[0]) == (0, 56)


def test_banned_entries():
    # start 0 is banned outright; start 1 must go round the ban at (1, 1): straight down is +inf
    D = np.array([[INF, 1.0, 1.0], [1.0, INF, 1.0]])
    matches = match_sequence(D, SequenceSettings(length=2))
    assert matches.distances.tolist() == [INF, 1, 1]
    assert matches.lengths[1:].tolist() == [2, 1]
    assert path_of(align_sequence(D, 1, SequenceSettings(length=2))) == [(0, 1), (1, 2)]


# ------------------------------------------------ the answer


def matches_of(q, m):
    """Starts whose distances and lengths are given."""
    return SequenceDistances(distances=np.array(q, float), lengths=np.array(m, np.int32))


def test_best_match_by_hand():
    # middles floor((s + s + m - 1) / 2): 0, 2, 2, 5, 4
    best = best_match(matches_of([0.5, 0.3, 0.2, 0.3, 0.2], [1, 4, 1, 5, 1]), 1)
    assert (best.start, best.length, best.first, best.last, best.middle) == (
        2,
        1,
        2,
        2,
        2,
    )  # first of two .2
    assert best.distance == 0.2
    assert (best.second_best_index, best.second_best_distance) == (4, 0.2)  # 4 - 2 > 1
    # more than 2 places away from 2: only middle 5
    assert (
        best_match(matches_of([0.5, 0.3, 0.2, 0.3, 0.2], [1, 4, 1, 5, 1]), 2).second_best_index
        == 5
    )
    nobody = best_match(matches_of([0.5, 0.3, 0.2, 0.3, 0.2], [1, 4, 1, 5, 1]), 3)
    assert nobody.second_best_index == -1
    assert math.isnan(nobody.second_best_distance)


def test_middle_is_rounded_down():
    best = best_match(matches_of([9, 9, 9, 0.1, 9, 9], [1, 1, 1, 2, 1, 1]), 1)
    assert (best.first, best.last, best.middle) == (3, 4, 3)


def test_banned_starts_are_no_runner_up():
    best = best_match(matches_of([0.1, INF, INF, INF], [1, 1, 1, 1]), 1)
    assert best.second_best_index == -1
    assert math.isnan(best.second_best_distance)


def test_nothing_to_find_is_none():
    assert best_match(match_sequence(np.empty((4, 0)), SequenceSettings(length=4)), 1) is None
    assert best_match(match_sequence(np.full((4, 6), INF), SequenceSettings(length=4)), 1) is None


def test_aligned_index_is_the_floor_of_the_middle():
    path = np.array([(0, 3), (0, 4), (0, 5), (0, 6), (1, 7), (2, 7)], np.int32)
    assert [aligned_index(path, i) for i in range(3)] == [4, 7, 7]


# ------------------------------------------------ the kernel against the oracle, exactly


@pytest.mark.parametrize('beta', [1.05, 1.1, 1.5, 2.0, 3.0])
@pytest.mark.parametrize('length', [2, 3, 4, 7, 10, 13, 25])
def test_every_size_equals_the_oracle(length, beta):
    # hypothesis likes the smallest of everything: this sweep is sure to meet every size and kind of ties
    for n in (1, length - 1, length + 3):
        for dtype, levels, banned in (
            (np.float32, 0, 0.0),
            (np.float32, 4, 0.1),
            (np.float64, 2, 0.0),
        ):
            check_every_start(random_distances(n, length, n, dtype, levels, banned), length, beta)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.integers(2, 25),
    n=st.integers(0, 14),
    beta=st.sampled_from([1.05, 1.1, 1.5, 2.0, 2.35, 3.0]),
    dtype=st.sampled_from(DTYPES),
    levels=st.sampled_from([0, 1, 2, 4, 10]),
    banned=st.sampled_from([0.0, 0.1, 0.6]),
    nms_radius=st.integers(0, 5),
)
def test_every_start_equals_the_oracle(seed, length, n, beta, dtype, levels, banned, nms_radius):
    D = random_distances(seed, length, n, dtype, levels, banned)
    matches = check_every_start(D, length, beta)
    best = best_match(matches, nms_radius)
    expected = oracle.best_match(*oracle.match_sequence(D, beta, dtype), nms_radius)
    if expected is None:
        assert best is None
        return
    assert (best.start, best.length, best.last, best.middle) == expected[:4]
    assert best.distance == expected.distance
    assert best.second_best_index == expected.second_best_index
    np.testing.assert_equal(best.second_best_distance, expected.second_best_distance)
    path = oracle.align_sequence(D, expected.start, beta, dtype).path
    aligned = align_sequence(D, best.start, SequenceSettings(length=length, beta=beta))
    assert path_of(aligned) == path
    assert aligned.distance == best.distance
    for frame in range(length):
        assert aligned_index(aligned.path, frame) == oracle.aligned_index(path, frame)


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    length=st.integers(2, 6),
    n=st.integers(1, 12),
    dtype=st.sampled_from(DTYPES),
    levels=st.sampled_from([0, 1, 3]),
    start=st.integers(0, 11),
)
def test_the_path_of_any_start_equals_the_oracle(seed, length, n, dtype, levels, start):
    start = min(start, n - 1)
    D = random_distances(seed, length, n, dtype, levels, 0.0)
    sequence = SequenceSettings(length=length)
    aligned = align_sequence(D, start, sequence)
    expected = oracle.align_sequence(D, start, 2.0, dtype)
    assert path_of(aligned) == expected.path
    assert (aligned.distance, aligned.accumulated, aligned.cost, aligned.weight) == (
        expected.distance, expected.accumulated, expected.cost, 1,
    )  # fmt: skip
    assert aligned.distance == match_sequence(D, sequence).distances[start]


@pytest.mark.parametrize('n', [1, 7, 8, 9, 31, 32, 33, 63, 64, 65, 127, 128, 129, 300])
def test_block_borders_equal_the_oracle(n):
    for dtype, length, beta, banned in ((np.float32, 3, 2.0, 0.05), (np.float64, 2, 1.5, 0.0)):
        check_every_start(random_distances(n, length, n, dtype, 2, banned), length, beta)


@pytest.mark.parametrize('dtype', DTYPES)
def test_default_settings_equal_the_oracle(dtype):
    check_every_start(random_distances(20, 20, 70, dtype, 0, 0.0), 20, 2.0)


def test_memory_layout_does_not_matter():
    D = random_distances(5, 4, 80, np.float32, 3, 0.0)
    sequence = SequenceSettings(length=4)
    expected = match_sequence(D, sequence).distances
    np.testing.assert_array_equal(
        match_sequence(np.asfortranarray(D), sequence).distances, expected
    )
    wide = np.repeat(D, 2, axis=1)
    np.testing.assert_array_equal(match_sequence(wide[:, ::2], sequence).distances, expected)


def test_input_is_left_alone():
    D = random_distances(6, 4, 80, np.float32, 3, 0.1)
    before = D.copy()
    match_sequence(D, SequenceSettings(length=4))
    align_sequence(D, 3, SequenceSettings(length=4))
    np.testing.assert_array_equal(D, before)


def test_answers_do_not_depend_on_the_number_of_threads():
    numba = pytest.importorskip('numba')
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip('one processor only')
    D = random_distances(7, 20, 5000, np.float32, 0, 0.01)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            results.append(match_sequence(D, SequenceSettings()))
    finally:
        numba.set_num_threads(before)
    alone, together = results
    assert alone.distances.tobytes() == together.distances.tobytes()
    assert alone.lengths.tobytes() == together.lengths.tobytes()
