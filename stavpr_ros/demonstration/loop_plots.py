"""The picture of loop closures: the drive against its own past, and pairs of images."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stavpr_ros.commands.loop_demo import LoopResult
from stavpr_ros.errors import InputError
from stavpr_ros.evaluation.plots import (
    BRIGHT,
    INK,
    MEANING,
    QUIET,
    SCALE,
    TRUTH,
    MatchPair,
    Outcome,
    color_bar,
    draw_pairs,
    legend_above,
    page,
)
from stavpr_ros.mapping import PlaceMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

SHOWN = 8  # pairs of images
LARGEST = 4000  # images of a drive whose distances are drawn


def choose_closures(count: int, right: np.ndarray | None, shown: int = SHOWN) -> list[int]:
    """
    Choose closures that are worth seeing: up to a quarter wrong ones, the rest evenly over the drive.

    :param right: shape (count,), bool; None = unknown.
    """
    good = np.arange(count) if right is None else np.flatnonzero(right)
    bad = np.setdiff1d(np.arange(count), good)
    chosen: set[int] = set()
    for indices, most in ((bad, shown if not len(good) else shown // 4), (good, shown)):
        room = min(most, shown - len(chosen), len(indices))
        chosen |= set(indices[np.linspace(0, len(indices) - 1, room).astype(int)].tolist() if room else [])
    return sorted(chosen)


def _outcomes(result: LoopResult) -> list[Outcome]:
    if result.right is None:
        return ['match'] * len(result.closures)
    return ['right' if right else 'wrong' for right in result.right]


def _pairs(result: LoopResult, described: PlaceMap) -> list[MatchPair]:
    outcomes = _outcomes(result)
    pairs: list[MatchPair] = []
    for i in choose_closures(len(result.closures), result.right):
        query, place = map(int, result.closures[i])
        picture = described.thumbnail(query)
        if picture is None:
            raise InputError('the drive was described without thumbnails')
        caption = f'image {query}: image {place}, distance {result.distances[i]:.2f}'
        pairs.append(MatchPair(picture, described.thumbnail(place), caption, outcomes[i]))
    return pairs


def _background(result: LoopResult, described: PlaceMap) -> np.ndarray | None:
    """Distances of every image to those that it is compared with, nan elsewhere, shape (N, N)."""
    from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

    if result.N > LARGEST:
        return None
    distances = PlaceRecognizer(described, RecognizerSettings(threshold=1.0)).distances(described.features)
    index = np.arange(result.N)
    return np.where(index[:, None] - index >= result.exclude, distances, np.nan)


def _draw_drive(figure: 'SubFigure', axes: 'Axes', result: LoopResult, distances: np.ndarray | None) -> None:
    """Draw what was compared, the truth, and what was aligned."""
    N = result.N
    if distances is not None:
        low, high = np.nanquantile(distances, [0.002, 0.995])
        shown = axes.imshow(distances, cmap=SCALE, vmin=low, vmax=max(high, low + 1e-6), aspect='auto')
        color_bar(figure, shown, axes)
    size = float(np.clip(900 / N, 2.5, 5.0))
    dots: dict[str, Any] = {'marker': '.', 'linestyle': 'none', 'mew': 0}
    if result.truth is not None:
        later, earlier = result.truth.pairs.T
        axes.plot(earlier, later, color=TRUTH, ms=size * 2.4, alpha=0.4, label='was there before', **dots)
    right = result.are_right(result.pairs)
    masks = (
        {'match': np.ones(len(result.pairs), bool)} if right is None else {'right': right, 'wrong': ~right}
    )
    for outcome, mask in masks.items():
        if mask.any():
            later, earlier = result.pairs[mask].T
            label = MEANING[outcome].replace('match', 'aligned')
            axes.plot(earlier, later, color=BRIGHT[outcome], ms=size, label=label, **dots)
    axes.text(N * 0.97, N * 0.04, 'not compared:\nlater, or too recent', ha='right', va='top', color=QUIET)
    axes.set(xlabel='earlier image', ylabel='later image', xlim=(-0.5, N - 0.5), ylim=(N - 0.5, -0.5))
    for handle in legend_above(axes, 3).get_lines():
        handle.set(markersize=10, alpha=1)


def draw_loops(result: LoopResult, described: PlaceMap, title: str, folder: Path) -> Path:
    """
    Draw the page ``loop.png``: the drive against its own past on the left, closures on the right.

    :param described: all the images, with thumbnails.
    :returns: its path.
    """
    path = folder / 'loop.png'
    lines = result.lines()
    with page(path, 12.5, 6.3 + 0.17 * len(lines)) as figure:
        parts = figure.add_gridspec(2, 2, height_ratios=(0.4 + 0.17 * len(lines), 5.9), width_ratios=(1, 1.1))
        top = figure.add_subfigure(parts[0, :])
        top.text(0.012, 0.96, title, fontsize=15, weight='bold', va='top', color=INK)
        top.text(0.012, 0.54, '\n'.join(lines), fontsize=10.5, va='top', color=QUIET)
        left = figure.add_subfigure(parts[1, 0])
        _draw_drive(left, left.add_subplot(), result, _background(result, described))
        draw_pairs(figure.add_subfigure(parts[1, 1]), _pairs(result, described), 2)
    return path
