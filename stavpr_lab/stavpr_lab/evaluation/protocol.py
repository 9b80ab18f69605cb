# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recall@1 and recall at 100 % precision by tolerance and sequence length, with 95 % intervals.

Sources, methods and the choice of the block length: benchmarks/results/evaluation.md.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from stavpr_lab.evaluation.evaluate import recognize_traverse
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import evaluate_ranking, Ranking
from stavpr_lab.evaluation.seqslam import match_differences, match_lines, SeqSlamSettings
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import Map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.settings import MODES

TOLERANCES = (0, 1, 2, 10)  # places
LENGTHS = (1, 4, 5, 10, 20)  # images
METHODS = ('plain', 'centered', 'seqslam', *MODES)
MAX_BLOCK, MIN_BLOCKS = 40, 5  # images of a block at most, blocks of a query at least
INTERVAL = (0.025, 0.975)  # quantiles
Estimate = tuple[float, ...]  # value, low and high bound of its interval


@dataclass(frozen=True)
class Recalls:
    """
    Numbers of a method with sequences of one length, at one tolerance.

    :param f1: largest F1.
    :param recall_at_1: share of the queries with a place in the map whose match is correct.
    :param recall_at_100_precision: largest share of them that is accepted without a wrong match.
    """

    method: str
    length: int
    tolerance: int
    f1: float
    recall_at_1: Estimate
    recall_at_100_precision: Estimate


def text(estimate: Sequence[float]) -> str:
    """Return an estimate with its interval as text."""
    return '{:.3f} ({:.3f}-{:.3f})'.format(*estimate)


def block_samples(count: int, resamples: int = 1000, seed: int = 0) -> np.ndarray:
    """
    Draw images for a circular block bootstrap.

    :param count: images N.
    :returns: images in blocks of successive ones, shape (resamples, N), int64.
    """
    block = max(1, min(MAX_BLOCK, count // MIN_BLOCKS))
    size = resamples, -(-count // block), 1
    firsts = np.random.default_rng(seed).integers(count, size=size)
    return ((firsts + np.arange(block)) % count).reshape(resamples, -1)[:, :count]


def error_rate_and_recall(
    accepted: np.ndarray, correct: np.ndarray, has_match: np.ndarray
) -> tuple[Estimate, Estimate]:
    """
    Return the share of wrong ones among accepted matches, and recall, with 95 % intervals.

    Where no image has a right place, the first is the share of accepted images. What is not
    defined is NaN; samples in which it is not are left out of the interval.

    :param accepted, correct, has_match: whether an image is so, shape (N,), bool.
    """
    right, wrong, misses = accepted & correct, accepted & ~correct, ~accepted & has_match
    answers = accepted if has_match.any() else np.ones_like(accepted)
    columns = np.array([wrong, answers, right, right | misses])
    samples = (block_samples(len(accepted), 100, seed) for seed in range(10))  # in less memory
    resamples = [columns[:, images].sum(axis=2) for images in samples]
    counts = np.column_stack([columns.sum(axis=1), *resamples])
    with np.errstate(invalid='ignore'):
        shares = counts[::2] / counts[1::2]
    return _with_interval(shares[0]), _with_interval(shares[1])


def _with_interval(values: np.ndarray) -> Estimate:
    """Return the first of the values, and the interval of the others."""
    finite = values[1:][~np.isnan(values[1:])]
    interval = np.quantile(finite, INTERVAL) if len(finite) else (np.nan, np.nan)
    return float(values[0]), float(interval[0]), float(interval[1])


def recalls(
    correct: np.ndarray, scores: np.ndarray, has_match: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return recall@1 and recall at 100 % precision; NaN where no query has a place in the map.

    :param correct: the match is correct, shape (..., N), bool.
    :param scores: distances of the matches, of the same shape; +inf = none.
    :param has_match: the query's place is in the map, of the same shape, bool.
    :returns: two arrays of shape (...), float64.
    """
    smallest_wrong = np.where(correct, np.inf, scores).min(axis=-1, keepdims=True)
    accepted = correct & (scores < smallest_wrong)
    counts = np.where(has_match.any(axis=-1), has_match.sum(axis=-1), np.nan)
    return correct.sum(axis=-1) / counts, accepted.sum(axis=-1) / counts


def evaluate_matches(
    method: str, rankings: Iterable[tuple[int, Ranking]], truths: Mapping[int, GroundTruth]
) -> Iterator[Recalls]:
    """
    Compare matches with the ground truth at each tolerance.

    :param rankings: length of the sequences and matches.
    :param truths: ground truths of the same queries, by tolerance.
    """
    for length, ranking in rankings:
        for tolerance, truth in truths.items():
            images = block_samples(int(truth.is_stated.sum()))
            f1 = evaluate_ranking(ranking, truth).best.f1
            numbers = truth.accepts(ranking.best), ranking.scores, truth.has_match
            columns = [column[truth.is_stated] for column in numbers]
            resamples = recalls(*(column[images] for column in columns))
            first, full = (
                _with_interval(np.append(value, values))
                for value, values in zip(recalls(*columns), resamples, strict=True)
            )
            yield Recalls(method, length, tolerance, f1, first, full)


def image_vectors(features: LocalFeatures, centered: bool = False) -> np.ndarray:
    """
    Return the weighted strips of each image as one unit-norm vector.

    :param features: features of N images.
    :param centered: without the mean of the N images.
    :returns: shape (N, W * d), float32; zeros for an image without features.
    """
    weighted = features.strips * features.weights[:, :, None]
    vectors = weighted.transpose(1, 0, 2).reshape(len(features), -1)
    if centered:
        vectors = vectors - vectors.mean(axis=0)
    norms = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(norms > 0, norms, 1)


def match_sequences(
    D: np.ndarray, method: str, lengths: Sequence[int] = LENGTHS
) -> Iterator[tuple[int, Ranking]]:
    """
    Match sequences of each length along straight lines through the distances of images.

    :param D: shape (N, n), row = query image.
    :param method: ``seqslam``, without sequences of 1 image, which contrast enhancement leaves no
        information; else lines at the speed of the map.
    """
    is_enhanced = method == 'seqslam'
    for length in lengths:
        if is_enhanced < length <= len(D):
            settings = SeqSlamSettings(length=length)
            if is_enhanced:
                places, scores = match_differences(D, settings)
            else:
                places, scores = match_lines(D, replace(settings, slowest=1, fastest=1))
            yield length, Ranking(places[:, None], scores)


def evaluate_protocol(
    place_map: Map,
    query: LocalFeatures,
    truths: Mapping[int, GroundTruth],
    settings: RecognizerSettings | None = None,
    methods: Sequence[str] = METHODS,
    lengths: Sequence[int] = LENGTHS,
    backend: tuple[str, str] = ('cpu', 'float32'),
) -> Iterator[Recalls]:
    """
    Evaluate methods with sequences of each length, shorter than the query.

    :param query: features of N images.
    :param truths: ground truths of the N images, by tolerance.
    :param settings: settings of modes paper and robust, except mode and length.
    :param methods: names in :data:`METHODS`; ``centered`` subtracts the mean of each traverse.
    :param backend: backend and precision of :class:`stavpr_ros.method.PlaceRecognizer`.
    :raises InputError: ground truth of another number of images.
    """
    for method in methods:
        if method in MODES:
            one = replace(settings or RecognizerSettings(), mode=method)
            rankings = _recognize(place_map, query, one, lengths, backend)
        else:
            traverses = query, place_map.features
            queries, places = (image_vectors(side, method == 'centered') for side in traverses)
            rankings = match_sequences(1 - queries @ places.T, method, lengths)
        yield from evaluate_matches(method, rankings, truths)


def _recognize(
    place_map: Map,
    query: LocalFeatures,
    settings: RecognizerSettings,
    lengths: Sequence[int],
    backend: tuple[str, str],
) -> Iterator[tuple[int, Ranking]]:
    """Recognize with windows of each length; 1 = each image alone."""
    for length in lengths:
        if length <= len(query):
            window = replace(settings.sequence, length=max(2, length))
            one = replace(settings, sequence=window)
            recognizer = PlaceRecognizer(place_map, one, *backend)
            results = recognize_traverse(recognizer, query, len(place_map), one)
            yield length, results.single if length == 1 else results.sequence
