# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recall@1 and recall at 100 % precision by tolerance and sequence length, with intervals.

Errors of neighboring images are correlated, by windows that share images and by scenes that are
difficult as a whole: the intervals are of a circular block bootstrap. The publications that use
these tolerances and lengths: docs/evaluation.md.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from stavpr_lab.evaluation.evaluate import recognize_traverse
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import evaluate_ranking, Ranking
from stavpr_lab.evaluation.seqslam import match_differences, match_lines, SeqSlamSettings
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from stavpr_ros.recognition.robust import MODES

TOLERANCES = (0, 1, 2, 10)  # places
LENGTHS = (1, 4, 5, 10, 20)  # images
METHODS = ('plain', 'centered', 'seqslam', *MODES)
BLOCK = 40  # images
FEWEST_BLOCKS = 5
RESAMPLES = 1000
LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """
    A number with its interval.

    :param value: of all images.
    :param low, high: 95 % interval.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f'{self.value:.3f} ({self.low:.3f}-{self.high:.3f})'


@dataclass(frozen=True)
class Recalls:
    """
    Numbers of the matches of queries at one tolerance.

    :param f1: largest F1.
    :param recall_at_1: share of the queries with a place in the map whose match is correct.
    :param recall_at_100_precision: largest share of them that is accepted without a wrong match.
    """

    f1: float
    recall_at_1: Estimate
    recall_at_100_precision: Estimate

    def __str__(self) -> str:
        return f'{self.f1:.3f} / {self.recall_at_1} / {self.recall_at_100_precision}'


@dataclass(frozen=True)
class ProtocolRow:
    """
    A method with sequences of one length.

    :param recalls: by tolerance.
    """

    method: str
    length: int
    recalls: dict[int, Recalls]

    def to_json(self) -> dict[str, Any]:
        """Return the numbers for a JSON file; tolerances become text."""
        return asdict(self) | {'recalls': {str(t): asdict(r) for t, r in self.recalls.items()}}


def block_length(count: int) -> int:
    """Return the images of a block of ``count`` images: 40, but a fifth of them at most."""
    return max(1, min(BLOCK, count // FEWEST_BLOCKS))


def block_samples(count: int, resamples: int = RESAMPLES, seed: int = 0) -> np.ndarray:
    """
    Draw images in blocks of successive ones; the first image follows the last one.

    :param count: images N.
    :returns: shape (resamples, N), int64.
    """
    block = block_length(count)
    size = resamples, -(-count // block), 1
    firsts = np.random.default_rng(seed).integers(count, size=size)
    return ((firsts + np.arange(block)) % count).reshape(resamples, -1)[:, :count]


def recalls(
    correct: np.ndarray, scores: np.ndarray, has_match: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return recall@1 and recall at 100 % precision; NaN where no query has a place in the map.

    :param correct: the match is correct, shape (..., N), bool.
    :param scores: distances of the matches, +inf = none, of the same shape.
    :param has_match: the query's place is in the map, of the same shape, bool.
    :returns: two arrays of shape (...), float64.
    """
    smallest_wrong = np.where(correct, np.inf, scores).min(axis=-1, keepdims=True)
    accepted = correct & (scores < smallest_wrong)
    with np.errstate(invalid='ignore'):
        first, full = (mask.sum(axis=-1) / has_match.sum(axis=-1) for mask in (correct, accepted))
    return first, full


def evaluate_recalls(ranking: Ranking, ground_truth: GroundTruth) -> Recalls:
    """
    Compare the first place of each query with the ground truth.

    :raises InputError: there are no queries.
    """
    metrics = evaluate_ranking(ranking, ground_truth)
    columns = ground_truth.accepts(ranking.best), ranking.scores, ground_truth.has_match
    images = block_samples(len(ranking))
    sampled = recalls(*(column[images] for column in columns))
    quantiles = (1 - LEVEL) / 2, (1 + LEVEL) / 2
    first, full = (
        Estimate(float(value), *(float(bound) for bound in np.nanquantile(values, quantiles)))
        if np.isfinite(values).any()
        else Estimate(np.nan, np.nan, np.nan)
        for value, values in zip(recalls(*columns), sampled, strict=True)
    )
    return Recalls(metrics.best.f1, first, full)


def image_vectors(features: LocalFeatures, centered: bool = False) -> np.ndarray:
    """
    Return one unit-norm vector an image: its weighted strips.

    :param features: of N images.
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
    Match sequences along straight lines through the distances of images.

    :param D: shape (N, n), row = query image.
    :param method: ``seqslam``: several speeds, after local contrast enhancement (without lengths
        of 1, which it leaves no information); else at the speed of the map.
    :returns: length and matches for each length of at most N.
    """
    for length in lengths:
        if method == 'seqslam' and 1 < length <= len(D):
            places, scores = match_differences(D, SeqSlamSettings(length=length))
        elif method != 'seqslam' and length <= len(D):
            one_speed = SeqSlamSettings(length=length, slowest=1, fastest=1)
            places, scores = match_lines(D, one_speed)
        else:
            continue
        yield length, Ranking(places[:, None], scores)


def recognize_sequences(
    place_map: PlaceMap,
    query: LocalFeatures,
    settings: RecognizerSettings,
    lengths: Sequence[int] = LENGTHS,
    backend: tuple[str, str] = ('cpu', 'float32'),
) -> Iterator[tuple[int, Ranking]]:
    """
    Recognize a traverse with windows of each length; 1 = the nearest place of each image alone.

    :param backend: backend and precision of :class:`stavpr_ros.recognition.PlaceRecognizer`.
    """
    single = 1 in lengths
    for length in lengths:
        if 1 < length <= len(query):
            one = replace(settings, sequence=replace(settings.sequence, length=length))
            recognizer = PlaceRecognizer(place_map, one, *backend)
            found = recognize_traverse(recognizer, query, len(place_map), one)
            if single:  # the same of all lengths
                yield 1, found.single
            single = False
            yield length, found.sequence


def evaluate_protocol(
    place_map: PlaceMap,
    query: LocalFeatures,
    truths: Mapping[int, GroundTruth],
    settings: RecognizerSettings | None = None,
    methods: Sequence[str] = METHODS,
    lengths: Sequence[int] = LENGTHS,
    backend: tuple[str, str] = ('cpu', 'float32'),
) -> Iterator[ProtocolRow]:
    """
    Evaluate methods with sequences of each length.

    :param query: features of N images.
    :param truths: of the N images, by tolerance.
    :param settings: of modes paper and robust but for mode and length.
    :param methods: of :data:`METHODS`. ``plain`` and ``centered`` compare vectors of whole images
        along lines at the speed of the map; ``centered`` subtracts the mean of each traverse.
    :param lengths: ascending; those greater than N are left out.
    :param backend: backend and precision of :class:`stavpr_ros.recognition.PlaceRecognizer`.
    :raises InputError: ground truth of another number of images.
    """
    for method in methods:
        if method in MODES:
            one = replace(settings or RecognizerSettings(), mode=method)
            found = recognize_sequences(place_map, query, one, lengths, backend)
        else:
            traverses = query, place_map.features
            queries, places = (image_vectors(each, method == 'centered') for each in traverses)
            found = match_sequences(1 - queries @ places.T, method, lengths)
        yield from protocol_rows(method, found, truths)


def protocol_rows(
    method: str, found: Iterable[tuple[int, Ranking]], truths: Mapping[int, GroundTruth]
) -> Iterator[ProtocolRow]:
    """
    Evaluate the matches of a method.

    :param found: length and matches.
    :param truths: of the same queries, by tolerance.
    """
    for length, ranking in found:
        by_tolerance = {t: evaluate_recalls(ranking, truth) for t, truth in truths.items()}
        yield ProtocolRow(method, length, by_tolerance)
