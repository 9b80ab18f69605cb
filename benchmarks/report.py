"""The Markdown report of a run of benchmarks/matching.py."""

from collections.abc import Sequence
from typing import Any

from lower_bounds import Peaks
from memory import TARGET, Memory
from results import Row, heading, number_text, seconds_text, table
from run import Skipped

ROBUST_STAGES = (
    'mean_centering', 'image_distances', 'query_znorm', 'window_push', 'reference_znorm', 'velocity_search',
    'selection', 'path_trace',
)  # fmt: skip


def _find(rows: Sequence[Row], stage: str, mode: str, n: int, d: int, precision: str) -> Row | None:
    """Return the row of a stage; stages without features and centering are measured in float32 only."""
    for row in rows:
        if (row.stage, row.n) == (stage, n) and row.mode in ('', mode) and row.d in (0, d):
            if row.precision == precision or row.stage != 'image_distances':
                return row
    return None


def frame_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of whole frames in mode robust, stage by stage."""
    lines = []
    for row in rows:
        if row.stage != 'frame' or row.mode != 'robust':
            continue
        parts = [_find(rows, name, 'robust', row.n, row.d, row.precision) for name in ROBUST_STAGES]
        total = sum(part.median_s for part in parts if part)
        lines.append(
            [f'{row.n:,}', str(row.d), row.precision, *(seconds_text(p.median_s if p else None) for p in parts)]
            + [seconds_text(total), f'{seconds_text(row.median_s)} ± {seconds_text(row.spread_s)}']
            + [seconds_text(row.lower_bound_s), number_text(row.ratio)]
        )
    head = ('n', 'd', 'precision', *(name.replace('_', ' ') for name in ROBUST_STAGES))
    head += ('sum of stages', 'frame (update)', 'lower bound', 'ratio')
    title = '## A frame in mode robust (the default), stage by stage'
    return [title, '', *table(head, lines)] if lines else []


def stage_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of all rows."""
    lines = [
        [
            row.stage, row.mode or 'both', f'{row.n:,}', str(row.d or '-'), row.precision,
            seconds_text(row.median_s), seconds_text(row.spread_s), str(row.runs),
            seconds_text(row.lower_bound_s), number_text(row.ratio),
            number_text(row.extra['cells_per_s'] / 1e9) if 'cells_per_s' in row.extra else '-',
        ]
        for row in rows
    ]  # fmt: skip
    head = ('stage', 'mode', 'n', 'd', 'precision', 'median', 'spread', 'runs', 'lower bound', 'ratio')
    return ['## All stages', '', *table((*head, 'G cells/s'), lines)]


def peer_section(rows: Sequence[Row]) -> list[str]:
    """Return the table of comparisons; losses against peers that do the whole work are counted."""
    pairs = [(row, peer) for row in rows for peer in row.peers]
    whole = [peer for _, peer in pairs if not peer.partial]
    lines = [
        [
            row.stage, row.mode or 'both', f'{row.n:,}', str(row.d or '-'), row.precision, peer.name,
            seconds_text(row.median_s), seconds_text(peer.median_s), seconds_text(peer.spread_s),
            number_text(peer.ratio), peer.note + ('; a part of the work' if peer.partial else ''),
        ]
        for row, peer in pairs
    ]  # fmt: skip
    head = ('stage', 'mode', 'n', 'd', 'precision', 'peer', 'ours', 'peer, median', 'spread', 'peer / ours', '')
    lost = sum(peer.ratio < 1 for peer in whole)
    return [f'## Beside peers ({lost} of {len(whole)} lost)', '', *table(head, lines)] if pairs else []


def memory_section(measured: Sequence[Memory]) -> list[str]:
    """Return the table of resident memory."""
    lines = [
        [
            m.operation, m.mode, m.precision, f'{m.n:,}', str(m.d), f'{m.feature_bytes / 1e6:,.0f} MB',
            f'{m.resident_bytes / 1e6:,.0f} MB', number_text(m.ratio),
            f'<= {TARGET}', 'reached' if m.ratio <= TARGET else '**not reached**',
        ]
        for m in measured
    ]  # fmt: skip
    head = ('operation', 'mode', 'precision', 'n', 'd', 'features', 'resident', 'resident / features', 'target', '')
    return ['## Memory', '', *table(head, lines)] if measured else []


def target_section(targets: Sequence[dict[str, Any]]) -> list[str]:
    """Return the table of targets."""
    outcome = {True: 'reached', False: '**not reached**', None: 'not measured'}
    lines = [
        [t['target'], t.get('precision', '-'), number_text(t['value']), t.get('wanted', '-')]
        + [outcome[t['reached']]]
        for t in targets
    ]
    return ['## Targets', '', *table(('target', 'precision', 'value', 'wanted', ''), lines)]


def peak_section(peaks: Peaks) -> list[str]:
    """Return the table of the machine's peaks."""
    lines = [['read bandwidth', f'{peaks.bytes_per_s / 1e9:,.1f} GB/s', peaks.sources.get('read', 'read')]]
    lines += [
        [f'matrix product, {dtype}', f'{rate / 1e9:,.0f} G operations/s', peaks.sources.get(dtype, 'product')]
        for dtype, rate in peaks.operations_per_s.items()
    ]
    return ['## Peaks, measured in the same run', '', *table(('peak', 'best', 'seen in'), lines)]


def skipped_section(skipped: Sequence[Skipped]) -> list[str]:
    """Return the table of everything that was left out."""
    lines = [[s.stage, f'{s.n:,}', str(s.d or '-'), s.reason] for s in skipped]
    return ['## Left out', '', *table(('stage or peer', 'n', 'd', 'reason'), lines)] if skipped else []


def report(
    about: dict[str, Any],
    rows: Sequence[Row],
    memory: Sequence[Memory],
    targets: Sequence[dict[str, Any]],
    peaks: Peaks,
    skipped: Sequence[Skipped],
) -> list[str]:
    """Return the lines of the report."""
    machine = about['machine']
    return [
        *heading(f'Matching on {machine.get("gpu") or machine["cpu"]}', about),
        *frame_section(rows),
        *memory_section(memory),
        *target_section(targets),
        *stage_section(rows),
        *peer_section(rows),
        *peak_section(peaks),
        *skipped_section(skipped),
    ]
