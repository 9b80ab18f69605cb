# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Markdown report of a run of benchmarks/matching.py, with the project's targets."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2  # a requirement of torch
from memory import Memory, TARGET
from results import heading, number_text, READING, Row, seconds_text
from run import Run

TEMPLATE = Path(__file__).with_name('report.md.jinja')
ROBUST_STAGES = (
    'mean_centering',
    'image_distances',
    'query_znorm',
    'filter_update',
    'smoothing',
    'straight_paths',
    'cells',
)
OUTCOME = {True: 'reached', False: '**not reached**', None: 'not measured'}
CELLS, BOUND = 'cells per second', 'over the lower bound'
PRODUCT, READ = 'torch float32', READING  # peers: the time over theirs is wanted
TARGETS = {  # stage, mode, n, d in float32: value or peer, least or most
    ('lm_dtw', 'paper', 20_000, 0): ((CELLS, 2.5e9), ('prange', 8), ('librosa', 100)),
    ('lm_dtw', 'paper', 100_000, 0): ((CELLS, 2.5e9), ('prange', 8), ('librosa', 100)),
    ('distance_matrix', '', 2_000, 512): ((PRODUCT, 1.25),),
    ('distance_matrix', '', 20_000, 512): ((PRODUCT, 1.25),),
    ('frame', 'robust', 20_000, 224): ((READ, 1.5),),
    ('frame', 'robust', 20_000, 512): ((READ, 1.5),),
    ('frame', 'robust', 100_000, 224): ((READ, 1.5),),
    ('frame', 'paper', 20_000, 512): ((BOUND, 1.5),),
}
AT_LEAST = (CELLS, 'prange', 'librosa')


def value_of(row: Row, name: str) -> float | None:
    """Return a value of :data:`TARGETS`; None where the row has no such peer."""
    if name == CELLS:
        return row.extra['cells'] / row.median_s if 'cells' in row.extra else None
    if name == BOUND:
        return row.ratio
    ratio = next((peer['ratio'] for peer in row.peers if peer['name'] == name), None)
    return 1 / ratio if ratio and name not in AT_LEAST else ratio


def stage_times(rows: Sequence[Row], frame: Row) -> list[float]:
    """Return the median for each of :data:`ROBUST_STAGES` at the frame's sizes, seconds."""
    # only image distances depend on the precision
    parts = {
        part.stage: part.median_s
        for part in rows
        if part.n == frame.n and part.mode != 'paper' and part.d in (0, frame.d)
        and (part.precision == frame.precision or part.stage != 'image_distances')
    }  # fmt: skip
    return [parts.get(stage, 0.0) for stage in ROBUST_STAGES]


def targets(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the targets: sizes, name, value, limit, and whether it is reached."""
    results = []
    for (stage, mode, n, d), limits in TARGETS.items():
        own = [r for r in rows if (r.stage, r.mode, r.n, r.d) == (stage, mode, n, d)]
        row = next((r for r in own if r.precision == 'float32'), None)
        for name, limit in limits:
            value, is_min = value_of(row, name) if row else None, name in AT_LEAST
            reached = None if value is None else value >= limit if is_min else value <= limit
            sizes = {'stage': stage, 'mode': mode, 'n': n, 'd': d, 'name': name, 'value': value}
            results.append({**sizes, 'least': is_min, 'limit': limit, 'outcome': OUTCOME[reached]})
    return results


def report(about: dict[str, Any], run: Run, memory: Sequence[Memory]) -> list[str]:
    """Return the lines of the report."""
    rows = run.rows
    pairs = [(row, peer) for row in rows for peer in row.peers]
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True)
    environment.filters |= {'seconds': seconds_text, 'number': number_text}
    template = environment.from_string(TEMPLATE.read_text(encoding='utf-8'))
    page = template.render(
        heading=heading(f'Matching on {about["machine"]["cpu"]}', 'make bench', about),
        run=run,
        stages=ROBUST_STAGES,
        frames=[row for row in rows if (row.stage, row.mode) == ('frame', 'robust')],
        stage_times=stage_times,
        value_of=value_of,
        memory=memory,
        memory_limit=TARGET,
        targets=targets(rows),
        pairs=pairs,
        whole=[peer['ratio'] for _, peer in pairs if not peer['partial']],
    )
    return page.splitlines()
