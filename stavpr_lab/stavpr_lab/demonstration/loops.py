# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result of a loop-closure demonstration, and its plot: the traverse against its own past."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import SubFigure
import numpy as np
from stavpr_lab.evaluation import plots
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.plots import MatchPair, Outcome
from stavpr_lab.evaluation.records import IN_WINDOW
from stavpr_lab.style import legend_above, show_distances, titled_page
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import Map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.palette import QUIET
from stavpr_ros.prepare.centering import evenly

MAX_PAIRS = 8  # pairs of images
MAX_IMAGES = 4000  # images of a traverse whose distances are drawn


@dataclass(frozen=True)
class LoopResult:
    """
    The loop closures of N images, in numbers of images.

    :param closures: (query, place) of each, shape (C, 2).
    :param amounts: probability of each, in mode paper its distance, shape (C,).
    :param pairs: (later, earlier) images aligned by a closure, each once, shape (M, 2).
    :param ground_truth: None = unknown.
    :param exclude: latest places that an image was not compared with.
    :param skipped: images too similar to the last keyframe.
    :param quantity: what ``amounts`` are, 'probability' or 'distance'.
    """

    N: int
    closures: np.ndarray
    amounts: np.ndarray
    pairs: np.ndarray
    ground_truth: GroundTruth | None
    exclude: int
    skipped: int
    quantity: str

    def are_correct(self, pairs: np.ndarray) -> np.ndarray | None:
        """Return which pairs of images (M, 2) are correct, shape (M,), bool; None = unknown."""
        if self.ground_truth is None:
            return None
        return np.isin(pairs[:, 0] * self.N + pairs[:, 1], self.ground_truth.keys)

    def summary(self) -> str:
        """Return the result in words, a line each."""
        C = len(self.closures)
        line = f'{C} loop closures in {self.N} images ({self.skipped} too similar to the last)'
        right = self.are_correct(self.closures)
        if self.ground_truth is None or right is None:
            return line
        correct = np.count_nonzero(right)
        precision = f', precision {correct / C:.3f}' if C else ''
        revisited = self.ground_truth.has_match
        correct_pairs = self.pairs[self.are_correct(self.pairs)]
        images = len(np.unique(correct_pairs[:, 0]))
        recall = f', recall {images / revisited.sum():.3f}' if revisited.any() else ''
        return (
            f'{line}\n'
            f'{correct} of {C} loop closures are correct{precision}\n'
            f'{images} of {np.count_nonzero(revisited)} images of places passed before are in a '
            f'correct pair{recall}'
        )


def read_result(
    matches: list[dict[str, Any]],
    closures: list[dict[str, Any]],
    ground_truth: GroundTruth | None,
    exclude: int,
) -> LoopResult:
    """
    Combine the recorded matches and loop closures of a traverse.

    :param matches: one an image, of the command ``record``; their status decides which images
        are places.
    :param closures: records of ``record --loop-closures``.
    """
    in_window = [i for i, match in enumerate(matches) if match['status'] in IN_WINDOW]
    images = np.array(in_window, np.int64)
    is_paper = closures and closures[0]['probability'] is None
    quantity = 'distance' if is_paper else 'probability'
    ends = [[closure['query_index'], closure['place_index']] for closure in closures]
    pairs = [
        [pair['query_index'], pair['place_index']]
        for closure in closures
        for pair in closure['pairs']
    ]
    return LoopResult(
        len(matches),
        images[np.array(ends, np.int64).reshape(-1, 2)],
        np.array([closure[quantity] for closure in closures], float),
        images[np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)],
        ground_truth,
        exclude,
        sum(match['status'] == 'SKIPPED' for match in matches),
        quantity,
    )


def choose_closures(count: int, correct: np.ndarray | None) -> list[int]:
    """
    Choose closures to show: up to a quarter wrong ones, the others evenly over the traverse.

    :param correct: shape (count,), bool; None = unknown.
    """
    good = np.arange(count) if correct is None else np.flatnonzero(correct)
    bad = np.setdiff1d(np.arange(count), good)
    selection: set[int] = set()
    max_bad = MAX_PAIRS // 4 if len(good) else MAX_PAIRS
    for indices, limit in ((bad, max_bad), (good, MAX_PAIRS)):
        room = min(limit, MAX_PAIRS - len(selection))
        selection |= set(indices[evenly(len(indices), room)].tolist())
    return sorted(selection)


def _pairs(result: LoopResult, place_map: Map) -> list[MatchPair]:
    correct = result.are_correct(result.closures)
    pairs: list[MatchPair] = []
    for i in choose_closures(len(result.closures), correct):
        outcome: Outcome = 'match' if correct is None else 'right' if correct[i] else 'wrong'
        query, place = map(int, result.closures[i])
        image = place_map.thumbnail(query)
        if image is None:
            raise InputError('the map of the traverse has no thumbnails')
        caption = f'image {query}: place {place}, {result.quantity} {result.amounts[i]:.2f}'
        pairs.append(MatchPair(image, place_map.thumbnail(place), caption, outcome))
    return pairs


def _compared_distances(result: LoopResult, place_map: Map) -> np.ndarray | None:
    """Return the distances of every image to those it is compared with, NaN elsewhere, (N, N)."""
    if result.N > MAX_IMAGES:
        return None
    recognizer = PlaceRecognizer(place_map, RecognizerSettings(mode='paper'))
    index = np.arange(result.N)
    compared = index[:, None] - index >= result.exclude
    return np.where(compared, recognizer.distances(place_map.features), np.nan)


def _draw_traverse(
    figure: SubFigure, axes: Axes, result: LoopResult, distances: np.ndarray | None
) -> None:
    """Draw the compared pairs, the ground truth, and the aligned pairs."""
    N = result.N
    if distances is not None:
        show_distances(figure, axes, distances, aspect='auto')
    if result.ground_truth is not None:
        later, earlier = result.ground_truth.pairs.T
        axes.plot(earlier, later, 'o', color=plots.TRUTH, ms=5, mew=0, label='passed before')
    correct = result.are_correct(result.pairs)
    if correct is None:
        masks = {'match': np.ones(len(result.pairs), bool)}
    else:
        masks = {'right': correct, 'wrong': ~correct}
    for outcome, mask in masks.items():
        if mask.any():
            later, earlier = result.pairs[mask].T
            label = plots.MARKS[outcome]['label'].replace('match', 'aligned')
            mark = plots.MARKS[outcome] | {'label': label}
            axes.plot(earlier, later, ls='none', mew=0, **mark)
    note = 'not compared:\nlater, or too recent'
    axes.text(N * 0.97, N * 0.04, note, ha='right', va='top', color=QUIET)
    axes.set(xlabel='place: earlier image (number)', ylabel=plots.QUERY)
    axes.set(xlim=(-0.5, N - 0.5), ylim=(N - 0.5, -0.5))
    legend_above(axes, 3)


def draw_loops(result: LoopResult, place_map: Map, title: str, folder: Path) -> Path:
    """
    Draw the page ``loop.png``: closures, and the traverse against its own past.

    :param place_map: a map of all images, with thumbnails.
    :returns: its path.
    """
    path = folder / 'loop.png'
    pairs = 'Pairs: query image on the left, its place (an earlier image) on the right'
    with titled_page(path, 12.5, 5.9, title, f'{result.summary()}\n{pairs}') as figure:
        halves: Any = figure.subfigures(1, 2, width_ratios=(1.1, 1))
        left, right = halves
        plots.draw_pairs(left, _pairs(result, place_map), 2)
        distances = _compared_distances(result, place_map)
        _draw_traverse(right, right.add_subplot(), result, distances)
    return path
