# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The oracle against numbers derived by hand, so that kernels can be compared with it."""

import math

import numpy as np
import oracle
from oracle import GOLDEN, GOLDEN_PATH
import pytest


def test_align_images_of_published_figure_by_hand():
    aligned = oracle.align_images(GOLDEN)
    assert oracle.adaptive_weight(GOLDEN, 1.0, np.float64) == (math.sqrt(3), 1)
    assert aligned.accumulated == pytest.approx(3.42635861, abs=5e-9)
    assert aligned.cost == pytest.approx(11.92820323, abs=5e-9)
    assert aligned.distance == pytest.approx(0.28724851, abs=5e-9)
    assert aligned.path == GOLDEN_PATH
    # vanilla, nine cells: .51 .44 .32 .23 .14 .17 .22 .37 .47 = 2.87; 2.87 / 9 = 0.31888889
    aligned = oracle.align_images(GOLDEN, 'vanilla')
    assert aligned.accumulated == pytest.approx(2.87)
    assert aligned.cost == 9
    assert aligned.distance == pytest.approx(0.31888889, abs=5e-9)
    assert aligned.path == GOLDEN_PATH


def cheapest_path(d, a, i=0, j=0):
    """Return the smallest sum over every monotone path from (i, j) to the end, trying all."""
    rows, columns = d.shape
    if (i, j) == (rows - 1, columns - 1):
        return 0.0
    costs = []
    for di, dj, weight in ((1, 1, a), (1, 0, 1.0), (0, 1, 1.0)):
        if i + di < rows and j + dj < columns:
            costs.append(weight * d[i + di, j + dj] + cheapest_path(d, a, i + di, j + dj))
    return min(costs)


@pytest.mark.parametrize('seed', range(3))
def test_accumulated_distance_is_cheapest_of_all_paths(seed):
    d = np.random.default_rng(seed).random((5, 5))
    aligned = oracle.align_images(d)
    assert aligned.accumulated == pytest.approx(d[0, 0] + cheapest_path(d, aligned.weight))


def test_align_images_rounds_every_operation_to_dtype():
    d = np.full((3, 3), 0.1)
    narrow = oracle.align_images(d, 'vanilla', dtype=np.float32)
    assert isinstance(narrow.distance, np.float32)
    # the path is one diagonal and S = (.1 + .1) + .1 in float32
    assert narrow.accumulated == np.float32(0.1) + np.float32(0.1) + np.float32(0.1)
    assert oracle.align_images(d, 'vanilla').accumulated == 0.1 + 0.1 + 0.1


def test_cut_strips_drops_surplus_columns_by_hand():
    # 8 columns, 3 strips of 2: r = 2, one column lost on each side: (1 2) (3 4) (5 6)
    row = np.arange(8.0).reshape(1, 1, 1, 8)
    assert oracle.cut_strips(row, 3)[:, 0].tolist() == [[1, 2], [3, 4], [5, 6]]
    # 9 columns, 4 strips of 2: r = 1, floor(1 / 2) = 0 on the left, the last column lost
    row = np.arange(9.0).reshape(1, 1, 1, 9)
    assert oracle.cut_strips(row, 4)[:, 0].tolist() == [[0, 1], [2, 3], [4, 5], [6, 7]]


def test_cosine_distance_by_hand():
    # <(3,4), (4,3)> = 24, norms 5 and 5: 1 - 24/25 = 0.04
    assert oracle.cosine_distance(np.array([3, 4]), np.array([4, 3])) == pytest.approx(0.04)
    assert oracle.cosine_distance(np.array([3, 4]), np.array([-3, -4])) == 2.0  # not clipped
    assert oracle.cosine_distance(np.zeros(2), np.array([3, 4])) == 1.0
    assert oracle.cosine_distance(np.zeros(2), np.zeros(2)) == 1.0


def test_frames_searched_rounds_up_but_not_rounding_errors():
    assert oracle.frames_searched(25, 2.2) == 55  # of 55.00000000000001
    assert oracle.frames_searched(3, 1.5) == 5


def test_match_sequence_by_hand():
    # l = 2, k = 4. Start 0: S row 1 = 4 6 7 12, row 2 by column:
    #   x=1: vertical 1 + 4 = 5, C = 2, q = 2.5
    #   x=2: cell 8: diagonal 8 + 4 = 12, vertical 14, horizontal 13: diagonal, C = 2, q = 6
    #   x=3: cell 0: diagonal 6, vertical 7, horizontal 12: diagonal, C = 3, q = 2
    #   x=4: cell 9: diagonal 16, vertical 21, horizontal 15: C = 4, q = 3.75 -> m = 3, q = 2
    # Start 1: 2 3 8 over 8 0 9: x=1: 10 / 2 = 5; x=2: diagonal 2 < vertical 3 -> m = 2, q = 1
    # Start 2: 1 6 over 0 9: x=1: 1 / 2 = .5 -> m = 1; start 3, one frame: 14 / 2 = 7 -> m = 1
    D = np.array([[4.0, 2, 1, 5], [1, 8, 0, 9]])
    q, m = oracle.match_sequence(D, 2.0)
    assert q.tolist() == [2, 1, 0.5, 7]
    assert m.tolist() == [3, 2, 1, 1]
    assert oracle.align_sequence(D, 0, 2.0).path == [(0, 0), (0, 1), (1, 2)]
    answer = oracle.best_match(q, m, 0)
    assert answer is not None
    assert (answer.start, answer.last, answer.middle) == (2, 2, 2)
    # middles: 1, 1 (floor 1.5), 2, 3; more than 0 away from 2 and best: start 1
    assert (answer.second_best_index, answer.second_best_distance) == (1, 1.0)


def test_best_match_without_finite_distance_is_none():
    assert oracle.best_match(np.empty(0), np.empty(0, int), 1) is None
    assert oracle.best_match(np.array([np.inf, np.inf]), np.array([1, 1]), 1) is None


def test_aligned_index_is_floor_of_middle():
    path = [(0, 3), (0, 4), (0, 5), (0, 6), (1, 7), (2, 7)]
    assert [oracle.aligned_index(path, i) for i in range(3)] == [4, 7, 7]


def test_best_f1_by_hand():
    places = [(10, 0.1), (20, 0.2), (99, 0.3), (40, 0.4)]
    truth = [[10], [22], [30], [37, 44]]
    # tolerance 2: right, right, wrong, wrong (3 and 4 away). Thresholds just above:
    # .1: TP 1 FP 0 FN 3 = 2/5; .2: 2 0 2 = 4/6; .3: 2 1 1 = 4/6; .4: 2 2 0 = 4/6
    assert oracle.best_f1(places, truth, 2) == pytest.approx(4 / 6)
    # tolerance 3: the last one is right: .4: 3 1 0 = 6/7
    assert oracle.best_f1(places, truth, 3) == pytest.approx(6 / 7)
    # tied scores are accepted together: .1 twice, one wrong: TP 1 FP 1 FN 0 = 2/3
    assert oracle.best_f1([(0, 0.1), (9, 0.1)], [[0], [1]], 0) == pytest.approx(2 / 3)
    assert oracle.best_f1([(-1, math.inf)], [[0]], 5) == 0.0
