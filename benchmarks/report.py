# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Markdown report of a run of benchmarks/matching.py, with the project's targets."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from memory import Memory, TARGET
from results import heading, number_text, READING, Row, seconds_text, table
from run import Run

ROBUST_STAGES = (
    'mean_centering',
    'image_distances',
    'query_znorm',
    'window_push',
    'filter_update',
    'filter_belief',
)
SIZES = ('stage', 'mode', 'n', 'd', 'precision')  # head of a row's first cells
OUTCOME = {True: 'reached', False: '**not reached**', None: 'not measured'}
CELLS, BOUND, SECONDS = 'cells per second', 'over the lower bound', 'seconds'
PRODUCT, READ = 'torch float32', READING  # peers: the time over theirs is wanted
TARGETS = {  # stage, mode, n, d in float32: value or peer, least or most
    ('cpu', 'lm_dtw', 'paper', 20_000, 0): ((CELLS, 2.5e9), ('prange', 8), ('librosa', 100)),
    ('cpu', 'lm_dtw', 'paper', 100_000, 0): ((CELLS, 2.5e9), ('prange', 8), ('librosa', 100)),
    ('cpu', 'distance_matrix', '', 2_000, 512): ((PRODUCT, 1.25),),
    ('cpu', 'distance_matrix', '', 20_000, 512): ((PRODUCT, 1.25),),
    ('cpu', 'frame', 'robust', 20_000, 224): ((READ, 1.5),),
    ('cpu', 'frame', 'robust', 20_000, 512): ((READ, 1.5),),
    ('cpu', 'frame', 'robust', 100_000, 224): ((READ, 1.5),),
    ('cpu', 'frame', 'paper', 20_000, 512): ((BOUND, 1.5),),
    ('cuda', 'distance_matrix', '', 2_000, 512): ((SECONDS, 3e-4),),
    ('cuda', 'retrieval', 'paper', 2_000, 0): ((SECONDS, 1e-4),),
}
AT_LEAST = (CELLS, 'prange', 'librosa')


def _sizes(row: Row) -> list[str]:
    return [row.stage, row.mode or 'both', f'{row.n:,}', str(row.d or '-'), row.precision]


def value_of(row: Row, name: str) -> float | None:
    """Return a value of :data:`TARGETS`; None where the row has no such peer."""
    if name == CELLS:
        return row.extra['cells'] / row.median_s if 'cells' in row.extra else None
    if name in (BOUND, SECONDS):
        return row.ratio if name == BOUND else row.median_s
    ratio = next((peer['ratio'] for peer in row.peers if peer['name'] == name), None)
    return 1 / ratio if ratio and name not in AT_LEAST else ratio


def frame_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of whole frames in mode robust, stage by stage."""
    lines = []
    for row in (row for row in rows if (row.stage, row.mode) == ('frame', 'robust')):
        # only image distances depend on the precision
        parts = {
            part.stage: part.median_s
            for part in rows
            if part.n == row.n and part.mode != 'paper' and part.d in (0, row.d)
            and (part.precision == row.precision or part.stage != 'image_distances')
        }  # fmt: skip
        medians = [parts.get(stage, 0.0) for stage in ROBUST_STAGES]
        times = (*medians, sum(medians), row.median_s, row.spread_s, row.lower_bound_s)
        over = number_text(value_of(row, READ))
        lines.append([*_sizes(row)[2:], *map(seconds_text, times), number_text(row.ratio), over])
    last = 'sum', 'frame', 'spread', 'lower bound', 'ratio', f'over {READING}, in turn'
    head = (*SIZES[2:], *ROBUST_STAGES, *last)
    return ['## A frame in mode robust (the default), stage by stage', '', *table(head, lines)]


def memory_section(measured: Sequence[Memory]) -> list[str]:
    """Return the table of resident memory."""
    lines = [
        [
            *(m.operation, m.mode, m.precision, f'{m.n:,}', str(m.d)),
            *(f'{size / 1e6:,.0f} MB' for size in (m.feature_bytes, m.resident_bytes)),
            *(number_text(m.ratio), f'<= {TARGET}', OUTCOME[m.ratio <= TARGET]),
        ]
        for m in measured
    ]
    sizes = ('operation', 'mode', 'precision', 'n', 'd', 'features', 'resident')
    return ['## Memory', '', *table((*sizes, 'ratio', 'wanted', ''), lines)]


def target_section(rows: Sequence[Row], device: str) -> list[str]:
    """Return the table of a device's targets."""
    lines = []
    for (of_device, stage, mode, n, d), wanted in TARGETS.items():
        own = [r for r in rows if (r.stage, r.mode, r.n, r.d) == (stage, mode, n, d)]
        row = next((r for r in own if r.precision == 'float32'), None)
        for name, limit in wanted if of_device == device else ():
            found, least = value_of(row, name) if row else None, name in AT_LEAST
            reached = None if found is None else found >= limit if least else found <= limit
            text = [number_text(found), f'{">=" if least else "<="} {limit:g}', OUTCOME[reached]]
            lines.append([stage, mode or 'both', f'{n:,}', str(d or '-'), name, *text])
    return ['## Targets', '', *table((*SIZES[:4], 'value', 'measured', 'wanted', ''), lines)]


def stage_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of all rows."""
    lines = []
    for row in rows:
        cells = value_of(row, CELLS)
        texts = [seconds_text(row.median_s), seconds_text(row.spread_s), str(row.runs)]
        texts += [seconds_text(row.lower_bound_s), number_text(row.ratio)]
        lines.append([*_sizes(row), *texts, number_text(cells / 1e9 if cells else None)])
    head = (*SIZES, 'median', 'spread', 'runs', 'lower bound', 'ratio', 'G cells/s')
    return ['## All stages', '', *table(head, lines)]


def peer_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of comparisons; losses against peers that do the whole work are counted."""
    pairs = [(row, peer) for row in rows for peer in row.peers]
    lines = []
    for row, peer in pairs:
        times = map(seconds_text, (row.median_s, peer['median_s'], peer['spread_s']))
        note = peer['note'] + ('; a part of the work' if peer['partial'] else '')
        lines.append([*_sizes(row), peer['name'], *times, number_text(peer['ratio']), note])
    whole = [peer['ratio'] for _, peer in pairs if not peer['partial']]
    lost = f'{sum(ratio < 1 for ratio in whole)} of {len(whole)} lost'
    head = (*SIZES, 'peer', 'ours', 'peer', 'spread', 'peer / ours', '')
    return [f'## Beside peers ({lost})', '', *table(head, lines)]


def report(about: dict[str, Any], run: Run, memory: Sequence[Memory]) -> list[str]:
    """Return the lines of the report."""
    machine, rows = about['machine'], run.rows
    peaks = [[name, f'{rate / 1e9:,.1f} G'] for name, rate in asdict(run.peaks).items()]
    left_out = [
        [s['name'], f'{s["n"]:,}' if s['n'] else 'all', str(s['d'] or '-'), s['reason']]
        for s in run.skipped
    ]
    return [
        *heading(f'Matching on {machine.get("gpu") or machine["cpu"]}', about),
        *frame_section(rows),
        *memory_section(memory),
        *target_section(rows, run.device),
        *stage_section(rows),
        *peer_section(rows),
        *('## Peaks, measured in the same run', '', *table(('peak', 'best'), peaks)),
        *('## Left out', '', *table(('stage or peer', 'n', 'd', 'reason'), left_out)),
    ]
