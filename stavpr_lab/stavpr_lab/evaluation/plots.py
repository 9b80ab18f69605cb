# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Plots of results, drawn by matplotlib without a screen and without the global state of pyplot.

Each function takes plain arrays and the path of the PNG file to write.
Map indices run along x and query indices along y, as in the paper's matrices.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import io
from pathlib import Path
from typing import Any, Literal

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
import numpy as np
from stavpr_lab.evaluation.calibration import Calibration
from stavpr_lab.evaluation.metrics import Metrics
from stavpr_ros.output_file import PNG, write_output

Outcome = Literal['right', 'wrong', 'match', 'no match', 'unseen']
Box = tuple[float, float, float, float]
"""Left, top, width and height of a plot's axes as fractions of its image."""

INK, QUIET, GRID, PAPER = '#24272c', '#6b7078', '#dcdcd8', '#ffffff'
COLORS: dict[str, str] = {
    'right': '#2e8b57',
    'wrong': '#c8402f',
    'match': '#2f7fb8',
    'no match': '#d99a1c',
    'unseen': '#8a8f98',
}
BRIGHT = {'right': '#35d07f', 'wrong': '#ff5440', 'match': '#4fb3ff'}  # on the dark of a matrix
MEANING: dict[str, str] = {
    'right': 'match, correct', 'wrong': 'match, wrong', 'match': 'match', 'no match': 'no match',
    'unseen': 'no match, correctly',
}  # fmt: skip
TRUTH, THRESHOLD = '#f0c419', '#3b6ea5'
SEQUENCE, SEQUENCE_INNER, SINGLE, UNKNOWN = '#2358a5', '#7fa8dc', '#8a94a6', '#d99a1c'
SCALE = 'bone'  # grays for distances, dark is near: colors are for outcomes
AXES: dict[str, Any] = {
    'labelcolor': INK,
    'edgecolor': QUIET,
    'linewidth': 0.8,
    'spines.top': False,
    'spines.right': False,
    'axisbelow': True,
}
DPI = 150
BINS = 40  # bars of a histogram


@dataclass(frozen=True)
class MatchPair:
    """
    A query image and the place that it was matched with.

    :param query: RGB, shape (h, w, 3), uint8.
    :param place: the matched place's image, or None without a match.
    :param caption: a line below, such as index and distance.
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
            axes.plot(recall, precision, color=color, lw=1.8, label=name, clip_on=False, zorder=3)
            ring: dict[str, Any] = {'ms': 8, 'mfc': PAPER, 'mec': color, 'mew': 1.8, 'zorder': 4}
            axes.plot(*best, 'o', clip_on=False, **ring)
        axes.set(xlabel='recall', ylabel='precision', xlim=(0, 1), ylim=(0, 1.0), aspect='equal')
        axes.grid(color=GRID, lw=0.7)
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
            axes.axvline(limit, color=INK, lw=1.3, ls=(0, (5, 3)), label=f'limit {limit:.3g}')
        margin = 0.02 * (high - low)
        axes.set(
            xlabel=f'{quantity} of the match', ylabel='images', xlim=(low - margin, high + margin)
        )
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
        style: dict[str, Any] = {'color': BRIGHT['right'], 'mec': INK, 'mew': 0.5, 'ms': 4}
        axes.plot(pairs[:, 1] + first, pairs[:, 0], '-o', label='warping path', lw=1.6, **style)
        legend_above(axes, 1)
        axes.set(xlabel='place in the map', ylabel='image of the window')
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
            axes.plot(*truth.T, '.', color=TRUTH, ms=3, mew=0, label='true place')
        shade_runs(axes, unseen, 'unseen')
        rejected = -0.04 * places  # below the axis of the places
        for outcome, color in COLORS.items():
            at = index[outcomes == outcome]
            if len(at):
                height = matched[at] if outcome in BRIGHT else np.full(len(at), rejected)
                marker = '.' if outcome in BRIGHT else '|'
                style: dict[str, Any] = {'color': color, 'ms': 5, 'label': MEANING[outcome]}
                axes.plot(at, height, marker, **style)
        axes.set(xlabel='query image', ylabel='place in the map', xlim=(-1, len(index)))
        axes.grid(color=GRID, lw=0.7)
        legend_above(axes, 3)


def reliability(path: Path, calibration: Calibration) -> None:
    """Draw the share of correct matches over their declared probability, and their numbers."""
    has_images = calibration.images > 0
    with page(path, 5.2, 5.6) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        above.plot([0, 1], [0, 1], color=QUIET, lw=1.2, ls=(0, (5, 3)), label='as declared')
        points = calibration.declared[has_images], calibration.right[has_images]
        label = f'expected error {calibration.expected_error:.3f}'
        above.plot(*points, '-o', color=SEQUENCE, lw=1.8, ms=6, clip_on=False, label=label)
        above.set(ylabel='share of correct matches', xlim=(0, 1), ylim=(0, 1))
        above.grid(color=GRID, lw=0.7)
        legend_above(above, 2)
        width = 1 / len(has_images)
        starts = np.arange(len(has_images)) * width
        below.bar(starts, calibration.images, 0.9 * width, align='edge', color=SEQUENCE_INNER)
        below.set(xlabel='declared probability', ylabel='images')
        below.locator_params(axis='y', integer=True, nbins=4)


@contextmanager
def page(path: Path, width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure (width and height in inches) in the common style, then write it."""
    look: dict[Any, Any] = {
        'font.size': 11.5,
        'font.family': 'DejaVu Sans',
        'text.color': INK,
        'figure.facecolor': PAPER,
        'legend.frameon': False,
        'legend.fontsize': 10.5,
    }
    look |= {f'axes.{name}': value for name, value in AXES.items()}
    for side in ('xtick', 'ytick'):
        look |= {f'{side}.color': QUIET, f'{side}.labelsize': 10.5}
    with rc_context(look):
        figure = Figure(figsize=(width, height), dpi=DPI, layout='constrained')
        yield figure
        content = io.BytesIO()
        FigureCanvasAgg(figure).print_png(content)
        write_output(path, content.getvalue(), PNG, force=True)


@contextmanager
def titled_page(
    path: Path, width: float, height: float, title: str, text: str
) -> Iterator[SubFigure]:
    """Yield the part of a page below its title and a text, ``height`` inches high."""
    head = 0.5 + 0.17 * len(text.splitlines())
    with page(path, width, head + height) as figure:
        parts: Any = figure.subfigures(2, 1, height_ratios=(head, height))
        top, below = parts
        top.text(0.012, 0.96, title, fontsize=15, weight='bold', va='top', color=INK)
        top.text(0.012, 0.06, text, fontsize=10.5, va='bottom', color=QUIET)
        yield below


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the runs of True as (first, one past the last)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def shade_runs(axes: Axes, mask: np.ndarray, label: str) -> None:
    """Shade the images where a mask is true, over the whole height."""
    for number, (first, end) in enumerate(runs(mask)):
        name = '' if number else label
        axes.axvspan(first - 0.5, end - 0.5, color='#e9e9e4', lw=0, zorder=0, label=name)


def draw_pairs(figure: Figure | SubFigure, pairs: Sequence[MatchPair], columns: int) -> None:
    """Draw the pairs on a grid, with a legend of the colors above."""
    if not pairs:
        figure.text(0.5, 0.5, 'no images to show', ha='center', va='center', color=QUIET)
        return
    grid = figure.subplots(-(-len(pairs) // columns), columns, squeeze=False)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        _draw_pair(axes, pair)
    for axes in grid.flat:
        axes.set_axis_off()
    present = [outcome for outcome in COLORS if any(pair.outcome == outcome for pair in pairs)]
    keys = [Line2D([], [], color=COLORS[outcome], lw=3) for outcome in present]
    names = [MEANING[outcome] for outcome in present]
    figure.suptitle(' ', fontsize=10)  # keeps room for the legend, which must not widen the grid
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
        axes.add_patch(Rectangle((start, 0), width, height, fc='#efefeb', ec='none'))
        middle = (start + width / 2, height / 2)
        axes.text(*middle, 'no place', ha='center', va='center', color=QUIET, fontsize=9.5)
    else:
        axes.imshow(pair.place, extent=(start, start + width, height, 0), interpolation='lanczos')
    frame: dict[str, Any] = {'ec': COLORS[pair.outcome], 'lw': 2.6, 'clip_on': False}
    axes.add_patch(Rectangle((0, 0), start + width, height, fill=False, **frame))
    axes.set_title(pair.caption, fontsize=9.5, color=INK, y=-0.03, va='top', pad=0)
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
        cells[truth] = [int(TRUTH[i : i + 2], 16) for i in (1, 3, 5)] + [110]
        axes.imshow(cells, aspect='auto', extent=extent, interpolation='nearest')
        axes.plot([], [], 's', color=TRUTH, ms=4, label=label)
    for outcome, pairs in matches.items():
        if len(pairs):
            style: dict[str, Any] = {'color': BRIGHT[outcome], 'label': MEANING[outcome]}
            axes.plot(pairs[:, 1], pairs[:, 0], '.', ms=4, mew=0, **style)
    axes.set(xlabel='place in the map', ylabel='query image', xlim=extent[:2], ylim=extent[2:])
    for handle in legend_above(axes, 3).get_lines():
        handle.set_markersize(9)


def legend_above(axes: Axes, columns: int) -> Legend:
    """Put the legend above the axes, where it covers nothing and does not widen the layout."""
    legend = axes.legend(
        *axes.get_legend_handles_labels(), loc='lower left', bbox_to_anchor=(0, 1.0),
        ncols=columns, borderaxespad=0.2, handlelength=1.2, columnspacing=1.2, handletextpad=0.4,
    )  # fmt: skip
    legend.set_in_layout(False)
    lines = -(-len(legend.get_texts()) // columns)
    axes.set_title('\n'.join(' ' * lines), fontsize=13)  # keeps room for it
    return legend


def show_distances(
    figure: Figure | SubFigure, axes: Axes, distances: np.ndarray, **options: Any
) -> None:
    """
    Draw distances in grays from their 0.2 % to their 99.5 % quantile, with the scale beside them.

    :param distances: shape (rows, columns); others than finite ones are left white.
    :param options: options of :meth:`matplotlib.axes.Axes.imshow`.
    """
    finite = distances[np.isfinite(distances)]
    low, high = np.quantile(finite, [0.002, 0.995]) if finite.size else (0.0, 1.0)
    image = axes.imshow(distances, cmap=SCALE, vmin=low, vmax=max(high, low + 1e-6), **options)
    bar = figure.colorbar(image, ax=axes, fraction=0.04, pad=0.015, aspect=32)
    bar.outline.set_visible(False)
    bar.set_ticks([low, max(high, low + 1e-6)], labels=['near', 'far'])  # may be negative
