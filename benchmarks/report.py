# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The Markdown report of a run of benchmarks/matching.py."""

from collections.abc import Sequence
from typing import Any

from lower_bounds import Peaks
from memory import Memory, TARGET
from results import heading, number_text, READING, Row, seconds_text, Skipped, table
from targets import cells_per_s, Target, TARGETS

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


def _sizes(row: Row | Target) -> list[str]:
    return [row.stage, row.mode or 'both', f'{row.n:,}', str(row.d or '-'), row.precision]


def _part(rows: Sequence[Row], stage: str, frame: Row) -> float:
    """Return the median of a frame's stage; only image distances depend on the precision."""
    for row in rows:
        same = row.precision == frame.precision or stage != 'image_distances'
        if (
            (row.stage, row.n) == (stage, frame.n)
            and row.mode != 'paper'
            and row.d in (0, frame.d)
            and same
        ):
            return row.median_s
    return 0.0


def frame_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of whole frames in mode robust, stage by stage."""
    lines = []
    for row in (row for row in rows if (row.stage, row.mode) == ('frame', 'robust')):
        parts = [_part(rows, stage, row) for stage in ROBUST_STAGES]
        texts = [
            seconds_text(s)
            for s in (*parts, sum(parts), row.median_s, row.spread_s, row.lower_bound_s)
        ]
        over = [number_text(1 / peer.ratio) for peer in row.peers if peer.name == READING]
        lines.append([*_sizes(row)[2:], *texts, number_text(row.ratio), *(over or ['-'])])
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
    head = (
        'operation',
        'mode',
        'precision',
        'n',
        'd',
        'features',
        'resident',
        'ratio',
        'wanted',
        '',
    )
    return ['## Memory', '', *table(head, lines)]


def target_section(rows: Sequence[Row], device: str) -> list[str]:
    """Return the table of a device's targets."""
    lines = []
    for target in (target for target in TARGETS if target.device == device):
        found = target.found(rows)
        outcome = OUTCOME[None if found is None else target.reached(found)]
        wanted = f'{target.relation} {target.wanted:g}'
        lines.append([*_sizes(target), target.value, number_text(found), wanted, outcome])
    head = (*SIZES, 'value', 'measured', 'wanted', '')
    return ['## Targets', '', *table(head, lines)]


def stage_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of all rows."""
    lines = []
    for row in rows:
        cells = cells_per_s(row)
        texts = [seconds_text(s) for s in (row.median_s, row.spread_s)]
        texts += [str(row.runs), seconds_text(row.lower_bound_s), number_text(row.ratio)]
        lines.append([*_sizes(row), *texts, number_text(cells / 1e9 if cells else None)])
    head = (*SIZES, 'median', 'spread', 'runs', 'lower bound', 'ratio', 'G cells/s')
    return ['## All stages', '', *table(head, lines)]


def peer_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of comparisons; losses against peers that do the whole work are counted."""
    pairs = [(row, peer) for row in rows for peer in row.peers]
    lines = []
    for row, peer in pairs:
        times = [seconds_text(s) for s in (row.median_s, peer.median_s, peer.spread_s)]
        note = peer.note + ('; a part of the work' if peer.partial else '')
        lines.append([*_sizes(row), peer.name, *times, number_text(peer.ratio), note])
    whole = [peer.ratio for _, peer in pairs if not peer.partial]
    head = (*SIZES, 'peer', 'ours', 'peer', 'spread', 'peer / ours', '')
    lost = f'{sum(ratio < 1 for ratio in whole)} of {len(whole)} lost'
    return [f'## Beside peers ({lost})', '', *table(head, lines)]


def peak_section(peaks: Peaks) -> list[str]:
    """Return the table of the machine's peaks."""
    rates = [('read bandwidth', f'{peaks.bytes_per_s / 1e9:,.1f} GB/s', 'read')]
    rates += [
        (f'matrix product, {dtype}', f'{rate / 1e9:,.0f} G operations/s', dtype)
        for dtype, rate in peaks.operations_per_s.items()
    ]
    lines = [(name, rate, peaks.sources.get(key, 'its measurement')) for name, rate, key in rates]
    return ['## Peaks, measured in the same run', '', *table(('peak', 'best', 'seen in'), lines)]


def report(
    about: dict[str, Any],
    rows: Sequence[Row],
    memory: Sequence[Memory],
    peaks: Peaks,
    skipped: Sequence[Skipped],
) -> list[str]:
    """Return the lines of the report."""
    machine = about['machine']
    left_out = [[s.name, f'{s.n:,}' if s.n else 'all', str(s.d or '-'), s.reason] for s in skipped]
    return [
        *heading(f'Matching on {machine.get("gpu") or machine["cpu"]}', about),
        *frame_section(rows),
        *memory_section(memory),
        *target_section(rows, 'cuda' if 'gpu' in machine else 'cpu'),
        *stage_section(rows),
        *peer_section(rows),
        *peak_section(peaks),
        *('## Left out', '', *table(('stage or peer', 'n', 'd', 'reason'), left_out)),
    ]
