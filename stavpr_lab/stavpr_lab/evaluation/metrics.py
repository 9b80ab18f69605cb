# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Precision, recall, F1 and the numbers derived from them.

Counts, F1 and recall follow section 6 of the method: a query that is rejected although its place
is in the map is a false negative. Average precision is scikit-learn's, which counts only rejected
*correct* matches as false negatives; its F1 and recall at 100 % precision are given beside ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
import math
from typing import Any, Self

import numpy as np
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.alignment import aligned_index
from stavpr_ros.errors import InputError
from stavpr_ros.method import Match

RANKS = (1, 5, 10, 20)  # k of recall@k


@dataclass(frozen=True)
class ConfusionCounts:
    """
    Counts at one threshold.

    :param threshold: a match is accepted if its distance is below.
    :param true_positives: accepted and correct.
    :param false_positives: accepted and wrong.
    :param false_negatives: rejected although the place is in the map.
    """

    threshold: float
    true_positives: int
    false_positives: int
    false_negatives: int

    @property
    def accepted(self) -> int:
        """Return the number of accepted matches."""
        return self.true_positives + self.false_positives

    @property
    def precision(self) -> float:
        """Return TP / (TP + FP); 1 when nothing is accepted."""
        return self.true_positives / self.accepted if self.accepted else 1.0

    @property
    def recall(self) -> float:
        """Return TP / (TP + FN); 0 when there is neither."""
        relevant = self.true_positives + self.false_negatives
        return self.true_positives / relevant if relevant else 0.0

    @property
    def f1(self) -> float:
        """Return 2 TP / (2 TP + FP + FN); 0 when there is nothing to count."""
        total = 2 * self.true_positives + self.false_positives + self.false_negatives
        return 2 * self.true_positives / total if total else 0.0


@dataclass(frozen=True)
class Ranking:
    """
    The best places for each of N queries and the distance of the first one.

    :param places: shape (N, K), int64, best first; -1 = no further place.
    :param scores: distance of the first place, shape (N,), float64; +inf = no match.
    """

    places: np.ndarray
    scores: np.ndarray

    def __len__(self) -> int:
        return len(self.scores)

    @property
    def best(self) -> np.ndarray:
        """Return the first place of each query, shape (N,); -1 = none."""
        return self.places[:, 0]


@dataclass(frozen=True)
class ImageMatches:
    """
    The matched place of each of N query images.

    :param places: shape (N,), int64; -1 = none.
    :param distances: shape (N,), float64; +inf = none.
    :param accepted: whether the recognizer matched the window, shape (N,), bool.
    :param probabilities: that the match is right, shape (N,), float64; NaN = not declared.
    """

    places: np.ndarray
    distances: np.ndarray
    accepted: np.ndarray
    probabilities: np.ndarray

    @classmethod
    def none(cls, count: int) -> Self:
        """Return the matches of images without any."""
        places, accepted = np.full(count, -1, np.int64), np.zeros(count, bool)
        return cls(places, np.full(count, np.inf), accepted, np.full(count, np.nan))

    def within(self, true_places: np.ndarray, tolerance: int) -> np.ndarray:
        """
        Return which places are at most ``tolerance`` off, shape (N,), bool.

        :param true_places: shape (N,); -1 = not in the map.
        """
        true_places = np.asarray(true_places)
        both = (self.places >= 0) & (true_places >= 0)
        return both & (np.abs(self.places - true_places) <= tolerance)


@dataclass(frozen=True)
class Metrics:
    """
    Metrics of the matches of queries.

    :param queries: number of queries.
    :param with_match: how many of them have a place in the map.
    :param best: counts at the threshold with the best F1.
    :param average_precision: scikit-learn's ``average_precision_score``.
    :param recall_at: share of the queries with a place in the map that have a correct one among
        the first k; by k.
    :param recall_at_full_precision: largest recall with precision 1.
    :param sklearn_f1: best F1 of scikit-learn's curve.
    :param sklearn_recall_at_full_precision: largest recall with precision 1 of that curve.
    :param curve: threshold, precision and recall, from rejecting all matches to accepting all,
        shape (T, 3).
    """

    queries: int
    with_match: int
    best: ConfusionCounts
    average_precision: float
    recall_at: dict[int, float]
    recall_at_full_precision: float
    sklearn_f1: float
    sklearn_recall_at_full_precision: float
    curve: np.ndarray

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


def counts_at(
    threshold: float,
    distances: np.ndarray,
    correct: np.ndarray,
    has_match: np.ndarray | None = None,
) -> ConfusionCounts:
    """
    Count at one threshold.

    :param distances: distance of each query's match, shape (N,); +inf or NaN = no match.
    :param correct: the match is within the tolerance of the ground truth, shape (N,), bool.
    :param has_match: the query's place is in the map, shape (N,), bool; None = all are.
    """
    return _counts(np.array([threshold]), distances, correct, has_match)[0]


def accepted_counts(
    accepted: np.ndarray, correct: np.ndarray, has_match: np.ndarray
) -> ConfusionCounts:
    """
    Count accepted matches, whatever they were accepted by; the threshold is NaN.

    :param accepted: shape (N,), bool; the others are as in :func:`counts_at`.
    """
    masks = accepted & correct, accepted & ~correct, ~accepted & has_match
    return ConfusionCounts(float('nan'), *(int(np.count_nonzero(mask)) for mask in masks))


def sweep(
    distances: np.ndarray, correct: np.ndarray, has_match: np.ndarray | None = None
) -> list[ConfusionCounts]:
    """
    Count at every threshold that changes the counts, from rejecting all to accepting all.

    Parameters: see :func:`counts_at`.
    """
    finite = np.unique(distances[np.isfinite(distances)])
    thresholds = (
        np.append(finite, np.nextafter(finite[-1], np.inf)) if finite.size else np.zeros(1)
    )
    return _counts(thresholds, distances, correct, has_match)


def _counts(
    thresholds: np.ndarray,
    distances: np.ndarray,
    correct: np.ndarray,
    has_match: np.ndarray | None,
) -> list[ConfusionCounts]:
    order = np.argsort(distances)  # NaN last, as +inf
    accepted = np.searchsorted(distances[order], thresholds)  # below, not at the threshold
    true_positives = np.append(0, np.cumsum(correct[order]))[accepted]
    relevant = np.ones_like(correct) if has_match is None else has_match
    in_map = np.append(0, np.cumsum(relevant[order]))
    false_negatives = in_map[-1] - in_map[accepted]
    columns = (thresholds, true_positives, accepted - true_positives, false_negatives)
    return [
        ConfusionCounts(*row) for row in zip(*(column.tolist() for column in columns), strict=True)
    ]


def is_full(match: Match, length: int) -> bool:
    """Return whether a match is of a full window, by its path; True without a path."""
    return not len(match.path.pairs) or int(match.path.pairs[-1, 0]) >= length - 1


def score_of(match: Match) -> float:
    """Return the distance; +inf without a sequence, or with a probability of 0."""
    impossible = match.distance >= 1 and not math.isnan(match.probability)
    return math.inf if match.path.place < 0 or impossible else match.distance


def image_matches(matches: Sequence[Match], length: int, late: bool = False) -> ImageMatches:
    """
    Assign the matches of windows to images: each to the image in the middle of its window.

    Images before the middle of the first matched window or after the middle of the last one take
    their place from that window's warping path, with its distance. Windows that are not full do
    not count.

    :param matches: one an image, in order: the match of the window that ends with the image.
    :param length: images in a window, l.
    :param late: images without a match of their own take their late one, where they have it.
    """
    result = ImageMatches.none(len(matches))
    middle = (length - 1) // 2
    match_ends = (end for end, match in enumerate(matches) if match.path.place >= 0)
    ends = [end for end in match_ends if is_full(matches[end], length)]

    def assign(end: int, position: int, place: int) -> None:
        image = end - (length - 1) + position
        if image >= 0:
            match = matches[end]
            if len(match.path.shares):
                match = match.with_probability(float(match.path_probabilities[position]))
            result.places[image], result.distances[image] = place, score_of(match)
            result.accepted[image], result.probabilities[image] = match.accepted, match.probability

    for end in ends:
        assign(end, middle, matches[end].path.place)
    if ends:
        for position in range(middle):
            assign(ends[0], position, aligned_index(matches[ends[0]].path.pairs, position))
        for position in range(middle + 1, length):
            assign(ends[-1], position, aligned_index(matches[ends[-1]].path.pairs, position))
    for late_match in chain.from_iterable(match.late for match in matches if late):
        image = late_match.first_image + late_match.position
        result.places[image], result.distances[image] = late_match.place, score_of(late_match)
        result.accepted[image], result.probabilities[image] = True, late_match.probability
    return result


def published_matches(matches: Sequence[Match], length: int) -> tuple[ImageMatches, np.ndarray]:
    """
    Return all matches of a traverse: one an image, and the early ones behind them.

    An early match is of the middle of the newest images alone, before a window is full or since
    the camera has come to the map. A robot gets it, whatever the full window shows later.

    :param matches, length: see :func:`image_matches`.
    :returns: M >= N matches, and the image of each, (M,), int64.
    """
    of_images = image_matches(matches, length)
    early = [
        (end, match)
        for end, match in enumerate(matches)
        if match.accepted and not is_full(match, length)
    ]
    newest = [int(match.path.pairs[-1, 0]) for _, match in early]
    images = [end - last + last // 2 for (end, _), last in zip(early, newest, strict=True)]
    rows = [(match.place, score_of(match), True, match.probability) for _, match in early]
    columns = np.array(rows).reshape(-1, 4).T
    both = [
        np.append(getattr(of_images, name), column.astype(getattr(of_images, name).dtype))
        for name, column in zip(ImageMatches.__dataclass_fields__, columns, strict=True)
    ]
    return ImageMatches(*both), np.append(np.arange(len(matches)), images).astype(np.int64)


def evaluate_ranking(
    ranking: Ranking, ground_truth: GroundTruth, images: slice = slice(None)
) -> Metrics:
    """
    Compare ranked places with the ground truth.

    :param images: the queries that count, of those whose truth is known; all by default.
    :raises InputError: no queries are left.
    """
    queries = np.arange(len(ranking))[images]
    queries = queries[ground_truth.is_stated[queries]]
    correct = ground_truth.accepts(ranking.places)[queries]
    has_match, scores = ground_truth.has_match[queries], ranking.scores[queries]
    if not len(scores):
        raise InputError(f'{images} of {len(ranking)} queries leaves no queries to evaluate')
    counts = sweep(scores, correct[:, 0], has_match)
    average_precision, sklearn_f1, sklearn_recall = _sklearn_metrics(scores, correct[:, 0])
    return Metrics(
        queries=len(scores),
        with_match=int(np.count_nonzero(has_match)),
        best=max(counts, key=lambda c: c.f1),
        average_precision=average_precision,
        recall_at={k: _recall_at(k, correct, has_match) for k in RANKS},
        recall_at_full_precision=max(c.recall for c in counts if c.precision == 1),
        sklearn_f1=sklearn_f1,
        sklearn_recall_at_full_precision=sklearn_recall,
        curve=np.array([(c.threshold, c.precision, c.recall) for c in counts]),
    )


def smallest_indices(row: np.ndarray, k: int) -> np.ndarray:
    """
    Return the indices of the k smallest finite values, smallest first, the lowest index on a tie.

    :param row: shape (n,); +inf and NaN are left out.
    :returns: shape (<= k,), int64.
    """
    usable = np.flatnonzero(np.isfinite(row))
    if len(usable) > k:
        limit = np.partition(row[usable], k - 1)[k - 1]
        usable = usable[row[usable] <= limit]
    return usable[np.argsort(row[usable], kind='stable')][:k]


def _recall_at(k: int, correct: np.ndarray, has_match: np.ndarray) -> float:
    """Return the share of queries with a place in the map; NaN where none has one."""
    is_hit = correct[has_match, :k].any(axis=1)
    return float(np.mean(is_hit)) if has_match.any() else float('nan')


def _sklearn_metrics(scores: np.ndarray, correct: np.ndarray) -> tuple[float, float, float]:
    """Return average precision, best F1 and recall at 100 % precision, as scikit-learn counts."""
    if not correct.any():
        return 0.0, 0.0, 0.0
    finite = np.isfinite(scores)
    # scikit-learn takes finite values only: queries without a match come last
    confidence = -np.where(finite, scores, scores[finite].max(initial=0.0) + 1)
    # here, since the demonstration imports this module and its set-up has no scikit-learn
    from sklearn.metrics import average_precision_score, precision_recall_curve

    precision, recall, _ = precision_recall_curve(correct, confidence)
    average = average_precision_score(correct, confidence)
    f1 = 2 * precision * recall / np.maximum(precision + recall, np.finfo(float).tiny)
    return float(average), float(f1.max()), float(recall[precision == 1].max())
