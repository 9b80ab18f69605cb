"""
Pictures of results, made with matplotlib without a screen and without the global state of pyplot.

Each takes plain arrays and the path of the picture to write, and returns that path.
Map indices run along x and query indices along y, as in the paper's matrices.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from stavpr_ros.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.legend import Legend

Outcome = Literal['right', 'wrong', 'match', 'no match', 'unseen']

INK, QUIET, GRID, PAPER = '#24272c', '#6b7078', '#dcdcd8', '#ffffff'
COLORS: dict[str, str] = {
    'right': '#2e8b57',
    'wrong': '#c8402f',
    'match': '#2f7fb8',
    'no match': '#d99a1c',
    'unseen': '#8a8f98',
}
BRIGHT = {'right': '#35d07f', 'wrong': '#ff5440', 'match': '#4fb3ff'}  # the same on the dark of a matrix
MEANING: dict[str, str] = {
    'right': 'match, right', 'wrong': 'match, wrong', 'match': 'match', 'no match': 'no match',
    'unseen': 'no match, rightly',
}  # fmt: skip
TRUTH, THRESHOLD = '#f0c419', '#3b6ea5'
SCALE = 'bone'  # one scale of grays for every distance, dark is near: colors are for outcomes
DPI = 150


@dataclass(frozen=True)
class MatchPair:
    """
    A query and what it was matched with.

    :param query: RGB, shape (h, w, 3), uint8.
    :param place: the matched place's image, or None without a match.
    :param caption: a line below, such as index and distance.
    :param outcome: 'right' or 'wrong' for a match, 'match' if the truth is unknown; 'no match' for a place
        that was missed; 'unseen' for a query that has no place in the map and got none.
    """

    query: np.ndarray
    place: np.ndarray | None
    caption: str
    outcome: Outcome

    def __post_init__(self) -> None:
        if self.outcome not in COLORS:
            raise InputError(f'outcome is {self.outcome!r}; expected one of {", ".join(COLORS)}')


def match_overview(path: Path, pairs: Sequence[MatchPair], columns: int = 3) -> Path:
    """Draw queries beside the places that they were matched with; the frame's color is the outcome."""
    rows = max(1, -(-len(pairs) // columns))
    with page(path, 10, 0.5 + 1.42 * rows) as figure:
        draw_pairs(figure, pairs, columns)
    return path


def distance_matrix(
    path: Path, distances: np.ndarray, matched: np.ndarray, truth: np.ndarray | None, tolerance: int = 3,
) -> Path:  # fmt: skip
    """
    Draw the distance of every query to every place, with the true and the matched places.

    :param distances: shape (queries, places).
    :param matched: matched place of each query, -1 where there is none, shape (queries,).
    :param truth: true place of each query, -1 where the map has none, shape (queries,); None = unknown.
    :param tolerance: places that a right match may be off.
    """
    distances, matched, truth = _check_matrix(distances, matched, truth)
    queries, places = distances.shape
    with page(path, 7.5, float(np.clip(7.5 * queries / places, 4, 9))) as figure:
        _draw_matrix(figure, figure.add_subplot(), distances, matched, truth, tolerance)
    return path


def distance_over_time(
    path: Path, distances: np.ndarray, threshold: float, outcomes: Sequence[Outcome], unseen: np.ndarray,
) -> Path:  # fmt: skip
    """
    Draw the distance of each query's best answer, the threshold and what came of it.

    :param distances: shape (queries,); nan where there was no answer.
    :param threshold: answers below it are matches; nan for none.
    :param outcomes: one for each query.
    :param unseen: whether the map lacks the query's place, shape (queries,), bool.
    """
    with page(path, 10, 3.3) as figure:
        _draw_time(figure.add_subplot(), distances, threshold, outcomes, unseen)
    return path


def precision_recall(
    path: Path, curves: dict[str, tuple[np.ndarray, np.ndarray]], point: tuple[float, float] | None = None,
) -> Path:  # fmt: skip
    """
    Draw precision over recall.

    :param curves: (recall, precision), each of shape (thresholds,), by name.
    :param point: recall and precision at the threshold that was used.
    """
    shades = ('#1f3a5f', '#d99a1c', '#2e8b57', '#c8402f', '#8a8f98', '#7b5aa6')
    with page(path, 5.2, 4.8) as figure:
        axes = figure.add_subplot()
        for k, (name, (recall, precision)) in enumerate(curves.items()):
            shade = shades[k % len(shades)]
            axes.plot(recall, precision, color=shade, lw=1.8, label=name, clip_on=False, zorder=3)
        if point is not None:
            style: dict[str, Any] = {'ms': 8, 'mfc': PAPER, 'mec': INK, 'mew': 1.6, 'zorder': 4}
            axes.plot(*point, 'o', label='threshold used', clip_on=False, **style)
        axes.set(xlabel='recall', ylabel='precision', xlim=(0, 1), ylim=(0, 1.0), aspect='equal')
        axes.grid(color=GRID, lw=0.7)
        if curves or point is not None:
            axes.legend(loc='lower left')
    return path


def warping_path(path: Path, distances: np.ndarray, pairs: np.ndarray, first: int = 0) -> Path:
    """
    Draw the distances of one window of queries to a stretch of the map, and the path of the alignment.

    :param distances: shape (l, k): images of the window by places of the stretch.
    :param pairs: (query, place) along the path, counted within the matrix, shape (steps, 2); may be empty.
    :param first: map index of the stretch's first place.
    """
    distances = np.asarray(distances, float)
    if distances.ndim != 2 or 0 in distances.shape:
        raise InputError(f'distances of the window have shape {distances.shape}; expected (l, k), neither 0')
    pairs = np.asarray(pairs, int).reshape(-1, 2)
    l, k = distances.shape
    with page(path, 7.0, float(np.clip(1.4 + 5.3 * l / k, 2.6, 7))) as figure:
        axes = figure.add_subplot()
        extent = (first - 0.5, first + k - 0.5, l - 0.5, -0.5)
        picture = axes.imshow(distances, cmap=SCALE, extent=extent, aspect='auto')
        if len(pairs):
            axes.plot(pairs[:, 1] + first, pairs[:, 0], '-o', color=BRIGHT['right'], mec=INK, mew=0.5,
                      ms=4, lw=1.6, label='warping path')  # fmt: skip
            legend_above(axes, 1)
        axes.set(xlabel='place in the map', ylabel='image of the window')
        axes.locator_params(integer=True)
        color_bar(figure, picture, axes)
    return path


def demo_sheet(
    path: Path,
    pairs: Sequence[MatchPair],
    distances: np.ndarray,
    matched: np.ndarray,
    truth: np.ndarray | None,
    best: np.ndarray,
    threshold: float,
    outcomes: Sequence[Outcome],
    tolerance: int = 3,
    title: str = '',
    note: str = '',
) -> Path:
    """
    Draw one page of everything: pairs above, the matrix and the distance over time below.

    :param pairs: six are best: they fill the rows of three.
    :param distances: every query to every place, shape (queries, places).
    :param best: distance of each query's best answer, shape (queries,).
    :param title: a line above.
    :param note: a quieter line below it: the numbers.

    The others are as in :func:`distance_matrix` and :func:`distance_over_time`.
    """
    distances, matched, truth = _check_matrix(distances, matched, truth)
    rows = max(1, -(-len(pairs) // 3))
    head = 0.75 if title or note else 0.1
    above, below = 0.5 + 1.52 * rows, 4.2
    with page(path, 11, head + above + below) as figure:
        parts = figure.add_gridspec(3, 2, height_ratios=(head, above, below), width_ratios=(1, 1.18))
        top = figure.add_subfigure(parts[0, :])
        top.text(0.012, 0.66, title, fontsize=15, weight='bold', va='center', color=INK)
        top.text(0.012, 0.2, note, fontsize=10.5, va='center', color=QUIET)
        draw_pairs(figure.add_subfigure(parts[1, :]), pairs, 3)
        left = figure.add_subfigure(parts[2, 0])
        _draw_matrix(left, left.add_subplot(), distances, matched, truth, tolerance)
        unseen = np.zeros(len(matched), bool) if truth is None else truth < 0
        _draw_time(figure.add_subfigure(parts[2, 1]).add_subplot(), best, threshold, outcomes, unseen)
    return path


@contextmanager
def page(path: Path, width: float, height: float) -> Iterator['Figure']:
    """Give an empty figure (inches) in our typography, and write it."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    look: dict[Any, Any] = {
        'font.size': 10.5, 'font.family': 'DejaVu Sans', 'text.color': INK, 'axes.labelcolor': INK,
        'axes.edgecolor': QUIET, 'axes.linewidth': 0.8, 'axes.spines.top': False, 'axes.spines.right': False,
        'axes.axisbelow': True, 'xtick.color': QUIET, 'ytick.color': QUIET, 'legend.frameon': False,
        'legend.fontsize': 9.5, 'xtick.labelsize': 9.5, 'ytick.labelsize': 9.5, 'figure.facecolor': PAPER,
    }  # fmt: skip
    with rc_context(look):
        figure = Figure(figsize=(width, height), dpi=DPI, layout='constrained')
        yield figure
        FigureCanvasAgg(figure).print_png(path)


def draw_pairs(figure: 'Figure | SubFigure', pairs: Sequence[MatchPair], columns: int) -> None:
    """Draw the pairs on a grid, with the meaning of the colors above."""
    from matplotlib.lines import Line2D

    if not pairs:
        figure.text(0.5, 0.5, 'no images to show', ha='center', va='center', color=QUIET)
        return
    grid = figure.subplots(-(-len(pairs) // columns), columns, squeeze=False)
    for axes, pair in zip(grid.flat, pairs, strict=False):
        _draw_pair(axes, pair)
    for axes in grid.flat:
        axes.set_axis_off()
    shown = [outcome for outcome in COLORS if any(pair.outcome == outcome for pair in pairs)]
    keys = [Line2D([], [], color=COLORS[outcome], lw=3) for outcome in shown]
    names = [MEANING[outcome] for outcome in shown]
    figure.suptitle(' ', fontsize=10)  # keeps room for the legend, which must not widen the grid
    legend = figure.legend(keys, names, loc='upper left', ncols=4, handlelength=1.2, borderaxespad=0.3)
    legend.set_in_layout(False)


def _draw_pair(axes: 'Axes', pair: MatchPair) -> None:
    """Draw a query, its place right of it, and the frame."""
    from matplotlib.patches import Rectangle

    height, width = pair.query.shape[:2]
    start = width * 1.03  # of the place
    axes.imshow(pair.query, extent=(0, width, height, 0), interpolation='lanczos')
    if pair.place is None:
        axes.add_patch(Rectangle((start, 0), width, height, fc='#efefeb', ec='none'))
        middle = (start + width / 2, height / 2)
        axes.text(*middle, 'no place', ha='center', va='center', color=QUIET, fontsize=9.5)
    else:
        axes.imshow(pair.place, extent=(start, start + width, height, 0), interpolation='lanczos')
    frame: dict[str, Any] = {'fill': False, 'ec': COLORS[pair.outcome], 'lw': 2.6, 'clip_on': False}
    axes.add_patch(Rectangle((0, 0), start + width, height, **frame))
    axes.set_title(pair.caption, fontsize=9.5, color=INK, y=-0.03, va='top', pad=0)
    axes.set(xlim=(0, start + width), ylim=(height, 0), aspect='equal')


def _draw_matrix(
    figure: 'Figure | SubFigure', axes: 'Axes', distances: np.ndarray, matched: np.ndarray,
    truth: np.ndarray | None, tolerance: int,
) -> None:  # fmt: skip
    """Draw the matrix of distances with the corridor of right answers and the matches."""
    queries, places = distances.shape
    finite = distances[np.isfinite(distances)]
    low, high = np.quantile(finite, [0.002, 0.995]) if finite.size else (0.0, 1.0)
    picture = axes.imshow(distances, cmap=SCALE, vmin=low, vmax=max(high, low + 1e-6), aspect='auto')
    _draw_matches(axes, matched, truth, tolerance)
    if truth is not None:
        _draw_unseen(axes, truth < 0, places)
    axes.set(xlabel='place in the map', ylabel='query image')
    axes.set(xlim=(-0.5, places - 0.5), ylim=(queries - 0.5, -0.5))
    color_bar(figure, picture, axes)
    for handle in legend_above(axes, 3).get_lines():
        handle.set(linewidth=1.8, markersize=9)


def _draw_matches(axes: 'Axes', matched: np.ndarray, truth: np.ndarray | None, tolerance: int) -> None:
    """Draw the corridor of right answers, if it is known, and the matches by outcome."""
    index = np.arange(len(matched))
    accepted = matched >= 0
    masks = {'match': accepted}
    if truth is not None:
        line = np.where(truth >= 0, truth, np.nan).astype(float)
        line[1:][np.abs(np.diff(line)) > max(10, 3 * tolerance)] = np.nan  # a jump is no path
        for offset, label in ((-tolerance, f'true place ± {tolerance}'), (tolerance, '')):
            axes.plot(line + offset, index, color=TRUTH, lw=0.9, label=label)
        right = accepted & (truth >= 0) & (np.abs(matched - truth) <= tolerance)
        masks = {'right': right, 'wrong': accepted & ~right}
    for outcome, mask in masks.items():
        if mask.any():
            style: dict[str, Any] = {'color': BRIGHT[outcome], 'ms': 5, 'mew': 0, 'label': MEANING[outcome]}
            axes.plot(matched[mask], index[mask], '.', **style)


def _draw_unseen(axes: 'Axes', unseen: np.ndarray, places: int) -> None:
    """Shade the queries that have no place in the map."""
    for start, stop in _runs(unseen):
        axes.axhspan(start - 0.5, stop - 0.5, color=PAPER, alpha=0.32, lw=0)
        if stop - start > len(unseen) / 25:
            middle = (start + stop - 1) / 2
            axes.text(places * 0.02, middle, 'not in the map', va='center', color=INK, fontsize=9.5)


def _draw_time(
    axes: 'Axes', distances: np.ndarray, threshold: float, outcomes: Sequence[Outcome], unseen: np.ndarray
) -> None:
    """Draw distances as dots in the color of the outcome."""
    distances, unseen = np.asarray(distances, float), np.asarray(unseen, bool)
    if not distances.shape == unseen.shape == (len(outcomes),):
        raise InputError(f'distances {distances.shape}, unseen {unseen.shape}, {len(outcomes)} outcomes; '
                         'expected one of each for every query')  # fmt: skip
    index = np.arange(len(distances))
    kinds = np.array(outcomes, dtype=object)
    axes.plot(index, distances, color=GRID, lw=1.0, zorder=1)
    for outcome, color in COLORS.items():
        mask = kinds == outcome
        if mask.any():
            style: dict[str, Any] = {'color': color, 'ms': 6, 'mew': 0, 'label': MEANING[outcome]}
            axes.plot(index[mask], distances[mask], '.', zorder=2, **style)
    if np.isfinite(threshold):
        name = f'threshold {threshold:.3g}'
        axes.axhline(threshold, color=THRESHOLD, lw=1.3, ls=(0, (5, 3)), label=name, zorder=1.5)
    for number, (start, stop) in enumerate(_runs(unseen)):
        name = '' if number else 'not in the map'
        axes.axvspan(start - 0.5, stop - 0.5, color='#e9e9e4', lw=0, zorder=0, label=name)
    axes.set(xlabel='query image', ylabel='distance of the best answer', xlim=(-1, max(1, len(distances))))
    axes.grid(axis='y', color=GRID, lw=0.7)
    legend_above(axes, 3)


def legend_above(axes: 'Axes', columns: int) -> 'Legend':
    """Put the legend above the axes, where it hides nothing and does not widen the layout."""
    handles, labels = axes.get_legend_handles_labels()
    legend = axes.legend(handles, labels, loc='lower left', bbox_to_anchor=(0, 1.0), borderaxespad=0.2,
                         ncols=columns, handlelength=1.2, columnspacing=1.2, handletextpad=0.4)  # fmt: skip
    legend.set_in_layout(False)
    lines = -(-len(legend.get_texts()) // columns)
    axes.set_title('\n'.join(' ' * lines), fontsize=10.5)  # keeps room for it
    return legend


def color_bar(figure: 'Figure | SubFigure', picture: object, axes: 'Axes') -> None:
    bar = figure.colorbar(picture, ax=axes, fraction=0.04, pad=0.015, aspect=32)  # type: ignore[arg-type]
    bar.outline.set_visible(False)
    bar.set_label('distance')


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """List the runs of True as (first, one past the last)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _check_matrix(
    distances: np.ndarray, matched: np.ndarray, truth: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Check that the arrays belong together."""
    distances, matched = np.asarray(distances, float), np.asarray(matched, int)
    truth = None if truth is None else np.asarray(truth, int)
    if distances.ndim != 2 or 0 in distances.shape:
        raise InputError(f'distances have shape {distances.shape}; expected (queries, places), neither 0')
    if matched.shape != distances.shape[:1] or (truth is not None and truth.shape != matched.shape):
        shape = None if truth is None else truth.shape
        raise InputError(
            f'distances {distances.shape}, matched {matched.shape}, truth {shape}; expected one matched '
            'and one true place for each query'
        )
    return distances, matched, truth
