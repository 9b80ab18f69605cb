# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Graph of a run of ``matching.py``: times over the number of places, bounds and peers."""

from collections.abc import Sequence
from pathlib import Path

from results import Row

COLORS = {'float32': '#1f77b4', 'int8': '#d62728'}
PEERS = ('torch float32', 'faiss flat', 'prange')


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw image distances, the filter, and frames of mode robust, at the least dimensions."""
    import matplotlib as mpl

    mpl.use('Agg')
    from matplotlib import pyplot as plt

    least = min((row.d for row in rows if row.d and row.n > 1), default=0)
    panels = (
        ('image_distances', f'image distances, {least} dimensions', least),
        ('filter_update', 'place filter', 0),
        ('frame', f'an image in mode robust, {least} dimensions', least),
    )
    figure, all_axes = plt.subplots(1, 3, figsize=(13, 4.2), layout='constrained')
    for axes, (stage, title, d) in zip(all_axes, panels, strict=True):
        own = sorted(
            (r for r in rows if (r.stage, r.d) == (stage, d) and r.mode in ('', 'robust')),
            key=lambda row: row.n,
        )
        for precision, color in COLORS.items():
            of_precision = [row for row in own if row.precision == precision]
            n = [row.n for row in of_precision]
            ms = [1e3 * row.median_s for row in of_precision]
            bound = [1e3 * row.lower_bound_s for row in of_precision]
            if n:
                axes.plot(n, ms, 'o-', color=color, label=precision)
                axes.plot(n, bound, ':', color=color, label=f'{precision}, lower bound')
        for name, style in zip(PEERS, ('s--', 'd--', '^--'), strict=True):
            peers = [
                (row.n, 1e3 * peer['median_s'])
                for row in own
                if row.precision == 'float32'
                for peer in row.peers
                if peer['name'] == name
            ]
            if peers:
                axes.plot(*zip(*peers, strict=True), style, color='gray', ms=4, label=name)
        axes.set(xscale='log', yscale='log', title=title, xlabel='places', ylabel='ms')
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=110)
    plt.close(figure)
