# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Temporal alignment (LM-DTW): examples by hand, and every start equal to the oracle's."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest
from stavpr_ros.alignment import (
    aligned_index,
    best_match,
    match_sequence,
    SequenceDistances,
    SequenceSettings,
)
from stavpr_ros.alignment.lm_dtw import trace_sequence
from test_spatial import DTYPES, random_distances

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
