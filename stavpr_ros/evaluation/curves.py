"""
Precision over recall and the numbers that are read off it, for answers with a score each.

Counts, F1 and recall are those of section 6 of the method (:mod:`stavpr_ros.evaluation.metrics`): whatever
is rejected although its place is in the map is a miss. Average precision is scikit-learn's, for which only
*right* answers can be missed; its F1 and its recall at 100 % precision are given beside ours.
"""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from stavpr_ros.errors import InputError, UnavailableError
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.metrics import Score, score_at, sweep

RANKS = (1, 5, 10, 20)


@dataclass(frozen=True)
class Ranking:
    """
    The best places for each of N queries, and how sure the first one is.

    :param places: shape (N, K), int64, best first; -1 = no further place.
    :param scores: distance of the first place, shape (N,), float64, small is sure; +inf = no answer.
    """

    places: np.ndarray
    scores: np.ndarray

    def __post_init__(self) -> None:
        if self.places.ndim != 2 or self.scores.shape != self.places.shape[:1]:
            raise InputError(
                f'places {self.places.shape} and scores {self.scores.shape}: expected (N, K) and (N,)'
            )

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def best(self) -> np.ndarray:
        """The answer to each query, shape (N,); -1 = none."""
        return self.places[:, 0]


@dataclass(frozen=True)
class Curve:
    """
    One point for each threshold that changes something, from rejecting all to accepting all.

    :param thresholds, precision, recall: shape (points,), float64.
    """

    thresholds: np.ndarray
    precision: np.ndarray
    recall: np.ndarray


@dataclass(frozen=True)
class Metrics:
    """
    What answers to some queries are worth.

    :param queries: number of queries that were judged.
    :param with_match: how many of them have a place in the map.
    :param best: counts at the threshold with the best F1.
    :param average_precision: area under scikit-learn's curve, its ``average_precision_score``.
    :param recall_at: share of queries with a match that have a right place among the first k; by k.
    :param recall_at_full_precision: largest recall at which precision is still 1.
    :param sklearn_f1: best F1 of scikit-learn's curve.
    :param sklearn_recall_at_full_precision: the same recall on scikit-learn's curve.
    """

    queries: int
    with_match: int
    best: Score
    average_precision: float
    recall_at: dict[int, float]
    recall_at_full_precision: float
    sklearn_f1: float
    sklearn_recall_at_full_precision: float
    curve: Curve

    def to_json(self) -> dict[str, Any]:
        """Return the numbers, without the curve, for a JSON file."""
        return {
            'f1': self.best.f1,
            'threshold': self.best.threshold,
            'precision': self.best.precision,
            'recall': self.best.recall,
            'average_precision': self.average_precision,
            **{f'recall_at_{k}': value for k, value in self.recall_at.items()},
            'recall_at_100_precision': self.recall_at_full_precision,
            'true_positives': self.best.true_positives,
            'false_positives': self.best.false_positives,
            'false_negatives': self.best.false_negatives,
            'queries': self.queries,
            'queries_with_match': self.with_match,
            'scikit_learn': {
                'f1': self.sklearn_f1,
                'recall_at_100_precision': self.sklearn_recall_at_full_precision,
            },
        }


def import_sklearn() -> ModuleType:
    """
    Import scikit-learn's metrics.

    :raises UnavailableError: the extra ``evaluation`` is not installed.
    """
    try:
        return importlib.import_module('sklearn.metrics')
    except ImportError as error:
        raise UnavailableError(
            f'the evaluation needs scikit-learn ({error}): pip install scikit-learn'
        ) from error


def evaluate_ranking(ranking: Ranking, truth: GroundTruth, frames: slice = slice(None)) -> Metrics:
    """
    Judge answers.

    :param frames: the queries that count; all by default.
    :raises InputError: no queries are left.
    :raises UnavailableError: scikit-learn is not there.
    """
    correct = truth.accepts(ranking.places)[frames]
    has_match = truth.has_match[frames]
    scores = np.where(np.isnan(ranking.scores), np.inf, ranking.scores)[frames]
    if not len(scores):
        raise InputError(f'no queries are left to judge: {len(ranking)} came, {frames} of them count')
    counts = sweep(scores, correct[:, 0], has_match)
    average_precision, sklearn_f1, sklearn_recall = _sklearn_numbers(scores, correct[:, 0])
    return Metrics(
        queries=len(scores),
        with_match=int(np.count_nonzero(has_match)),
        best=max(counts, key=lambda score: score.f1),
        average_precision=average_precision,
        recall_at={k: _recall_at(k, correct, has_match) for k in RANKS},
        recall_at_full_precision=max(score.recall for score in counts if score.precision == 1),
        sklearn_f1=sklearn_f1,
        sklearn_recall_at_full_precision=sklearn_recall,
        curve=_curve(counts),
    )


def false_alarm_rate(scores: np.ndarray, threshold: float) -> float:
    """
    Share of answers to queries *that are not in the map* that are accepted all the same.

    :param scores: shape (N,); +inf or NaN = no answer.
    :raises InputError: no queries.
    """
    if not len(scores):
        raise InputError('the rate of false alarms needs at least one query')
    nothing = np.zeros(len(scores), bool)
    return score_at(threshold, scores, nothing, nothing).false_positives / len(scores)


def nearest_places(row: np.ndarray, k: int) -> np.ndarray:
    """
    Return the places with the k smallest values, smallest first, the lowest index first on a tie.

    :param row: shape (n,); places with +inf or NaN are left out.
    :returns: shape (<= k,), int64.
    """
    usable = np.flatnonzero(np.isfinite(row))
    if len(usable) > k:
        border = np.partition(row[usable], k - 1)[k - 1]
        usable = usable[row[usable] <= border]
    return usable[np.argsort(row[usable], kind='stable')][:k]


def _recall_at(k: int, correct: np.ndarray, has_match: np.ndarray) -> float:
    """Share of the queries with a match; NaN where none has one."""
    found = correct[has_match, :k].any(axis=1)
    return float(np.mean(found)) if has_match.any() else float('nan')


def _curve(counts: Sequence[Score]) -> Curve:
    return Curve(
        np.array([score.threshold for score in counts]),
        np.array([score.precision for score in counts]),
        np.array([score.recall for score in counts]),
    )


def _sklearn_numbers(scores: np.ndarray, correct: np.ndarray) -> tuple[float, float, float]:
    """Average precision, best F1 and recall at 100 % precision, as scikit-learn counts."""
    metrics = import_sklearn()
    if not correct.any():
        return 0.0, 0.0, 0.0
    finite = np.isfinite(scores)
    # no answer is the last answer: scikit-learn takes finite scores only
    sureness = -np.where(finite, scores, scores[finite].max(initial=0.0) + 1)
    precision, recall, _ = metrics.precision_recall_curve(correct, sureness)
    average = metrics.average_precision_score(correct, sureness)
    f1 = 2 * precision * recall / np.maximum(precision + recall, np.finfo(float).tiny)
    return float(average), float(f1.max()), float(recall[precision == 1].max())
