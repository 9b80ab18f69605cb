# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Plots of results in the common style (:mod:`stavpr_lab.style`).

Each function takes plain arrays and the path of the PNG file to write.
Map indices run along x and query indices along y, as in the paper's matrices.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
import numpy as np
from stavpr_lab.evaluation.calibration import Calibration
from stavpr_lab.evaluation.metrics import Metrics
from stavpr_lab.style import DASHES, legend_above, page, show_distances, SMALL
from stavpr_ros import palette

Outcome = Literal['right', 'wrong', 'match', 'no match', 'unseen']
Box = tuple[float, float, float, float]
"""Left, top, width and height of a plot's axes as fractions of its image."""

MARKS: dict[str, dict[str, Any]] = {  # of an outcome: eyes that see no colors have its shape
    'right': {'color': palette.BLUE, 'marker': 'o', 'ms': 3, 'label': 'match, correct'},
    'wrong': {'color': palette.VERMILION, 'marker': 'X', 'ms': 6, 'label': 'match, wrong'},
    'match': {'color': palette.SKY, 'marker': 'o', 'ms': 3, 'label': 'match'},
    'no match': {'color': palette.ORANGE, 'marker': 'v', 'ms': 5, 'label': 'no match'},
    'unseen': {'color': palette.GRAY, 'marker': 's', 'ms': 3, 'label': 'no match, correctly'},
}
COLORS: dict[str, str] = {outcome: mark['color'] for outcome, mark in MARKS.items()}
MATCHED = ('right', 'wrong', 'match')  # outcomes with a place
TRUTH = palette.YELLOW
PLACE, QUERY = 'place in the map (number)', 'query image (number)'  # labels of axes
BINS = 40  # bars of a histogram


@dataclass(frozen=True)
class MatchPair:
    """
    A query image and the place that it was matched with.

    :param query: RGB, shape (h, w, 3), uint8.
    :param place: the matched place's image, or None without a match.
    :param caption: a line below, such as index and probability.
    :param outcome: 'right' or 'wrong' for a match, 'match' without ground truth; 'no match' for a
        place that was missed; 'unseen' for a query that has no place in the map and was rejected.
    """

    query: np.ndarray
    place: np.ndarray | None
    caption: str
    outcome: Outcome


def outcomes(
    accepted: np.ndarray, correct: np.ndarray | None, in_map: np.ndarray | None
) -> np.ndarray:
    """
    Return the :data:`Outcome` of each image, shape (N,), str.

    :param accepted: the image is matched, shape (N,), bool.
    :param correct: the match is right, shape (N,), bool; None = unknown.
    :param in_map: the map has its place, shape (N,), bool; None = unknown.
    """
    if correct is None or in_map is None:
        return np.where(accepted, 'match', 'no match')
    verdicts = np.where(correct, 'right', 'wrong')
    return np.where(accepted, verdicts, np.where(in_map, 'no match', 'unseen'))


def reduced_matrix(
    path: Path,
    distances: np.ndarray,
    shape: tuple[int, int],
    truth: np.ndarray | None,
    matches: Mapping[str, np.ndarray],
) -> Box:
    """
    Draw the distances of a traverse of any length, reduced to blocks.

    :param distances: shape (rows, columns); NaN where there is none.
    :param shape: queries N and places n.
    :param truth: whether a block has a true place, shape as ``distances``; None = unknown.
    :param matches: (query, place) of accepted matches, shape (count, 2), by outcome.
    :returns: where the axes are.
    """
    with page(path, 5.2, float(np.clip(5.2 * shape[0] / shape[1], 3.5, 7))) as figure:
        axes = figure.add_subplot()
        draw_matrix(figure, axes, distances, shape, truth, 'true place', matches)
    position = axes.get_position()  # final since the page is written
    return position.x0, 1 - position.y1, position.width, position.height


def precision_recall(path: Path, curves: Mapping[str, tuple[str, Metrics]]) -> None:
    """
    Draw precision over recall, and a ring where F1 is best.

    :param curves: color and metrics, by name.
    """
    with page(path, 5.2, 4.8) as figure:
        axes = figure.add_subplot()
        for name, (color, metrics) in curves.items():
            _, precision, recall = metrics.curve.T
            best = metrics.best.recall, metrics.best.precision
            axes.plot(recall, precision, color=color, label=name, clip_on=False, zorder=3)
            ring: dict[str, Any] = {'ms': 8, 'mfc': 'white', 'mec': color, 'mew': 1.8, 'zorder': 4}
            axes.plot(*best, 'o', clip_on=False, **ring)
        axes.set(xlabel='recall (share of the images)', ylabel='precision (share of the matches)')
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect='equal')
        if curves:
            axes.legend(loc='lower left')


def match_histogram(
    path: Path,
    groups: Mapping[str, tuple[str, np.ndarray]],
    limit: float | None,
    quantity: str,
) -> None:
    """
    Draw the distribution of the distances, or probabilities, of correct, wrong and other matches.

    :param groups: color and values of each group, by name; infinite ones are left out.
    :param limit: beyond which a window is matched, drawn as a line; None = none.
    :param quantity: name of the values; the axis of a probability is 0 to 1.
    """
    finite = {name: values[np.isfinite(values)] for name, (_, values) in groups.items()}
    everything = np.concatenate([*finite.values(), np.array([] if limit is None else [limit])])
    low, high = (everything.min(), everything.max()) if everything.size else (0.0, 1.0)
    low, high = (0.0, 1.0) if quantity == 'probability' else (low, max(high, low + 1e-6))
    with page(path, 5.2, 4.8) as figure:
        axes = figure.add_subplot()
        axes.hist(
            list(finite.values()),
            bins=list(np.linspace(low, high, BINS + 1)),
            color=[color for color, _ in groups.values()],
            label=list(finite),
            stacked=True,
            rwidth=0.9,
        )
        if limit is not None:
            axes.axvline(limit, color=palette.INK, lw=1.3, ls=DASHES, label=f'limit {limit:.3g}')
        margin = 0.02 * (high - low)
        axes.set(xlabel=f'{quantity} of the match', ylabel='images (number)')
        axes.set_xlim(low - margin, high + margin)
        axes.locator_params(axis='y', integer=True)
        legend_above(axes, 3)


def warping_path(path: Path, distances: np.ndarray, pairs: np.ndarray, first: int = 0) -> None:
    """
    Draw the distances between a query window and a stretch of the map, and the warping path.

    :param distances: shape (l, k): images of the window by places of the stretch.
    :param pairs: (query, place) along the path, counted within the matrix, shape (m, 2).
    :param first: map index of the stretch's first place.
    """
    l, k = distances.shape
    with page(path, 7.0, float(np.clip(1.4 + 5.3 * l / k, 2.6, 7))) as figure:
        axes = figure.add_subplot()
        extent = (first - 0.5, first + k - 0.5, l - 0.5, -0.5)
        show_distances(figure, axes, distances, extent=extent, aspect='auto')
        axes.plot(pairs[:, 1] + first, pairs[:, 0], 'o-', ms=4, label='warping path')
        legend_above(axes, 1)
        axes.set(xlabel=PLACE, ylabel='image of the window (number)')
        axes.locator_params(integer=True)


def drive(
    path: Path,
    truth: np.ndarray,
    places: int,
    matched: np.ndarray,
    outcomes: np.ndarray,
    unseen: np.ndarray,
) -> None:
    """
    Draw the matched and the true places of a query, and the images without a match.

    :param truth: correct (query, place), shape (M, 2).
    :param places: number of places n.
    :param matched: place of each query, shape (N,).
    :param outcomes: an :data:`Outcome` for each query, shape (N,).
    :param unseen: whether the map lacks its place and those around, shape (N,), bool.
    """
    index = np.arange(len(matched))
    with page(path, 5.2, 5.2) as figure:
        axes = figure.add_subplot()
        if len(truth):
            axes.plot(*truth.T, '.', color=TRUTH, ms=8, mew=0, label='true place')
        shade_runs(axes, unseen, 'unseen')
        rejected = -0.04 * places  # below the axis of the places
        for outcome, mark in MARKS.items():
            at = index[outcomes == outcome]
            if len(at):
                height = matched[at] if outcome in MATCHED else np.full(len(at), rejected)
                axes.plot(at, height, ls='none', mew=0, **mark)
        axes.set(xlabel=QUERY, ylabel=PLACE, xlim=(-1, len(index)))
        legend_above(axes, 2)


def reliability(path: Path, calibration: Calibration) -> None:
    """Draw the share of correct matches over their declared probability, and their numbers."""
    has_images = calibration.images > 0
    with page(path, 5.2, 5.6) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        above.plot([0, 1], [0, 1], color=palette.QUIET, lw=1.2, ls=DASHES, label='as declared')
        points = calibration.declared[has_images], calibration.right[has_images]
        label = f'expected error {calibration.expected_error:.3f}'
        above.plot(*points, '-o', color=palette.BLUE, ms=6, clip_on=False, label=label)
        above.set(ylabel='share of correct matches', xlim=(0, 1), ylim=(0, 1))
        legend_above(above, 2)
        width = 1 / len(has_images)
        starts = np.arange(len(has_images)) * width
        below.bar(starts, calibration.images, 0.9 * width, align='edge', color=palette.SKY)
        below.set(xlabel='declared probability', ylabel='images (number)')
        below.locator_params(axis='y', integer=True, nbins=4)


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the runs of True as (first, one past the last)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def shade_runs(axes: Axes, mask: np.ndarray, label: str) -> None:
    """Shade the images where a mask is true, over the whole height."""
    for number, (first, end) in enumerate(runs(mask)):
        name = '' if number else label
        axes.axvspan(first - 0.5, end - 0.5, color=palette.SHADE, lw=0, zorder=0, label=name)


def draw_pairs(figure: Figure | SubFigure, pairs: Sequence[MatchPair], columns: int) -> None:
    """Draw the pairs on a grid, with a legend of the colors above."""
    if not pairs:
        figure.text(0.5, 0.5, 'no images to show', ha='center', va='center', color=palette.QUIET)
        return
    grid = figure.subplots(-(-len(pairs) // columns), columns, squeeze=False)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        _draw_pair(axes, pair)
    for axes in grid.flat:
        axes.set_axis_off()
    present = [outcome for outcome in COLORS if any(pair.outcome == outcome for pair in pairs)]
    keys = [Line2D([], [], color=COLORS[outcome], lw=3) for outcome in present]
    names = [MARKS[outcome]['label'] for outcome in present]
    figure.suptitle(' ', fontsize=SMALL)  # room for the legend, which must not widen the grid
    legend = figure.legend(
        keys, names, loc='upper left', ncols=4, handlelength=1.2, borderaxespad=0.3
    )
    legend.set_in_layout(False)


def _draw_pair(axes: Axes, pair: MatchPair) -> None:
    """Draw a query with its place on the right, and the frame."""
    height, width = pair.query.shape[:2]
    start = width * 1.03  # left edge of the place
    axes.imshow(pair.query, extent=(0, width, height, 0), interpolation='lanczos')
    if pair.place is None:
        axes.add_patch(Rectangle((start, 0), width, height, fc=palette.SHADE, ec='none'))
        middle = (start + width / 2, height / 2)
        axes.text(*middle, 'no place', ha='center', va='center', color=palette.QUIET)
    else:
        axes.imshow(pair.place, extent=(start, start + width, height, 0), interpolation='lanczos')
    frame: dict[str, Any] = {'ec': COLORS[pair.outcome], 'lw': 2.6, 'clip_on': False}
    frame['ls'] = '--' if pair.outcome == 'wrong' else '-'
    axes.add_patch(Rectangle((0, 0), start + width, height, fill=False, **frame))
    axes.set_title(pair.caption, fontsize=SMALL, y=-0.03, va='top', pad=0, loc='center')
    axes.set(xlim=(0, start + width), ylim=(height, 0), aspect='equal')


def draw_matrix(
    figure: Figure | SubFigure,
    axes: Axes,
    distances: np.ndarray,
    shape: tuple[int, ...],
    truth: np.ndarray | None,
    label: str,
    matches: Mapping[str, np.ndarray],
) -> None:
    """
    Draw a matrix of distances with the true places and the matches.

    :param distances: distance of each cell; a cell may be a block of several queries and places.
    :param shape: queries N and places n.
    :param truth: whether a cell has a true place, bool; None = unknown.
    :param label: name of the true places in the legend.
    :param matches: (query, place), shape (count, 2), by outcome.
    """
    extent = (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)
    show_distances(figure, axes, distances, aspect='auto', extent=extent)
    if truth is not None:
        cells = np.zeros((*truth.shape, 4), np.uint8)
        cells[truth] = [*palette.rgb(TRUTH), 190]
        axes.imshow(cells, aspect='auto', extent=extent, interpolation='nearest')
        axes.plot([], [], 's', color=TRUTH, ms=4, label=label)
    for outcome, pairs in matches.items():
        if len(pairs):
            axes.plot(pairs[:, 1], pairs[:, 0], ls='none', mew=0, **MARKS[outcome])
    axes.set(xlabel=PLACE, ylabel=QUERY, xlim=extent[:2], ylim=extent[2:])
    legend_above(axes, 3)
