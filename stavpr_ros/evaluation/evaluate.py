"""
One evaluation: a drive answered image by image, as the node does it, and judged.

Each image gets two answers: the nearest place to it alone, and the place that the window around it was
matched with. Only one row of distances exists at a time, so that length is limited by time, not memory.
"""

import time
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from tqdm import tqdm

from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.curves import (
    RANKS,
    Metrics,
    Ranking,
    evaluate_ranking,
    false_alarm_rate,
    nearest_places,
)
from stavpr_ros.evaluation.ground_truth import GroundTruth
from stavpr_ros.evaluation.metrics import WindowAnswer, frame_answers
from stavpr_ros.evaluation.offline import window_answers
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping import PlaceMap
from stavpr_ros.recognition import Match, PlaceRecognizer, RecognizerSettings

MARGIN = 8  # places shown beside the path of a window
MATRIX_SIDE = 900  # cells along a side of the picture of all distances
WINDOWS = 1500  # windows whose distances are kept, spread over the drive


class Online(Protocol):
    """What answers image by image: a recognizer on a map, or a loop closer."""

    def update(self, features: LocalFeatures) -> Match:
        """Take in the next image and answer for the window that ends with it."""

    def newest_row(self) -> np.ndarray:
        """Scores of the newest image against every place there is, shape (n,), small is near."""

    def candidates(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return up to ``count`` distinct places of the last window, nearest first, and distances."""


@dataclass(frozen=True)
class WindowView:
    """
    The distances of one window to the stretch of the map that it was matched with.

    :param image: the window's middle image: the query that the window answers for.
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
class DistancePicture:
    """
    Distances of all images to all places, reduced: each cell is the smallest of a block.

    :param values: shape (rows, columns), float32; NaN where there was nothing to compare with.
    :param block: images a row, places a column.
    """

    values: np.ndarray
    block: tuple[int, int]


@dataclass(frozen=True)
class TraverseResults:
    """
    All answers to the N images of a drive.

    :param sequence: from the windows, each for its middle image; the ends from the outermost windows' paths.
    :param single: from each image alone.
    :param seconds: to answer each image, features excluded, shape (N,).
    """

    sequence: Ranking
    single: Ranking
    seconds: np.ndarray
    views: tuple[WindowView, ...] = field(repr=False)
    picture: DistancePicture = field(repr=False)


@dataclass(frozen=True)
class Evaluation:
    """
    The judged answers to one drive.

    :param centered: the images that have a window centered on them: without the first and last l / 2.
    :param unknown: answers to a drive through places that are not in the map, if there was one.
    """

    answers: TraverseResults
    truth: GroundTruth
    length: int
    sequence: Metrics
    sequence_without_ends: Metrics
    single: Metrics
    single_without_ends: Metrics
    unknown: TraverseResults | None = None

    @property
    def centered(self) -> slice:
        """The images that have a window centered on them."""
        return centered_images(len(self.answers.single), self.length)

    def false_alarms(self, kind: str, threshold: float | None = None) -> float | None:
        """
        Share of unknown images that are accepted; None without any.

        :param kind: ``sequence`` or ``single``.
        :param threshold: the one of the best F1 if not given.
        """
        if self.unknown is None:
            return None
        judged: Metrics = getattr(self, kind)
        scores = getattr(self.unknown, kind).scores
        return false_alarm_rate(scores, judged.best.threshold if threshold is None else threshold)


def centered_images(count: int, length: int) -> slice:
    """
    Return the images that have a window centered on them, all but the first and last l / 2 (section 6).

    :param count: number of images N.
    :param length: images in a window, l.
    :raises InputError: there is not even one window.
    """
    if count < length:
        raise InputError(f'{count} query images: expected at least l = {length}, one window')
    middle = (length - 1) // 2
    return slice(middle, count - (length - 1 - middle))


def recognize_traverse(
    online: Online,
    features: LocalFeatures,
    places: int,
    settings: RecognizerSettings,
    shown: Collection[int] = (),
    progress: str = '',
) -> TraverseResults:
    """
    Answer every image of a drive.

    :param online: with an empty window.
    :param features: of N images.
    :param places: number of places n that the rows of distances may reach.
    :param settings: those of ``online``.
    :param shown: images around which the window's distances are kept, besides those that are anyway.
    :param progress: words at the progress bar; none without.
    """
    count, ranks = len(features), max(RANKS)
    length = settings.sequence.length
    middle = (length - 1) // 2
    single = _empty_ranking(count, ranks)
    listed = np.full((count, ranks), -1, np.int64)
    windows: list[WindowAnswer | None] = []
    seconds = np.empty(count)
    rows: deque[np.ndarray] = deque(maxlen=length)
    picture = _PictureBuilder(count, places)
    views: list[WindowView] = []
    every = -(-count // WINDOWS)
    for i in tqdm(range(count), desc=progress, unit='image', disable=None if progress else True):
        began = time.perf_counter()
        match = online.update(features[i : i + 1])
        seconds[i] = time.perf_counter() - began
        row = np.array(online.newest_row())  # it may be written over
        rows.append(row)
        picture.add(i, row)
        nearest = nearest_places(row, ranks)
        if len(nearest):
            single.places[i, : len(nearest)], single.scores[i] = nearest, row[nearest[0]]
        windows += window_answers([match])
        if match.sequence is not None:
            candidates = np.asarray(online.candidates(ranks)[0])
            listed[i - (length - 1) + middle, : len(candidates)] = candidates
            if i % every == 0 or i - (length - 1) + middle in shown:
                views.append(_view(i, middle, length, rows, match.path))
    answers = frame_answers(windows, length)
    ranked = np.stack([_ranked(*pair) for pair in zip(answers.places, listed, strict=True)])
    return TraverseResults(Ranking(ranked, answers.distances), single, seconds, tuple(views), picture.finished())


def evaluate_on_map(
    place_map: PlaceMap,
    query: LocalFeatures,
    truth: GroundTruth,
    settings: RecognizerSettings,
    unknown: LocalFeatures | None = None,
    shown: Collection[int] = (),
    backend: str = 'cpu',
    precision: str = 'float32',
    progress: bool = False,
) -> Evaluation:
    """
    Recognize a drive on a map and judge it.

    :param query: features of N images.
    :param truth: of the same images.
    :param settings: of the recognizer; all answers are judged, whatever its threshold says of them.
    :param unknown: features of a drive through places that are not in the map.
    :param shown: images around which the window's distances are kept, besides those that are anyway.
    :param backend, precision: see :class:`stavpr_ros.recognition.PlaceRecognizer`.
    """

    def answers(features: LocalFeatures, name: str) -> TraverseResults:
        # each drive meets a recognizer that has seen nothing before
        recognizer = PlaceRecognizer(place_map, settings, backend, precision)
        words = name if progress else ''
        return recognize_traverse(recognizer, features, len(place_map), settings, shown, words)

    centered_images(len(query), settings.sequence.length)
    known = answers(query, 'recognizing')
    strangers = None if unknown is None else answers(unknown, 'false alarms')
    return evaluate_answers(known, truth, settings.sequence.length, strangers)


def evaluate_loop_closures(
    query: LocalFeatures,
    truth: GroundTruth,
    settings: RecognizerSettings,
    exclude: int,
    shown: Collection[int] = (),
    progress: bool = False,
) -> Evaluation:
    """
    Recognize a drive on its own past and judge it.

    :param truth: of the same images: earlier images that count as right.
    :param exclude: the latest images that are not part of the map.

    The others are as in :func:`evaluate_on_map`.
    """
    from stavpr_ros.recognition.loop_closer import LoopCloser

    centered_images(len(query), settings.sequence.length)
    closer = LoopCloser(settings, exclude, query.settings)
    words = 'closing loops' if progress else ''
    answers = recognize_traverse(closer, query, len(query), settings, shown, words)
    return evaluate_answers(answers, truth, settings.sequence.length)


def evaluate_answers(
    answers: TraverseResults, truth: GroundTruth, length: int, unknown: TraverseResults | None = None
) -> Evaluation:
    """
    Judge the answers to a drive, with and without its ends.

    :param truth: of the same N images.
    :param length: images in a window, l.
    :raises InputError: fewer images than one window, or a truth of another length.
    """
    if len(truth.has_match) != len(answers.single):
        raise InputError(f'the truth is that of {len(truth.has_match)} images: {len(answers.single)} came')
    centered = centered_images(len(answers.single), length)
    return Evaluation(
        answers,
        truth,
        length,
        sequence=evaluate_ranking(answers.sequence, truth),
        sequence_without_ends=evaluate_ranking(answers.sequence, truth, centered),
        single=evaluate_ranking(answers.single, truth),
        single_without_ends=evaluate_ranking(answers.single, truth, centered),
        unknown=unknown,
    )


def _empty_ranking(count: int, ranks: int) -> Ranking:
    return Ranking(np.full((count, ranks), -1, np.int64), np.full(count, np.inf))


def _ranked(answer: int, candidates: np.ndarray) -> np.ndarray:
    """Put the answer first, whatever the candidates say, and the others behind it."""
    others = candidates[(candidates != answer) & (candidates >= 0)]
    ranked = np.full(len(candidates), -1, np.int64)
    ranked[0] = answer
    ranked[1 : 1 + len(others)] = others[: len(candidates) - 1]
    return ranked


def _view(newest: int, middle: int, length: int, rows: Sequence[np.ndarray], path: np.ndarray) -> WindowView:
    """Cut a window's distances to the surroundings of its path."""
    low, high = int(path[:, 1].min()), int(path[:, 1].max())
    first = max(0, low - MARGIN)
    width = high + MARGIN + 1 - first
    distances = np.full((length, width), np.nan, np.float32)
    for line, row in zip(distances[length - len(rows) :], rows, strict=True):
        part = row[first : first + width]
        line[: len(part)] = part
    distances[~np.isfinite(distances)] = np.nan
    width = int(np.argwhere(np.isfinite(distances))[:, 1].max()) + 1  # the map may end before
    return WindowView(newest - (length - 1) + middle, newest, first, distances[:, :width], path)


class _PictureBuilder:
    """Takes rows of distances and keeps the smallest of each block."""

    def __init__(self, count: int, places: int) -> None:
        self._block = (-(-count // MATRIX_SIDE), -(-max(1, places) // MATRIX_SIDE))
        self._columns = np.arange(0, max(1, places), self._block[1])
        self._values = np.full((-(-count // self._block[0]), len(self._columns)), np.inf, np.float32)

    def add(self, image: int, row: np.ndarray) -> None:
        if not len(row):
            return
        columns = self._columns[: np.searchsorted(self._columns, len(row))]
        line = self._values[image // self._block[0], : len(columns)]
        np.minimum(line, np.fmin.reduceat(row, columns), out=line)

    def finished(self) -> DistancePicture:
        values = np.where(np.isfinite(self._values), self._values, np.nan).astype(np.float32)
        return DistancePicture(values, self._block)
