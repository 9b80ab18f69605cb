# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The plots of the demonstration: the distances of a traverse, as a matrix and over time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.plots import (
    COLORS,
    draw_matrix,
    draw_pairs,
    GRID,
    INK,
    legend_above,
    MatchPair,
    matrix_page,
    MEANING,
    Outcome,
    page,
    PAPER,
    QUIET,
    THRESHOLD,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


def distance_matrix(
    path: Path,
    distances: np.ndarray,
    matched: np.ndarray,
    truth: np.ndarray | None,
    tolerance: int = 3,
) -> None:
    """
    Draw the distance of every query to every place, with the true and the matched places.

    :param distances: shape (N, n).
    :param matched: matched place of each query, -1 = none, shape (N,).
    :param truth: true place of each query, -1 = not in the map, shape (N,); None = unknown.
    :param tolerance: places that a correct match may be off.
    """
    distances, matched, truth = _checked_matrix(distances, matched, truth)
    with matrix_page(path, distances.shape) as figure:
        _draw_full_matrix(figure, figure.add_subplot(), distances, matched, truth, tolerance)


def distance_over_time(
    path: Path,
    distances: np.ndarray,
    threshold: float,
    outcomes: Sequence[Outcome],
    unseen: np.ndarray,
) -> None:
    """
    Draw the distance of each query's best match, its outcome and the threshold.

    :param distances: shape (N,); NaN where there is none.
    :param threshold: matches are accepted below it; NaN for none.
    :param outcomes: one for each query.
    :param unseen: whether the map lacks the query's place, shape (N,), bool.
    """
    with page(path, 10, 3.3) as figure:
        _draw_time(figure.add_subplot(), distances, threshold, outcomes, unseen)


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
) -> None:
    """
    Draw one page: pairs above, the matrix and the distance over time below.

    :param pairs: six fill two rows of three.
    :param distances: every query to every place, shape (N, n).
    :param best: distance of each query's best match, shape (N,).
    :param title: a line above.
    :param note: a smaller line below it: the numbers.

    The others are as in :func:`distance_matrix` and :func:`distance_over_time`.
    """
    distances, matched, truth = _checked_matrix(distances, matched, truth)
    rows = max(1, -(-len(pairs) // 3))
    head = 0.75 if title or note else 0.1
    above, below = 0.5 + 1.52 * rows, 4.2
    with page(path, 11, head + above + below) as figure:
        parts = figure.add_gridspec(
            3, 2, height_ratios=(head, above, below), width_ratios=(1, 1.18)
        )
        top = figure.add_subfigure(parts[0, :])
        top.text(0.012, 0.66, title, fontsize=15, weight='bold', va='center', color=INK)
        top.text(0.012, 0.2, note, fontsize=10.5, va='center', color=QUIET)
        draw_pairs(figure.add_subfigure(parts[1, :]), pairs, 3)
        left = figure.add_subfigure(parts[2, 0])
        _draw_full_matrix(left, left.add_subplot(), distances, matched, truth, tolerance)
        unseen = np.zeros(len(matched), bool) if truth is None else truth < 0
        _draw_time(
            figure.add_subfigure(parts[2, 1]).add_subplot(), best, threshold, outcomes, unseen
        )


def _draw_full_matrix(
    figure: 'Figure | SubFigure',
    axes: 'Axes',
    distances: np.ndarray,
    matched: np.ndarray,
    truth: np.ndarray | None,
    tolerance: int,
) -> None:
    """Draw a matrix with a row a query and a column a place."""
    pairs = np.stack([np.arange(len(matched)), matched], axis=1)
    accepted = matched >= 0
    if truth is None:
        draw_matrix(figure, axes, distances, distances.shape, None, '', {'match': pairs[accepted]})
        return
    known = (truth >= 0)[:, None]
    cells = known & (np.abs(np.arange(distances.shape[1]) - truth[:, None]) <= tolerance)
    right = accepted & (truth >= 0) & (np.abs(matched - truth) <= tolerance)
    matches = {'right': pairs[right], 'wrong': pairs[accepted & ~right]}
    label = f'true place ± {tolerance}'
    draw_matrix(figure, axes, distances, distances.shape, cells, label, matches)
    _draw_unseen(axes, truth < 0, distances.shape[1])


def _draw_unseen(axes: 'Axes', unseen: np.ndarray, places: int) -> None:
    """Shade the queries that have no place in the map."""
    for start, stop in _runs(unseen):
        axes.axhspan(start - 0.5, stop - 0.5, color=PAPER, alpha=0.32, lw=0)
        if stop - start > len(unseen) / 25:
            middle = (start + stop - 1) / 2
            axes.text(
                places * 0.02, middle, 'not in the map', va='center', color=INK, fontsize=9.5
            )


def _draw_time(
    axes: 'Axes',
    distances: np.ndarray,
    threshold: float,
    outcomes: Sequence[Outcome],
    unseen: np.ndarray,
) -> None:
    """Draw distances over time as dots in the color of the outcome."""
    distances, unseen = np.asarray(distances, float), np.asarray(unseen, bool)
    if not distances.shape == unseen.shape == (len(outcomes),):
        raise InputError(
            f'distances {distances.shape}, unseen {unseen.shape}, {len(outcomes)} outcomes: '
            'expected one of each for every query'
        )
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
    axes.set(
        xlabel='query image',
        ylabel='distance of the best match',
        xlim=(-1, max(1, len(distances))),
    )
    axes.grid(axis='y', color=GRID, lw=0.7)
    legend_above(axes, 3)


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the runs of True as (first, one past the last)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _checked_matrix(
    distances: np.ndarray, matched: np.ndarray, truth: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return the arrays if their shapes agree."""
    distances, matched = np.asarray(distances, float), np.asarray(matched, int)
    truth = None if truth is None else np.asarray(truth, int)
    if distances.ndim != 2 or 0 in distances.shape:
        raise InputError(
            f'distances have shape {distances.shape}: expected (queries, places), not empty'
        )
    if matched.shape != distances.shape[:1] or (
        truth is not None and truth.shape != matched.shape
    ):
        shape = None if truth is None else truth.shape
        raise InputError(
            f'distances {distances.shape}, matched {matched.shape}, truth {shape}: expected one '
            'matched and one true place for each query'
        )
    return distances, matched, truth
