# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The style of all pictures, drawn by matplotlib without a screen and without pyplot's global state.

Colors, lines and texts are those of :func:`page`, whose texts can be read at half its size. Panels
are in one order: images, places, probabilities. Colors have a second sign: a marker, or dashes.
"""

from collections.abc import Iterator
from contextlib import contextmanager
import io
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.legend import Legend
import numpy as np
from stavpr_ros import palette
from stavpr_ros.output_file import PNG, write_output

CYCLE = [palette.BLUE, palette.ORANGE, palette.GREEN, palette.VERMILION, palette.PURPLE]  # curves
DASHES = (0, (5, 3))  # of limits, and of what was ordered
SMALL, DPI = 10.5, 150  # the smallest text, points; pixels per inch
STYLE: dict[Any, Any] = {
    'font.size': 11.5,
    'legend.frameon': False,
    'legend.fontsize': SMALL,
    'axes.prop_cycle': f"cycler('color', {CYCLE})",
    'axes.titlesize': 'medium',
    'axes.titlelocation': 'left',
    'axes.edgecolor': palette.QUIET,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.axisbelow': True,
    'axes.grid': True,
    'grid.color': palette.GRID,
    'xtick.color': palette.QUIET,
    'ytick.color': palette.QUIET,
}


@contextmanager
def page(path: Path, width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure (width and height in inches) in the common style, then write it."""
    with rc_context(STYLE):
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
        top.text(0.012, 0.96, title, fontsize=15, weight='bold', va='top')
        top.text(0.012, 0.06, text, fontsize=SMALL, va='bottom', color=palette.QUIET)
        yield below


def legend_above(axes: Axes, columns: int) -> Legend:
    """Put the legend above the axes, where it covers nothing and does not widen the layout."""
    legend = axes.legend(
        *axes.get_legend_handles_labels(), loc='lower left', bbox_to_anchor=(0, 1.0),
        ncols=columns, borderaxespad=0.2, handlelength=1.2, columnspacing=1.2, handletextpad=0.4,
    )  # fmt: skip
    legend.set_in_layout(False)
    for handle in legend.get_lines():
        handle.set_markersize(8)
    lines = -(-len(legend.get_texts()) // columns)
    axes.set_title('\n'.join(' ' * lines), fontsize=13)  # keeps room for it
    return legend


def show_distances(
    figure: Figure | SubFigure, axes: Axes, distances: np.ndarray, **options: Any
) -> None:
    """
    Draw distances in grays (dark: near) from their 0.2 % to their 90 % quantile, with the scale.

    :param distances: shape (rows, columns); others than finite ones are left white.
    :param options: options of :meth:`matplotlib.axes.Axes.imshow`.
    """
    finite = distances[np.isfinite(distances)]
    low, high = np.quantile(finite, [0.002, 0.9]) if finite.size else (0.0, 1.0)
    high = max(high, low + 1e-6)
    image = axes.imshow(distances, cmap='gray', vmin=low, vmax=high, **options)
    axes.grid(visible=False)
    bar = figure.colorbar(image, ax=axes, fraction=0.04, pad=0.015, aspect=32)
    bar.outline.set_visible(False)
    bar.set_ticks([low, high], labels=['near', 'far'])  # may be negative
