# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Evaluation of a traverse, recognized image by image as in the node.

Every image has two results: the nearest place to the image alone, and the place that the window
around it was matched with. The rows of distances are not kept: memory does not limit the length.
"""

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
import time

import numpy as np
from stavpr_lab.evaluation.calibration import calibrate, Calibration
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import (
    evaluate_ranking,
    image_matches,
    ImageMatches,
    is_full,
    Metrics,
    published_matches,
    Ranking,
    RANKS,
    smallest_indices,
)
from stavpr_ros.errors import InputError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import Map
from stavpr_ros.method import Match, PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.loop_closer import LoopCloser
from stavpr_ros.progress import Progress

MARGIN = 8  # places beside the path of a window whose distances are kept
MATRIX_SIDE = 900  # cells along a side of the reduced distance matrix
WINDOWS = 1500  # windows whose distances are kept, spread over the traverse


@dataclass(frozen=True)
class WindowDistances:
    """
    The distances of one window to the stretch of the map that it was matched with.

    :param image: the window's middle image, which the window is the match of.
    :param newest: its last image.
    :param first: first place of the stretch.
    :param distances: shape (l, k), float32, NaN where there was no place yet.
    :param path: position in the window, place; shape (m, 2).
    """

    image: int
    newest: int
    first: int
    distances: np.ndarray
    path: np.ndarray


@dataclass(frozen=True)
class ReducedDistances:
    """
    Distances of all images to all places; each cell is the smallest distance of a block.

    :param values: shape (rows, columns), float32; NaN where there was nothing to compare with.
    :param block: images a row, places a column.
    """

    values: np.ndarray
    block: tuple[int, int]


@dataclass(frozen=True)
class TraverseResults:
    """
    The matches of the N images of a traverse.

    :param sequence: places of the windows, each for its middle image; the first and last images
        take places from the paths of the outermost windows.
    :param single: places of each image alone.
    :param seconds: to match each image, features excluded, shape (N,).
    :param windows: distances of up to :data:`WINDOWS` windows.
    :param distances: distances of all images.
    :param accepted: whether the recognizer accepts the window's match, shape (N,), bool.
    :param probabilities: declared for them, shape (N,); NaN = not declared.
    :param published: M >= N matches: the early ones behind these, and the image of each, (M,).
    :param online: images at which the recognizer had a match at once, as a node has, ascending.
    """

    sequence: Ranking
    single: Ranking
    seconds: np.ndarray
    windows: tuple[WindowDistances, ...] = field(repr=False)
    distances: ReducedDistances = field(repr=False)
    accepted: np.ndarray = field(repr=False)
    probabilities: np.ndarray = field(repr=False)
    published: tuple[ImageMatches, np.ndarray] = field(repr=False)
    online: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class Evaluation:
    """
    Metrics of a traverse; without ground truth, only its results are meaningful.

    :param sequence_length: images in a window, l.
    :param sequence_without_ends, single_without_ends: the same on the images in :attr:`centered`.
    :param unknown: results of a traverse of places that are not in the map, if there was one.
    """

    results: TraverseResults
    ground_truth: GroundTruth
    sequence_length: int
    sequence: Metrics
    sequence_without_ends: Metrics
    single: Metrics
    single_without_ends: Metrics
    unknown: TraverseResults | None = None

    @property
    def centered(self) -> slice:
        """Return the images that have a window centered on them."""
        return centered_images(len(self.results.single), self.sequence_length)

    @cached_property
    def correct(self) -> np.ndarray:
        """Return which matches of the windows are correct, shape (N,), bool."""
        return self.ground_truth.accepts(self.results.sequence.best)

    @cached_property
    def best_accepted(self) -> np.ndarray:
        """Return the matches of the windows below the threshold of the best F1, (N,), bool."""
        return self.results.sequence.scores < self.sequence.best.threshold

    @property
    def false_alarm_rates(self) -> dict[str, float]:
        """
        Return the share of unknown images that are accepted; empty without any.

        By ``sequence`` and ``single``, at the threshold of the best F1 of each.
        """
        if self.unknown is None:
            return {}
        sequence = self.unknown.sequence.scores < self.sequence.best.threshold
        single = self.unknown.single.scores < self.single.best.threshold
        return {'sequence': float(np.mean(sequence)), 'single': float(np.mean(single))}

    @property
    def distances(self) -> dict[str, np.ndarray]:
        """Return the distances of the windows' matches, by group."""
        scores = self.results.sequence.scores
        stated = self.ground_truth.is_stated
        groups = {'correct': scores[self.correct], 'wrong': scores[~self.correct & stated]}
        if not stated.all():
            groups['without truth'] = scores[~stated]
        if not self.ground_truth.kind:
            groups = {'match': scores}
        if self.unknown is not None:
            groups['unknown places'] = self.unknown.sequence.scores
        return groups

    @cached_property
    def calibration(self) -> Calibration | None:
        """Return the calibration of the declared probabilities; None without any or the truth."""
        if not self.ground_truth.kind:
            return None
        matches, images = self.results.published
        truth = self.ground_truth.select(images)
        columns = matches.probabilities, truth.accepts(matches.places), truth.has_match
        return calibrate(*(column[truth.is_stated] for column in columns))


def centered_images(count: int, length: int) -> slice:
    """
    Return the images that have a window centered on them: all but the first and last l / 2.

    :param count: number of images N.
    :param length: images in a window, l.
    :raises InputError: there is not even one window.
    """
    if count < length:
        raise InputError(f'{count} query images: expected at least l = {length}, one window')
    middle = (length - 1) // 2
    return slice(middle, count - (length - 1 - middle))


def recognize_all(
    recognizer: PlaceRecognizer, features: LocalFeatures, stamps: np.ndarray | None = None
) -> list[Match]:
    """
    Recognize every image of a sequence, starting with an empty window.

    :param features: features of N images.
    :param stamps: stamps of the images, ns, (N,), int64, 0 = unknown; None = all are.
    :returns: N matches, one an image.
    """
    recognizer.reset()
    times = [0] * len(features) if stamps is None else stamps.tolist()
    return [recognizer.update(features[i : i + 1], time) for i, time in enumerate(times)]


def recognize_traverse(
    online: PlaceRecognizer | LoopCloser,
    features: LocalFeatures,
    places: int,
    settings: RecognizerSettings,
    shown: Collection[int] = (),
    progress: str = '',
    odometry: np.ndarray | None = None,
    late: bool = False,
    stamps: np.ndarray | None = None,
) -> TraverseResults:
    """
    Match every image of a traverse.

    :param online: with an empty window.
    :param features: features of N images.
    :param places: largest number of places n that a row of distances may have.
    :param settings: the settings of ``online``.
    :param shown: images whose windows' distances are kept in any case.
    :param progress: label of the progress bar; none without.
    :param odometry: poses of the images, (N, 7), NaN = unknown; None = of all.
    :param late: late matches count for the images that had none.
    :param stamps: stamps of the images, ns, (N,), int64, 0 = unknown; None = all are.
    """
    count, ranks = len(features), max(RANKS)
    length = settings.sequence.length
    middle = (length - 1) // 2
    single = Ranking(np.full((count, ranks), -1, np.int64), np.full(count, np.inf))
    candidates = np.full((count, ranks), -1, np.int64)
    matches: list[Match] = []
    seconds = np.empty(count)
    rows: deque[np.ndarray] = deque(maxlen=length)
    reduced = _BlockMinimum(count, places)
    windows: list[WindowDistances] = []
    interval = -(-count // WINDOWS)
    for i in Progress(range(count), desc=progress, unit='image', disable=not progress):
        began = time.perf_counter()
        pose = None if odometry is None or np.isnan(odometry[i]).any() else odometry[i]
        stamp = 0 if stamps is None else int(stamps[i])
        match = online.update(features[i : i + 1], stamp, pose)
        seconds[i] = time.perf_counter() - began
        matches.append(match)
        row = np.array(online.newest_row())  # a copy: the recognizer overwrites it
        rows.append(row)
        reduced.add(i, row)
        nearest = smallest_indices(row, ranks)
        if len(nearest):
            single.places[i, : len(nearest)], single.scores[i] = nearest, row[nearest[0]]
        if match.path.place >= 0 and is_full(match, length):
            image = i - (length - 1) + middle
            places_of_window = np.asarray(online.candidates(ranks)[0])
            candidates[image, : len(places_of_window)] = places_of_window
            if i % interval == 0 or image in shown:
                windows.append(_window_distances(image, i, length, rows, match.path.pairs))
    matched, published = image_matches(matches, length, late), published_matches(matches, length)
    ranked = np.stack([_rank(*pair) for pair in zip(matched.places, candidates, strict=True)])
    sequence, distances = Ranking(ranked, matched.distances), (tuple(windows), reduced.result())
    return TraverseResults(
        sequence, single, seconds, *distances, matched.accepted, matched.probabilities, published,
        np.flatnonzero([match.accepted for match in matches]),
    )  # fmt: skip


def evaluate_on_map(
    place_map: Map,
    query: LocalFeatures,
    ground_truth: GroundTruth,
    settings: RecognizerSettings,
    unknown: LocalFeatures | None = None,
    shown: Collection[int] = (),
    backend: str = 'cpu',
    precision: str = 'auto',
    progress: bool = False,
    odometry: np.ndarray | None = None,
    stamps: np.ndarray | None = None,
) -> Evaluation:
    """
    Recognize a traverse on a map and compute its metrics.

    :param query: features of N images.
    :param ground_truth: accepted places of the same images.
    :param settings: settings of the recognizer; only the accepted matches depend on its threshold.
    :param unknown: features of a traverse through places that are not in the map.
    :param shown: images whose windows' distances are kept in any case.
    :param backend, precision: see :class:`stavpr_ros.method.PlaceRecognizer`.
    :param odometry: poses of the query's images, (N, 7), compared with the poses of the places.
    :param stamps: stamps of the query's images, ns, (N,), int64, 0 = unknown; None = all are.
    :raises InputError: fewer images than one window, or ground truth of another length.
    """

    def results(
        features: LocalFeatures,
        label: str,
        poses: np.ndarray | None = None,
        stamps: np.ndarray | None = None,
    ) -> TraverseResults:
        # a new recognizer for each: mode robust keeps statistics of the images so far
        one = PlaceRecognizer(place_map, settings, backend, precision)
        bar = label if progress else ''
        return recognize_traverse(
            one, features, len(place_map), settings, shown, bar, poses, stamps=stamps
        )

    centered_images(len(query), settings.sequence.length)
    recorded = results(query, 'recognizing', odometry, stamps)
    elsewhere = None if unknown is None else results(unknown, 'false alarms')
    return evaluate_traverse(recorded, ground_truth, settings.sequence.length, elsewhere)


def evaluate_loop_closures(
    query: LocalFeatures,
    ground_truth: GroundTruth,
    settings: RecognizerSettings,
    exclude_places: int,
    shown: Collection[int] = (),
    progress: bool = False,
    odometry: np.ndarray | None = None,
    late: bool = False,
    precision: str = 'auto',
    stamps: np.ndarray | None = None,
) -> Evaluation:
    """
    Recognize a traverse on its own past and compute its metrics.

    :param ground_truth: the earlier images that are correct for each image.
    :param exclude_places: the latest images that are not part of the map.
    :param late: late matches count for the images that had none.
    :param precision: see :class:`stavpr_ros.method.loop_closer.LoopCloser`.

    The others are as in :func:`evaluate_on_map`.
    """
    centered_images(len(query), settings.sequence.length)
    closer = LoopCloser(settings, exclude_places, query.settings, precision=precision)
    label = 'closing loops' if progress else ''
    results = recognize_traverse(
        closer, query, len(query), settings, shown, label, odometry, late, stamps
    )
    return evaluate_traverse(results, ground_truth, settings.sequence.length)


def evaluate_traverse(
    results: TraverseResults,
    ground_truth: GroundTruth,
    length: int,
    unknown: TraverseResults | None = None,
) -> Evaluation:
    """
    Compute the metrics of a traverse, with and without its first and last images.

    :param ground_truth: accepted places of the same N images.
    :param length: images in a window, l.
    :raises InputError: fewer images than one window, or ground truth of another length.
    """
    count = len(results.single)
    if count != ground_truth.N:
        raise InputError(
            f'ground truth of {ground_truth.N} images for {count} images: expected a row each'
        )
    sequence, sequence_inner, single, single_inner = (
        evaluate_ranking(ranking, ground_truth, images)
        for ranking in (results.sequence, results.single)
        for images in (slice(None), centered_images(count, length))
    )
    metrics = sequence, sequence_inner, single, single_inner
    return Evaluation(results, ground_truth, length, *metrics, unknown)


def _rank(place: int, candidates: np.ndarray) -> np.ndarray:
    """Return the matched place followed by the other candidates, shape (K,); -1 = no further."""
    others = candidates[(candidates != place) & (candidates >= 0)]
    ranked = np.full(len(candidates), -1, np.int64)
    ranked[0] = place
    ranked[1 : 1 + len(others)] = others[: len(candidates) - 1]
    return ranked


def _window_distances(
    image: int, newest: int, length: int, rows: Sequence[np.ndarray], path: np.ndarray
) -> WindowDistances:
    """Cut a window's rows of distances to the surroundings of its path."""
    low, high = int(path[:, 1].min()), int(path[:, 1].max())
    first = max(0, low - MARGIN)
    width = high + MARGIN + 1 - first
    distances = np.full((length, width), np.nan, np.float32)
    for line, row in zip(distances[length - len(rows) :], rows, strict=True):
        part = row[first : first + width]
        line[: len(part)] = part
    distances[~np.isfinite(distances)] = np.nan
    width = int(np.argwhere(np.isfinite(distances))[:, 1].max()) + 1  # the map may end before
    return WindowDistances(image, newest, first, distances[:, :width], path)


class _BlockMinimum:
    """Reduces rows of distances to the smallest one of each block."""

    def __init__(self, count: int, places: int) -> None:
        self._block = (-(-count // MATRIX_SIDE), -(-max(1, places) // MATRIX_SIDE))
        self._columns = np.arange(0, max(1, places), self._block[1])
        shape = -(-count // self._block[0]), len(self._columns)
        self._values = np.full(shape, np.inf, np.float32)

    def add(self, image: int, row: np.ndarray) -> None:
        if not len(row):
            return
        columns = self._columns[: np.searchsorted(self._columns, len(row))]
        line = self._values[image // self._block[0], : len(columns)]
        np.minimum(line, np.fmin.reduceat(row, columns), out=line)

    def result(self) -> ReducedDistances:
        values = np.where(np.isfinite(self._values), self._values, np.nan).astype(np.float32)
        return ReducedDistances(values, self._block)
