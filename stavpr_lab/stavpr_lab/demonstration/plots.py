# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a localization demonstration: images, places, and probabilities over time."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import SubFigure
import numpy as np
from stavpr_lab.evaluation import plots
from stavpr_lab.evaluation.plots import MARKS, MatchPair, Outcome
from stavpr_lab.evaluation.records import TraverseEvaluation
from stavpr_lab.style import DASHES, legend_above, titled_page
from stavpr_ros.errors import InputError
from stavpr_ros.mapping import Map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.palette import GRID, INK, PAPER

MAX_PAIRS = 6  # pairs of images: two rows of three


def draw_result(
    result: TraverseEvaluation,
    query: Map,
    place_map: Map,
    threshold: float,
    title: str,
    path: Path,
) -> None:
    """
    Draw the page of a result.

    :param query: a map of the query, with thumbnails.
    """
    recognizer = PlaceRecognizer(place_map, RecognizerSettings(mode='paper'))
    outcomes = outcomes_of(result)
    pairs = [_pair(result, i, outcomes[i], query, place_map) for i in choose_images(outcomes)]
    demo_sheet(path, pairs, recognizer.distances(query.features), result, threshold, title)


def outcomes_of(result: TraverseEvaluation) -> np.ndarray:
    """Return the :data:`stavpr_lab.evaluation.plots.Outcome` of each image, shape (N,), str."""
    in_map = None if result.true_places is None else result.true_places >= 0
    return plots.outcomes(result.accepted, result.correct, in_map)


def choose_images(outcomes: np.ndarray) -> list[int]:
    """Choose one image of each outcome, and others of the most frequent, far from each other."""
    kinds, counts = np.unique(outcomes, return_counts=True)
    groups = [np.flatnonzero(outcomes == kind) for kind in kinds]
    selection = [int(same[len(same) // 2]) for same in groups]
    common = groups[counts.argmax()]
    while len(selection) < min(MAX_PAIRS, len(outcomes)):
        others = np.array([0, len(outcomes), *selection])
        gaps = np.abs(common[:, None] - others).min(axis=1)
        selection.append(int(common[gaps.argmax()]))
    return sorted(set(selection))[:MAX_PAIRS]


def _pair(
    result: TraverseEvaluation, image: int, outcome: Outcome, query: Map, place_map: Map
) -> MatchPair:
    left = query.thumbnail(image)
    if left is None:
        raise InputError('the map of the query has no thumbnails')
    place, amount = int(result.matched[image]), result.amount(result.matches.distances[image])
    match = f'place {place}' if place >= 0 else 'no match'
    text = f'{match}, {result.quantity} {amount:.2f}' if np.isfinite(amount) else 'no window'
    right = place_map.thumbnail(place) if place >= 0 else None
    return MatchPair(left, right, f'image {image}: {text}', outcome)


def demo_sheet(
    path: Path,
    pairs: Sequence[MatchPair],
    distances: np.ndarray,
    result: TraverseEvaluation,
    threshold: float,
    title: str,
) -> None:
    """
    Draw one page: pairs above, the matrix and the probability over time below.

    :param distances: every query to every place, shape (N, n).
    """
    above, below = 0.5 + 1.55 * max(1, -(-len(pairs) // 3)), 4.2
    timeless = replace(result, seconds=result.seconds[:0])  # times are of one machine
    summary = f'{timeless.summary()}\nPairs: query image on the left, matched place on the right'
    with titled_page(path, 11, above + below, title, summary) as figure:
        rows: Any = figure.subfigures(2, 1, height_ratios=(above, below))
        top, bottom = rows
        left, right = bottom.subfigures(1, 2, width_ratios=(1, 1.18))
        plots.draw_pairs(top, pairs, 3)
        _draw_matrix(left, distances, result)
        _draw_time(right.add_subplot(), result, threshold)


def _draw_matrix(figure: SubFigure, distances: np.ndarray, result: TraverseEvaluation) -> None:
    """Draw a matrix with a row a query and a column a place, the true and the matched places."""
    axes, truth, correct = figure.add_subplot(), result.true_places, result.correct
    pairs = np.stack([np.arange(len(distances)), result.matched], axis=1)
    if truth is None or correct is None:
        matches = {'match': pairs[result.accepted]}
        plots.draw_matrix(figure, axes, distances, distances.shape, None, '', matches)
        return
    away = np.abs(np.arange(distances.shape[1]) - truth[:, None])
    cells = (truth >= 0)[:, None] & (away <= result.tolerance)
    matches = {'right': pairs[correct], 'wrong': pairs[result.accepted & ~correct]}
    label = f'true place ± {result.tolerance}'
    plots.draw_matrix(figure, axes, distances, distances.shape, cells, label, matches)
    for start, stop in plots.runs(truth < 0):
        axes.axhspan(start - 0.5, stop - 0.5, color=PAPER, alpha=0.5, lw=0)
        if stop - start > len(truth) / 25:
            at = distances.shape[1] * 0.02, (start + stop - 1) / 2
            axes.text(*at, 'not in the map', va='center', color=INK)


def _draw_time(axes: Axes, result: TraverseEvaluation, threshold: float) -> None:
    """Draw the probability, or distance, of each query's best match as a mark of its outcome."""
    amounts, kinds = result.amount(result.matches.distances), outcomes_of(result)
    index = np.arange(len(amounts))
    axes.plot(index, amounts, color=GRID, lw=1.0, zorder=1)
    for outcome, mark in MARKS.items():
        mask = kinds == outcome
        if mask.any():
            axes.plot(index[mask], amounts[mask], ls='none', mew=0, zorder=2, **mark)
    limit = float(result.amount(threshold))
    axes.axhline(limit, color=INK, lw=1.3, ls=DASHES, label=f'limit {limit:.3g}', zorder=1.5)
    truth = np.zeros(len(index)) if result.true_places is None else result.true_places
    plots.shade_runs(axes, truth < 0, 'not in the map')
    axes.set(xlabel=plots.QUERY, ylabel=f'{result.quantity} of the best match')
    axes.set_xlim(-1, max(1, len(amounts)))
    legend_above(axes, 3)
