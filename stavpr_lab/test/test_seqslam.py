# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""SeqSLAM: every step by hand, the whole against plain loops, F1 on real traverses."""

import numpy as np
import pytest
from scores import best_f1
from stavpr_lab.evaluation.paper.datasets import open_dataset
from stavpr_lab.evaluation.seqslam import match_differences, preprocess, seqslam, SeqSlamSettings

SMALL = SeqSlamSettings(width=4, height=2, patch=2)


def test_preprocess_patches_by_hand():
    """Left patch 0 2 / 2 4: mean 2, deviation sqrt 2. The right one is flat."""
    image = np.array([[0, 2, 5, 5], [2, 4, 5, 5]], np.uint8)
    root = np.sqrt(2)
    patches = preprocess([image], SMALL)
    assert patches.dtype == np.float32
    np.testing.assert_allclose(
        patches.reshape(2, 4), [[-root, 0, 0, 0], [0, root, 0, 0]], atol=1e-6
    )


def naive(D, settings):
    """Compute the paper's method in plain loops."""
    N, n = D.shape
    half, middle = settings.contrast_window // 2, (settings.length - 1) // 2
    enhanced = np.zeros((N, n))
    for i in range(N):
        for j in range(n):
            around = D[i, max(0, j - half) : j + half + 1]
            enhanced[i, j] = (D[i, j] - around.mean()) / around.std()
    places, scores = [-1] * N, [np.inf] * N
    count = round((settings.fastest - settings.slowest) / settings.speed_step) + 1
    for first in range(N - settings.length + 1):
        starts = {}
        for start in range(n):
            for v in range(count):
                speed = settings.slowest + v * settings.speed_step
                line = [start + int(speed * t + 0.5 + 1e-9) for t in range(settings.length)]
                if line[-1] < n:
                    total = sum(enhanced[first + t, place] for t, place in enumerate(line))
                    if start not in starts or total < starts[start][0]:
                        starts[start] = total, line[middle]
        best, place = min(starts.values())
        places[first + middle], scores[first + middle] = place, best / settings.length
    return places, scores


@pytest.mark.parametrize(
    ('length', 'window', 'n'), [(2, 2, 9), (5, 4, 25), (6, 10, 40), (7, 60, 12)]
)
def test_match_differences_equals_plain_loops(length, window, n):
    speeds = {'slowest': 0.6, 'fastest': 1.4, 'speed_step': 0.2}
    settings = SeqSlamSettings(length=length, contrast_window=window, **speeds)
    D = np.random.default_rng(length).random((15, n))
    expected_places, expected_scores = naive(D, settings)
    middle = settings.middle
    inner = slice(middle, middle + 15 - length + 1)
    for array, tolerance in ((D, 1e-9), (D.astype(np.float32), 1e-4)):
        places, scores = match_differences(array, settings)
        np.testing.assert_array_equal(places[inner], expected_places[inner])
        np.testing.assert_allclose(scores[inner], expected_scores[inner], atol=tolerance)


def test_seqslam_of_a_part_of_the_map_finds_it(route):
    places, scores = seqslam(route, route[10:50])
    assert places.tolist() == list(range(10, 50))
    assert scores.max() < -0.5


def test_match_differences_without_a_window_or_line_is_none():
    for D in (np.ones((19, 50)), np.ones((50, 15))):
        places, scores = match_differences(D, SeqSlamSettings())
        assert places.tolist() == [-1] * len(D)
        assert np.isinf(scores).all()


def test_match_differences_takes_the_first_line_where_only_one_fits_or_all_are_alike():
    for D in (np.random.default_rng(0).random((20, 16)), np.ones((20, 40))):
        places, _ = match_differences(D, SeqSlamSettings())
        assert places.tolist() == SeqSlamSettings().lines[0].tolist()


@pytest.mark.parametrize(
    ('name', 'known_f1'),
    [('gardens_point', 0.79), pytest.param('nordland', 0.95, marks=pytest.mark.long)],
)
def test_seqslam_on_real_traverses_gives_the_measured_f1(data_folder, name, known_f1):
    dataset = open_dataset(name, data_folder)
    images = [(frame.image for frame in source) for source in (dataset.map, dataset.query)]
    places, scores = seqslam(*images)
    assert best_f1(scores, dataset.ground_truth.accepts(places)).f1 > known_f1
