# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page benchmarks/results/slam.md, from the rows of benchmarks/slam.py."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from results import heading, table
from scipy.stats import chi2

NEAR, LANE = 6.0, 1.5  # meters: of a right closure; across, on the other lane
BOUND = float(chi2.ppf(0.95, 3))  # of along, across and heading
TEXT = """\
Worlds of `make demo SLAM=world` (600 m, three laps, lap 2 on the other lane with a detour and a
stop, lap 3 in rain at dusk), recognized from their images with the odometry of each draw, without
ROS: `python benchmarks/slam.py`. The gain of a break was tuned on worlds 41 to 43 and 60 to 62,
the support of a cluster on those and KITTI; worlds 44 and 45 were measured afterwards only."""


def markdown(about: dict[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    """
    Return the lines of the page.

    :param rows: a draw of a world each.
    """
    seeds = sorted({row['seed'] for row in rows})
    drives = f'Seeds {", ".join(map(str, seeds))}; {len(rows)} draws of the odometry in all.'
    return [
        *heading('Loop closures and the pose graph, measured', 'python benchmarks/slam.py', about),
        *TEXT.splitlines(),
        drives,
        '',
        *table(('', 'target', 'median', 'worst'), [*_drift_rows(rows), *_other_rows(rows)]),
        *table(('edges', 'target', 'large drift', 'small drift'), _edge_rows(rows)),
        'Each drive, ATE in m:',
        '',
        *table(
            (
                'world',
                'draw',
                'large drift: before',
                'after',
                'small drift: before',
                'after',
                'two sessions: after',
                'carried: before',
                'after',
                'images',
            ),
            [_drive_row(row) for row in rows],
        ),
    ]


def _spread(values: Iterable[float], digits: int = 3, highest: bool = True) -> tuple[str, str]:
    numbers = np.array(list(values))
    worst = numbers.max() if highest else numbers.min()
    return f'{np.median(numbers):.{digits}f}', f'{worst:.{digits}f}'


def _drift_rows(rows: list[dict[str, Any]]) -> list[list[str]]:
    lines = []
    marks = {'large': '.10 / .15', 'small': '.15 / .20'}
    for name, mark in marks.items():
        own = [row[name] for row in rows]
        before = np.median([row['before'] for row in own])
        ratios = _spread(row['after'] / row['before'] for row in own)
        lines.append([f'ATE after / before, drift {before:.1f} m', mark, *ratios])
    for name in marks:
        own = [row[name] for row in rows]
        for kind, title, mark in (
            ('random 30', '30 % false at random', '1.1'),
            ('coherent 30', '30 % false in runs of 20 that agree', '1.3 / 2'),
        ):
            times = _spread((row[kind]['after'] / row['after'] for row in own), 2)
            lines.append([f'{title}, {name} drift: ATE / that without', mark, *times])
        half = _spread(row['coherent 50']['after'] / row['before'] for row in own)
        lines.append([f'50 % false in runs, {name} drift: ATE after / before', '.3', *half])
    for name, mark in (('small', '.25'), ('large', '')):
        off = [np.sqrt(np.mean(np.square(row[name]['passes']))) for row in rows]
        title = f'rms error of the relative position of two passes, {name} drift, m'
        lines.append([title, mark, *_spread(off, 2)])
    return lines


def _other_rows(rows: list[dict[str, Any]]) -> list[list[str]]:
    lines, rows = [], [row for row in rows if 'sessions' in row]
    for kind, title in (
        ('after', 'two sessions: ATE, m'),
        ('random 30', 'the same, 30 % false at random'),
        ('coherent 30', 'the same, 30 % false in runs'),
    ):
        lines.append([title, '1.5', *_spread((row['sessions'][kind] for row in rows), 2)])
    for name in ('large', 'small'):
        own = [row[f'carried {name}'] for row in rows]
        title = f'carried robot, {name} drift:'
        lines += [
            [f'{title} ATE at 50 images from the first closure behind the break, m', '2.5',
             *_spread((row['at 50'] for row in own), 2)],
            [f'{title} images until it is below 2.5 m, and stays there', '50',
             *_spread((row['images'] for row in own), 0)],
            [f'{title} ATE of the whole drive, m', '', *_spread((row['after'] for row in own), 2)],
        ]  # fmt: skip
    return lines


def _edge_rows(rows: list[dict[str, Any]]) -> list[list[str]]:
    lines: list[list[str]] = []

    def add(title: str, mark: str, cells: Iterable[str]) -> None:
        lines.append([title, mark, *cells])

    drifts = ('large', 'small')
    own = {name: [row[name] for row in rows] for name in drifts}
    right = {name: sum(row['right'] for row in own[name]) for name in drifts}
    add('closures within 6 m', '', (
        f'{right[name]} of {sum(row["closures"] for row in own[name])}' for name in drifts
    ))  # fmt: skip
    add('PnP accepted', '90 %', (
        f'{100 * sum(row["pnp"] for row in own[name]) / right[name]:.1f} %' for name in drifts
    ))  # fmt: skip
    wrong = [errors for row in own['small'] for errors in row.get('wrong', [])]
    add('pairs of wrong places accepted', '0', ('', f'{sum(wrong)} of {len(wrong)}'))
    edges = {
        (name, source): np.concatenate(
            [np.array(row['edges'][source]).reshape(-1, 5) for row in own[name]]
        )
        for name in drifts
        for source in ('PNP', 'ALIGNED')
    }
    for column, title, mark, unit in (
        (0, 'ahead', '.4', 1.0), (1, 'across', '.4', 1.0), (2, 'heading', '.6', np.pi / 180)
    ):  # fmt: skip
        kind = 'degrees' if column == 2 else 'm'
        add(f'PnP: 90 % {title}, {kind}', mark, (
            f'{np.percentile(np.abs(edges[name, "PNP"][:, column]), 90) / unit:.2f}'
            for name in drifts
        ))  # fmt: skip
    add('PnP: mean error across, away from the place, other lane, m', '.05', (
        f'{np.mean(each[:, 1] * np.sign(each[:, 4]), where=np.abs(each[:, 4]) > LANE):.3f}'
        for each in (edges[name, 'PNP'] for name in drifts)
    ))  # fmt: skip
    for source, title, marks in (
        ('PNP', 'PnP', ('2 to 4', '92 to 97 %')), ('ALIGNED', 'aligned', ('', '90 to 99 %'))
    ):  # fmt: skip
        of = [edges[name, source] for name in drifts]
        add(f'{title}: of the published edges, off by more than 6 m', '0', (
            f'{np.sum(np.hypot(*each[:, :2].T) > NEAR)} of {len(each)}' for each in of
        ))  # fmt: skip
        add(f'{title}: mean NEES of 3', marks[0], (
            f'{each[:, 3].mean():.2f}' if len(each) else '' for each in of
        ))  # fmt: skip
        inside = [each[:, 3] < BOUND for each in of]
        add(f'{title}: inside the bound of 95 % (NEES)', marks[1], (
            f'{100 * each.mean():.1f} % of {len(each)}' if len(each) else '' for each in inside
        ))  # fmt: skip
    for kind, title in (('edge', 'edge'), ('place_index', '`place_index`')):
        add(f'{title}: mean along the track, same lane, places', '.1', (
            f'{np.mean([off for row in own[name] for off in row["biases"][kind]]):.3f}'
            for name in drifts
        ))  # fmt: skip
    times = [[took for row in own[name] for took in row.get('pnp_ms', [])] for name in drifts]
    add('processor time of PnP: median, 90 %, ms', '60', (
        ', '.join(f'{value:.0f}' for value in np.percentile(each, [50, 90])) for each in times
    ))  # fmt: skip
    return lines


def _drive_row(row: dict[str, Any]) -> list[str]:
    values = [row[name][key] for name in ('large', 'small') for key in ('before', 'after')]
    images = ''
    if 'sessions' in row:
        carried = row['carried large']
        values += [row['sessions']['after'], carried['before'], carried['after']]
        images = str(carried['images'])
    cells = [f'{value:.2f}' for value in values] + [''] * (7 - len(values))
    return [str(row['seed']), str(row['draw']), *cells, images]
