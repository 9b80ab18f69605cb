"""
The Markdown table of a run, made from its JSON alone.

``python benchmarks/report.py RESULTS.json`` writes it again beside the file.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from marks import undecided
from records import Record, load

UNITS = ((1.0, 's'), (1e-3, 'ms'), (1e-6, 'µs'))


def seconds_text(seconds: float | None) -> str:
    """Return a duration with three digits and a unit."""
    if seconds is None:
        return '-'
    scale, unit = next(((s, u) for s, u in UNITS if seconds >= s), UNITS[-1])
    return f'{number_text(seconds / scale)} {unit}'


def number_text(value: float | None) -> str:
    """Return a number with three digits, without an exponent where it is readable so."""
    if value is None:
        return '-'
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        digits = 2 if abs(value) < 10 else 1 if abs(value) < 100 else 0
        return f'{value:,.{digits}f}' if abs(value) >= 0.1 or value == 0 else f'{value:.3g}'
    return f'{value:.3g}'


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = ['| ' + ' | '.join(cells) + ' |' for cells in (head, *rows)]
    return [lines[0], '|' + ' --- |' * len(head), *lines[1:]]


def _heading(first: Record) -> list[str]:
    about, versions = first.extra.get('machine', {}), first.extra.get('versions', {})
    names = ', '.join(f'{name.replace("_", " ")} {value}' for name, value in about.items() if value != '')
    return [
        f'# Matching on {about.get("gpu") or about.get("cpu", "an unknown machine")}',
        '',
        f'Commit {first.extra.get("commit")}, {first.extra.get("date")}. Machine: {names}.',
        'Versions: ' + ', '.join(f'{name} {value}' for name, value in versions.items()) + '.',
        'How to read and repeat it: benchmarks/README.md.',
        '',
    ]


def _ceilings(records: Sequence[Record]) -> list[str]:
    rows = []
    for record in records:
        said = record.extra
        if 'bytes_per_s' in said:
            rows.append([record.name, f'{said["bytes_per_s"] / 1e9:,.1f} GB/s', said['source']])
        else:
            rows.append(
                [record.name, f'{said["operations_per_s"] / 1e9:,.0f} G operations/s', said['source']]
            )
    return ['## Ceilings, measured in the same run', '', *table(('what', 'best', 'seen in'), rows), '']


def marks_section(records: Sequence[Record]) -> list[str]:
    """Return the lines of the table of marks."""
    rows = [
        [
            mark['mark'],
            ', '.join(
                [
                    record.dtype,
                    *(f'{key} = {record.extra[key]}' for key in ('xi', 'data') if key in record.extra),
                ]
            ),
            number_text(mark['value']) if mark['value'] >= 1e-2 else f'{mark["value"]:.3g}',
            mark['wanted'],
            'reached' if mark['reached'] else '**not reached**',
        ]
        for record in records
        for mark in record.marks
    ]
    rows.sort(key=lambda row: row[0])
    rows += [[text, '', '-', '', 'not measured'] for text in undecided(records, records[0].device)]
    return ['## Marks', '', *table(('mark', 'of', 'value', 'wanted', ''), rows), '']


def lost(record: Record) -> bool:
    """Whether a peer that does the whole work was faster."""
    return (record.speedup or 1) < 1 and not record.extra.get('peer_part')


Column = tuple[str, Callable[[Record], str]]
SIZE: tuple[Column, ...] = (
    ('n', lambda record: f'{record.n:,}'),
    ('d', lambda record: f'{record.dim:,}' if record.dim else '-'),
    ('dtype', lambda record: record.dtype),
    ('xi', lambda record: str(record.extra.get('xi', '-'))),
    ('data', lambda record: str(record.extra.get('data', '-'))),
)
OWN: tuple[Column, ...] = (
    ('median', lambda record: seconds_text(record.median_s)),
    ('spread', lambda record: seconds_text(record.spread_s)),
    ('runs', lambda record: str(record.runs)),
    ('floor', lambda record: seconds_text(record.floor_s)),
    ('median / floor', lambda record: number_text(record.ratio_to_floor)),
)
CELLS: Column = ('G cells/s', lambda record: number_text(record.extra['cells_per_s'] / 1e9))
EVENTS: Column = ('device alone', lambda record: seconds_text(record.extra['events_s']))
PEERS: tuple[Column, ...] = (
    ('peer', lambda record: f'{record.peer} {record.extra.get("peer_version", "")}'.strip()),
    ('ours', lambda record: seconds_text(record.median_s)),
    ('peer, median', lambda record: seconds_text(record.peer_median_s)),
    ('spread', lambda record: seconds_text(record.peer_spread_s)),
    ('starts timed', lambda record: str(record.extra.get('peer_sample', '-'))),
    ('form', lambda record: str(record.extra.get('peer_what', '-')).removeprefix('torch.mm, ')),
    ('peer / ours', lambda record: number_text(record.speedup)),
    ('', lambda record: 'loss' if lost(record) else ''),
)


def _columns(records: Sequence[Record], columns: Sequence[Column]) -> list[str]:
    """Return the table of these records, without columns that say nothing."""
    cells = [[value(record) for _, value in columns] for record in records]
    kept = [i for i in range(len(columns)) if any(row[i] not in ('-', '') for row in cells)]
    return table([columns[i][0] for i in kept], [[row[i] for i in kept] for row in cells])


def _stage(name: str, records: Sequence[Record]) -> list[str]:
    lines = [f'## {name}', '']
    own = [record for record in records if record.peer is None]
    columns = [*SIZE, *OWN]
    columns += [CELLS] if all('cells_per_s' in record.extra for record in own) else []
    columns += [EVENTS] if all('events_s' in record.extra for record in own) else []
    lines += [*_columns(own, columns), ''] if own else []
    against = [record for record in records if record.peer is not None]
    if against:
        rivals = [record for record in against if not record.extra.get('peer_part')]
        losses = f'{sum(map(lost, rivals))} of {len(rivals)} lost'
        lines += [f'Against others ({losses}):' if rivals else 'Beside a part of the work:', '']
        lines += [*_columns(against, [*SIZE, *PEERS]), '']
        notes = {record.peer: record.extra.get('peer_note') for record in against}
        lines += [f'* {peer}: {note}' for peer, note in notes.items() if note] + ['']
    return lines


def _skipped(records: Sequence[Record]) -> list[str]:
    if not records:
        return []
    rows = [
        [
            record.name,
            record.peer or '',
            f'{record.n:,}',
            f'{record.dim:,}',
            record.dtype,
            str(record.skipped),
        ]
        for record in records
    ]
    return ['## Not measured', '', *table(('stage', 'peer', 'n', 'd', 'dtype', 'why'), rows), '']


def markdown(records: Sequence[Record]) -> str:
    """Return the report of a run."""
    measured = [record for record in records if record.median_s is not None]
    ceilings = [record for record in records if record.name.startswith('ceiling_')]
    lines = _heading(records[0]) + marks_section(records) + _ceilings(ceilings)
    for name in dict.fromkeys(record.name for record in measured):
        lines += _stage(name, [record for record in measured if record.name == name])
    lines += _skipped([record for record in records if record.skipped])
    return '\n'.join(lines).rstrip() + '\n'


def write(path: Path) -> Path:
    """Write the report of a JSON file beside it."""
    target = path.with_suffix('.md')
    target.write_text(markdown(load(path)), encoding='utf-8')
    return target


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('results', type=Path, help='what benchmarks/matching.py wrote')
    print(f'wrote {write(parser.parse_args().results)}')


if __name__ == '__main__':
    main()
