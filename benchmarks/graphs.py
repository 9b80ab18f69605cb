# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Graph of a run of ``matching.py``: times over the number of places, bounds and peers.

``python benchmarks/graphs.py RESULTS.json docs/performance.png`` draws it of written results.
"""

from collections.abc import Sequence
from dataclasses import fields
import json
from pathlib import Path

from matplotlib.axes import Axes
from results import parser_of, Row
from stavpr_lab.style import legend_above, page
from stavpr_ros.palette import BLUE, GRAY, ORANGE

COLORS = {'float32': BLUE, 'int8': ORANGE}
PEERS = {'torch float32': 's--', 'faiss flat': 'd--', 'prange': '^--'}


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw image distances, the filter, and frames of mode robust, at the least dimensions."""
    least = min((row.d for row in rows if row.stage == 'frame' and row.d), default=0)
    panels = (
        ('image_distances', f'distances of {least} dimensions', least),
        ('filter_update', 'place filter', 0),
        ('frame', f'image of {least} dimensions', least),
    )
    with page(path, 12.5, 4.6) as figure:
        for axes, (stage, title, d) in zip(figure.subplots(1, 3), panels, strict=True):
            own = [r for r in rows if (r.stage, r.d) == (stage, d) and r.mode in ('', 'robust')]
            _draw_stage(axes, sorted(own, key=lambda row: row.n))
            axes.set(xscale='log', yscale='log', xlabel='places (number)')
            axes.set_ylabel(f'{title}: time (ms)')
            legend_above(axes, 3)


def _draw_stage(axes: Axes, own: Sequence[Row]) -> None:
    """Draw the times of a stage, its lower bounds and its peers."""
    for precision, color in COLORS.items():
        of_precision = [row for row in own if row.precision == precision]
        n = [row.n for row in of_precision]
        if n:
            ms = [1e3 * row.median_s for row in of_precision]
            bound = [1e3 * row.lower_bound_s for row in of_precision]
            axes.plot(n, ms, 'o-', color=color, label=precision)
            label = 'lower bound' if color == BLUE else ''
            axes.plot(n, bound, ':', color=color, label=label)
    for name, style in PEERS.items():
        peers = [
            (row.n, 1e3 * peer['median_s'])
            for row in own
            if row.precision == 'float32'
            for peer in row.peers
            if peer['name'] == name
        ]
        if peers:
            axes.plot(*zip(*peers, strict=True), style, color=GRAY, ms=5, label=name)


def main() -> None:
    """Draw written results."""
    parser = parser_of(__doc__)
    parser.add_argument('results', type=Path, help='JSON file of matching.py')
    parser.add_argument('graph', type=Path, help='PNG file to write')
    options = parser.parse_args()
    rows, names = json.loads(options.results.read_text())['rows'], [f.name for f in fields(Row)]
    draw([Row(**{name: row[name] for name in names}) for row in rows], options.graph)


if __name__ == '__main__':
    main()
