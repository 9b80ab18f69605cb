"""Precision, recall and what is read off them: by hand, against scikit-learn and against the oracle."""

import sys

import numpy as np
import pytest

from stavpr_ros.errors import InputError, UnavailableError
from stavpr_ros.evaluation.metrics import Ranking, evaluate_ranking, false_alarm_rate, smallest_indices
from stavpr_ros.evaluation.ground_truth import GroundTruth

pytest.importorskip('sklearn', reason='the extra evaluation is not installed')


def ranking(places, scores):
    places = np.asarray(places)
    return Ranking(places if places.ndim == 2 else places[:, None], np.asarray(scores, float))


def test_a_curve_by_hand():
    """
    Five queries, the fifth not in the map. Answers by distance: right .1, wrong .2, right .3, wrong (of the
    fifth) .4; the fourth has none.

    below   accepted  TP FP FN  precision  recall
    .1      -          0  0  4  1          0
    .2      1          1  0  3  1          1/4
    .3      2          1  1  2  1/2        1/3
    .4      3          2  1  1  2/3        2/3
    more    4          2  2  1  1/2        2/3
    """
    truth = GroundTruth.from_pairs([0, 1, 2, 3], [0, 1, 2, 3], N=5, n=9)
    judged = evaluate_ranking(ranking([0, 8, 2, -1, 4], [0.1, 0.2, 0.3, np.inf, 0.4]), truth)
    np.testing.assert_allclose(judged.curve.precision, [1, 1, 1 / 2, 2 / 3, 1 / 2])
    np.testing.assert_allclose(judged.curve.recall, [0, 1 / 4, 1 / 3, 2 / 3, 2 / 3])
    assert judged.best.threshold == 0.4
    assert judged.best.f1 == pytest.approx(2 / 3)
    assert (judged.queries, judged.with_match) == (5, 4)
    assert judged.recall_at_full_precision == 1 / 4
    assert judged.recall_at == {1: 1 / 2, 5: 1 / 2, 10: 1 / 2, 20: 1 / 2}
    # scikit-learn: two right answers are all there is to find: 1/2 * 1 + 1/2 * 2/3
    assert judged.average_precision == pytest.approx(5 / 6)
    assert judged.sklearn_recall_at_full_precision == 1 / 2
    assert judged.sklearn_f1 == pytest.approx(0.8)  # precision 2/3, recall 1


def test_recall_at_counts_any_of_the_first_k():
    truth = GroundTruth.from_pairs([0, 1, 2], [3, 3, 3], N=4, n=30)
    places = np.full((4, 20), -1)
    places[0, :2] = 9, 3
    places[1, :7] = 1, 2, 4, 5, 6, 7, 3
    places[2, :1] = 8
    places[3, :1] = 3  # of no place in the map: does not count
    found = evaluate_ranking(ranking(places, np.arange(4)), truth).recall_at
    assert found == {1: 0, 5: pytest.approx(1 / 3), 10: pytest.approx(2 / 3), 20: pytest.approx(2 / 3)}


def test_only_some_frames_are_judged():
    truth = GroundTruth.identity(6, 6)
    answers = ranking([9 % 6, 1, 2, 3, 0, 0], np.arange(6))
    assert evaluate_ranking(answers, truth, slice(1, 4)).best.f1 == 1
    assert evaluate_ranking(answers, truth, slice(1, 4)).queries == 3
    assert evaluate_ranking(answers, truth).best.f1 < 1
    with pytest.raises(InputError, match='no queries'):
        evaluate_ranking(answers, truth, slice(6, 6))


def test_no_answer_is_not_near():
    truth = GroundTruth.identity(3, 3)
    judged = evaluate_ranking(ranking([0, 1, 2], [np.nan, np.inf, 0.5]), truth)
    assert judged.best.true_positives == 1
    assert judged.best.false_negatives == 2
    assert judged.average_precision > 0.5
    nothing = evaluate_ranking(ranking([-1, -1, -1], [np.inf] * 3), truth)
    assert (nothing.best.f1, nothing.average_precision, nothing.recall_at_full_precision) == (0, 0, 0)


def test_f1_is_the_paper_s_and_average_precision_scikit_learn_s():
    import oracle
    from sklearn.metrics import average_precision_score

    rng = np.random.default_rng(0)
    for _ in range(40):
        scores, places = rng.integers(0, 9, 15) / 8, rng.integers(0, 6, 15)
        right = rng.integers(0, 6, 15)
        truth = GroundTruth.from_pairs(np.arange(15), right, N=15, n=6, tolerance=1)
        judged = evaluate_ranking(ranking(places, scores), truth)
        answers = list(zip(places.tolist(), scores.tolist(), strict=True))
        assert judged.best.f1 == pytest.approx(oracle.best_f1(answers, [[p] for p in right.tolist()], 1))
        correct = np.abs(places - right) <= 1
        assert judged.average_precision == pytest.approx(average_precision_score(correct, -scores))


def test_scores_of_mode_robust_may_be_negative():
    truth = GroundTruth.identity(4, 4)
    judged = evaluate_ranking(ranking([0, 1, 0, 3], [-3.0, -2.0, -1.0, np.inf]), truth)
    # -3 and -2 right, -1 wrong, the last one unanswered
    assert judged.best.f1 == pytest.approx(2 * 2 / (2 * 2 + 2))
    assert judged.average_precision == pytest.approx(1 / 3 + 1 / 3 + 1 / 3 * 3 / 4)


def test_false_alarms():
    assert false_alarm_rate(np.array([0.1, 0.2, 0.3, np.inf]), 0.25) == 0.5
    assert false_alarm_rate(np.array([0.25]), 0.25) == 0  # accepted means below, not at
    with pytest.raises(InputError, match='at least one'):
        false_alarm_rate(np.array([]), 1)


def test_nearest_places():
    row = np.array([3, 1, np.inf, 1, 2, np.nan, 1], np.float32)
    assert smallest_indices(row, 2).tolist() == [1, 3]
    assert smallest_indices(row, 20).tolist() == [1, 3, 6, 4, 0]
    assert smallest_indices(np.array([]), 3).tolist() == []
    rng = np.random.default_rng(1)
    many = rng.integers(0, 9, 200).astype(np.float32)
    assert smallest_indices(many, 20).tolist() == np.argsort(many, kind='stable')[:20].tolist()


def test_a_ranking_has_a_score_a_query():
    with pytest.raises(InputError, match=r'expected \(N, K\) and \(N,\)'):
        Ranking(np.zeros((3, 2), int), np.zeros(2))


def test_without_scikit_learn(monkeypatch):
    monkeypatch.setitem(sys.modules, 'sklearn.metrics', None)
    with pytest.raises(UnavailableError, match='pip install scikit-learn'):
        evaluate_ranking(ranking([0], [0.1]), GroundTruth.identity(1, 1))
