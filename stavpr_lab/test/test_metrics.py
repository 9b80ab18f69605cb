# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Metrics, calibration and worst mistakes: by hand, by scikit-learn and the oracle."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
from stavpr_lab.evaluation.calibration import calibrate
from stavpr_lab.evaluation.evaluate import evaluate_traverse, ReducedDistances, TraverseResults
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import (
    evaluate_ranking,
    image_matches,
    ImageMatches,
    published_matches,
    Ranking,
    smallest_indices,
)
from stavpr_lab.evaluation.report import worst_mistakes
from stavpr_ros.errors import InputError
from stavpr_ros.method import Match, Path, Status

NONE = Match(Status.WARMING_UP)


def ranking(places, scores):
    places = np.asarray(places)
    return Ranking(places if places.ndim == 2 else places[:, None], np.asarray(scores, float))


def window(middle, path, distance):
    return Match(Status.NO_MATCH, path=Path(np.array(path, np.int32), middle, distance))


def test_best_f1_on_a_tie_is_that_of_the_lowest_threshold():
    """Below .3: 2 TP, 1 FN; accepting all: 2 TP, 1 FP; F1 is .8 both times."""
    truth = GroundTruth.identity(3, 3)
    best = evaluate_ranking(ranking([0, 1, 0], [0.1, 0.2, 0.3]), truth).best
    assert (best.f1, best.threshold) == (pytest.approx(0.8), 0.3)


def test_best_f1_and_average_precision_equal_oracle_and_scikit_learn():
    from sklearn.metrics import average_precision_score

    rng = np.random.default_rng(0)
    for _ in range(40):
        scores = rng.integers(0, 9, 15) / 8
        places, true = rng.integers(0, 6, (2, 15))
        truth = GroundTruth.from_pairs(np.arange(15), true, N=15, n=6, tolerance=1)
        metrics = evaluate_ranking(ranking(places, scores), truth)
        answers = list(zip(places.tolist(), scores.tolist(), strict=True))
        best = oracle.best_f1(answers, [[place] for place in true.tolist()], 1)
        assert metrics.best.f1 == pytest.approx(best)
        average = average_precision_score(np.abs(places - true) <= 1, -scores)
        assert metrics.average_precision == pytest.approx(average)


def test_image_matches_of_windows_of_four_by_hand():
    """
    Six images; the middle of a window of 4 is position floor(3 / 2) = 1.

    Windows end at images 3, 4, 5, their middles are images 1, 2, 3. Image 0 is read from the first
    path, images 4 and 5 from the last one.
    """
    windows = [
        *(NONE, NONE, NONE),
        window(11, [(0, 10), (0, 11), (0, 12), (1, 12), (2, 12), (3, 12)], 0.3),
        window(12, [(0, 11), (1, 12), (2, 13), (3, 14)], 0.2),
        window(14, [(0, 12), (1, 13), (2, 15), (3, 16), (3, 17)], 0.4),
    ]
    matches = image_matches(windows, 4)
    assert matches.places.tolist() == [11, 11, 12, 14, 15, 16]
    assert matches.distances.tolist() == [0.3, 0.3, 0.2, 0.4, 0.4, 0.4]
    within = matches.within(np.array([11, 14, -1, 14, 12, 19]), 2)
    assert within.tolist() == [True, False, False, True, False, False]


def test_published_matches_are_of_images_and_early_by_hand():
    """Of windows of 4: two images that end at image 2, and two accepted that end at image 5."""
    early = replace(window(12, [(0, 12), (1, 13)], 0.05), status=Status.MATCH, probability=0.95)
    full = window(11, [(0, 11), (1, 11), (2, 12), (3, 13)], 0.3)
    waiting = replace(early, status=Status.WARMING_UP)
    matches, images = published_matches([NONE, waiting, early, full, full, early], 4)
    assert images.tolist() == [0, 1, 2, 3, 4, 5, 1, 4]
    assert matches.places.tolist() == [11, 11, 11, 12, 13, -1, 12, 12]
    assert np.flatnonzero(matches.accepted).tolist() == [6, 7]
    assert matches.probabilities[6:].tolist() == [0.95, 0.95]


def test_evaluate_ranking_of_five_queries_by_hand():
    """
    The fifth query is not in the map, the fourth has no match.

    Distances: correct .1, wrong .2, correct .3, wrong (of the fifth) .4.

    below   accepted  TP FP FN  precision  recall
    .1      -          0  0  4  1          0
    .2      1          1  0  3  1          1/4
    .3      2          1  1  2  1/2        1/3
    .4      3          2  1  1  2/3        2/3
    more    4          2  2  1  1/2        2/3
    """
    truth = GroundTruth.from_pairs([0, 1, 2, 3], [0, 1, 2, 3], N=5, n=9)
    metrics = evaluate_ranking(ranking([0, 8, 2, -1, 4], [0.1, 0.2, 0.3, np.inf, 0.4]), truth)
    thresholds, precision, recall = metrics.curve.T
    np.testing.assert_allclose(precision, [1, 1, 1 / 2, 2 / 3, 1 / 2])
    np.testing.assert_allclose(recall, [0, 1 / 4, 1 / 3, 2 / 3, 2 / 3])
    np.testing.assert_allclose(thresholds, [0.1, 0.2, 0.3, 0.4, 0.4])
    assert (metrics.best.threshold, metrics.best.f1) == (0.4, pytest.approx(2 / 3))
    assert (metrics.queries, metrics.with_match) == (5, 4)
    assert metrics.recall_at_full_precision == 1 / 4
    assert metrics.recall_at == {1: 1 / 2, 5: 1 / 2, 10: 1 / 2, 20: 1 / 2}
    # scikit-learn: two correct matches in all: 1/2 * 1 + 1/2 * 2/3
    assert metrics.average_precision == pytest.approx(5 / 6)
    assert metrics.sklearn_recall_at_full_precision == 1 / 2
    assert metrics.sklearn_f1 == pytest.approx(0.8)  # precision 2/3, recall 1


def test_evaluate_ranking_recall_at_k_counts_any_of_the_first_k():
    truth = GroundTruth.from_pairs([0, 1, 2], [3, 3, 3], N=4, n=30)
    places = np.full((4, 20), -1)
    places[0, :2] = 9, 3
    places[1, :7] = 1, 2, 4, 5, 6, 7, 3
    places[2, :1] = 8
    places[3, :1] = 3  # not in the map: not counted
    result = evaluate_ranking(ranking(places, np.arange(4)), truth).recall_at
    assert result == {1: 0, 5: 1 / 3, 10: 2 / 3, 20: 2 / 3}


def test_evaluate_ranking_of_a_slice_counts_only_these_queries():
    truth, places = GroundTruth.identity(6, 6), ranking([3, 1, 2, 3, 0, 0], np.arange(6))
    inner = evaluate_ranking(places, truth, slice(1, 4))
    assert (inner.best.f1, inner.queries) == (1, 3)
    assert evaluate_ranking(places, truth).best.f1 < 1
    with pytest.raises(InputError, match='no queries'):
        evaluate_ranking(places, truth, slice(6, 6))


def test_evaluate_ranking_takes_nan_and_infinity_as_no_match():
    truth = GroundTruth.identity(3, 3)
    metrics = evaluate_ranking(ranking([0, 1, 2], [np.nan, np.inf, 0.5]), truth)
    assert (metrics.best.true_positives, metrics.best.false_negatives) == (1, 2)
    assert metrics.average_precision > 0.5
    none = evaluate_ranking(ranking([-1, -1, -1], [np.inf] * 3), truth)
    assert (none.best.f1, none.average_precision, none.recall_at_full_precision) == (0, 0, 0)


def test_smallest_indices_are_ordered_by_value_then_index():
    row = np.array([3, 1, np.inf, 1, 2, np.nan, 1], np.float32)
    assert smallest_indices(row, 2).tolist() == [1, 3]
    assert smallest_indices(row, 20).tolist() == [1, 3, 6, 4, 0]
    assert smallest_indices(np.array([]), 3).tolist() == []
    many = np.random.default_rng(1).integers(0, 9, 200).astype(np.float32)
    assert smallest_indices(many, 20).tolist() == np.argsort(many, kind='stable')[:20].tolist()


NAN = float('nan')


def test_calibrate_six_images_by_hand():
    """
    Bin .9-1: 1.0 right, .95 right, .94 wrong: mean .9633, 2/3 right. Bin .3-.4: .3 right.

    The fifth image declares nothing, the sixth is not in the map and declares .55.
    Errors: 3 x .2967, 1 x .7 and 1 x .55, of five images: .428.
    """
    probabilities = np.array([1.0, 0.95, 0.94, 0.3, NAN, 0.55])
    correct = np.array([True, True, False, True, True, False])
    has_match = np.array([True, True, True, True, True, False])
    result = calibrate(probabilities, correct, has_match)
    assert result.images.tolist() == [0, 0, 0, 1, 0, 1, 0, 0, 0, 3]
    assert result.declared[[3, 5, 9]] == pytest.approx([0.3, 0.55, 2.89 / 3])
    assert result.right[[3, 5, 9]] == pytest.approx([1, 0, 2 / 3])
    assert np.isnan(result.right[0])
    assert result.expected_error == pytest.approx((2.89 - 2 + 0.7 + 0.55) / 5)
    numbers = result.to_json()
    assert numbers['images'] == 5
    assert numbers['bins'][3] == {
        'from': 0.3, 'to': 0.4, 'images': 1, 'declared': 0.3, 'right': 1.0
    }  # fmt: skip
    levels = {level.pop('probability'): level for level in numbers['levels']}
    assert levels[0.5] == {'matched': 4, 'precision': 1 / 2, 'recall': 1 / 2}  # FN: .3 and none
    assert levels[0.9] == {'matched': 3, 'precision': 2 / 3, 'recall': 1 / 2}
    assert levels[0.95] == {'matched': 2, 'precision': 1.0, 'recall': 2 / 5}
    # above .94 the first two are accepted: two of five
    assert numbers['recall_at_100_precision'] == 2 / 5
    # from .3 on: 3 right, 2 wrong, 1 rejected: 6 / 9
    assert numbers['f1'] == pytest.approx(2 / 3)


def test_calibrate_of_a_level_that_nothing_reaches_has_no_precision():
    result = calibrate(np.array([0.4, 0.2]), np.array([True, False]), np.ones(2, bool))
    level = result.to_json()['levels'][0]
    assert level == {'probability': 0.5, 'matched': 0, 'precision': None, 'recall': 0.0}


def test_calibrate_of_no_probability_is_none():
    assert calibrate(np.full(3, np.nan), np.ones(3, bool), np.ones(3, bool)) is None


def results_of(places, scores):
    matches = Ranking(np.asarray(places)[:, None], np.asarray(scores))
    reduced = ReducedDistances(np.zeros((1, 1)), (60, 60))
    accepted, unknown = matches.scores < 1, np.full(len(places), np.nan)
    published = ImageMatches.none(len(places)), np.arange(len(places))
    columns = accepted, unknown, published, published[1]
    return TraverseResults(matches, matches, np.zeros(len(places)), (), reduced, *columns)


def test_worst_mistakes_are_ordered_and_apart():
    """Other places before near misses, then by distance; none near another one."""
    places, scores = np.arange(60), np.full(60, 0.05)
    mistakes = ((10, 40, 0.5), (12, 41, 0.6), (30, 33, 0.1), (50, 5, 0.2), (28, 6, np.inf))
    for image, place, score in mistakes:
        places[image], scores[image] = place, score
    results = results_of(places, scores)
    evaluation = evaluate_traverse(results, GroundTruth.identity(60, 60, 1), 20)
    assert worst_mistakes(evaluation, 9) == [50, 10, 30]
    assert worst_mistakes(evaluation, 1) == [50]
    assert evaluation.false_alarm_rates == {}
    with pytest.raises(InputError, match='59 images for 60'):
        evaluate_traverse(results, GroundTruth.identity(59, 59, 1), 20)
