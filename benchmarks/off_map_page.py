# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page benchmarks/results/off_map.md, from the rows that off_map.py measures."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from accuracy import FEATURES
import numpy as np
from results import heading, table

LEARNED, HYBRID, INT8 = 'l', 'h', 'i'
# kinds of features; a second word is the setting model
KINDS = FEATURES | {LEARNED: 'efficientnet_lite1', HYBRID: 'hybrid', INT8: 'hybrid int8'}
DAY, NIGHT = 'gardens_point', 'walk_night'
JUMP = 'after a jump'  # from half of the query away
LEVEL = 0.95  # declared probability whose precision the summary gives
RATES = '0.05', '0.01'  # of max_error
BY_NIGHT = NIGHT, f'{NIGHT}_map'
Results = dict[str, dict[str, Any]]
TEXT = """\
`make off-map` measures mode robust with its defaults on all data sets of the
[accuracy table](../README.md#accuracy), on drives that differ from the recordings.
Questions that these tables answer: [by night](night.md), [never seen](unseen.md), [how
sure](sure.md). All numbers, and the bins of the calibration, are in [off_map.json](off_map.json).

* **Detours:** the map lacks a stretch that the query drives; {stretches}.
  Unseen images are more than 5 places from each place of the map.
* **Other floors:** eight floors of a building that look alike; every match is wrong. "standstill":
  each map has 200 more places, equal, in its middle.
* **Speeds:** half speed repeats every image; "all speeds" also pools stops of 30 and 100 images
  and dropped images. Best F1 is over all thresholds, precision is that of the default.
* **Every third place:** of the map, all images of the query.
* **Early matches:** of the newest images alone, before a window is full or since the camera has
  come to the map. They count beside the image's later match, in all but recall and F1.
* **Reverse order:** the last image of the query comes first; its direction is wrong.
* **Start in the middle:** images until the first match is right; a window has 20.
* **Calibration:** declared probability beside the share of right matches; the expected error is
  the mean difference of both over ten bins.
"""
DRIVES = 'Precision / recall of each drive at `max_error` 0.01 (the default, .5) and 0.05:'


def percent(part: float, whole: float) -> str:
    """Return a share with the counts."""
    return f'{part / whole:.1%} of {whole:,}' if whole else '-'


def _rows(results: Results, section: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for key, values in results.items():
        head, feature, name = key.split('/', 2)
        if head == section:
            yield feature, name, values


def summary(results: Results, feature: str) -> dict[str, tuple[str, str]]:
    """Return value and aim of each summary row, for one kind of features."""

    def of(section: str) -> dict[str, dict[str, Any]]:
        return {name: v for f, name, v in _rows(results, section) if f == feature}

    def total(rows: dict[str, dict[str, Any]], name: str) -> int:
        return sum(row[name] for row in rows.values())

    def sure(rows: Iterable[dict[str, Any]], name: str = 'sure') -> str:
        """Return the wrong matches of high probability; nothing where they were not counted."""
        counts = [row[name] for row in rows if name in row]
        return f', {sum(counts)} declared {LEVEL} or more' if counts else ''

    g = feature == 'g'
    cells: dict[str, tuple[str, str]] = {}
    detours, driven, reverse = of('detours'), of('drives'), of('reverse')
    single = {k: v for k, v in driven.items() if not k.endswith('/all')}
    if detours:
        text = percent(total(detours, 'unseen_matched'), total(detours, 'unseen'))
        text += sure(detours.values(), 'unseen_sure')
        cells['detours: unseen images matched'] = text, '<= 2 %' if g else '<= 3 %'
    for name, row in of('floors').items():
        text = f'{percent(row["matched"], row["images"])} (worst pair {row["worst"]:.1%})'
        text += f'{sure([row])}, {row["early"]} early'
        _, comma, kind = name.partition(', ')
        label = f'other floors{comma}{kind}: images matched'
        cells[label] = text, '<= 1 %' if g else '<= 2 %'

    def best(label: str, names: Sequence[str], aim: float, value: str = 'f1') -> None:
        values = [driven[name][value] for name in names if name in driven]
        if values:
            cells[label] = f'{min(values):.3f}', f'>= {aim}'

    best('day / night: best F1', [f'{NIGHT}/same'], 0.97 if g else 0.99)
    slow = [f'{NIGHT}/0.5x', f'{NIGHT}/varying']
    best('day / night at half and varying speed: lowest best F1', slow, 0.9 if g else 0.95)
    best('three times the speed by day: best F1', [f'{DAY}/3x'], 0.95)
    best('4.5 times the speed (Nordland): best F1', ['nordland/4.5x'], 0.95)
    if single:
        worst = min(single, key=lambda name: single[name]['precision'])
        text = f'{single[worst]["precision"]:.3f} ({worst})'
        cells['lowest precision at the default'] = text, '>= 0.95'
    cells |= _rates(single, of('sparse'), detours, g)
    cells |= _sparse_and_early(of('sparse'), [*single.values(), *detours.values()])
    if reverse:
        text = percent(total(reverse, 'wrong'), total(reverse, 'images')) + sure(reverse.values())
        cells['reverse order: images matched wrongly'] = text, '<= 3 %'
    label, value = 'recall at 100 % precision, all speeds', 'recall_at_100_precision'
    best(f'{label}, by day', [f'{DAY}/all'], 0.9 if g else 0.95, value)
    best(f'{label}, day / night', [f'{NIGHT}/all'], 0.7 if g else 0.9, value)
    cells |= _starts(of('start'), g)
    if errors := of('set_calibration'):
        text = ', '.join(f'{k} {v["expected_calibration_error"]:.3f}' for k, v in errors.items())
        cells['calibration: expected error, drives of a data set'] = text, '<= 0.05'
    for name, row in of('calibration').items():
        if row['images']:
            text = f'{row["expected_calibration_error"]:.3f}'
            cells[f'calibration: expected error, {name}'] = text, ''
            for level in row['levels']:
                if level['probability'] == LEVEL and level['matched']:
                    label = f'precision where {LEVEL} or more is declared, {name}'
                    cells[label] = f'{level["precision"]:.3f}', '>= 0.93'
    return cells


def _rates(
    driven: dict[str, dict[str, Any]],
    sparse: dict[str, dict[str, Any]],
    detours: dict[str, dict[str, Any]],
    is_gradient: bool,
) -> dict[str, tuple[str, str]]:
    """Return the rows of ``max_error``: lowest precision and recall of several drives."""
    changes = 'same', '0.5x', 'varying', 'stop 30', 'stop 100'
    night = [driven.get(f'{name}/{change}') for name in BY_NIGHT for change in changes]
    lost = [driven.get(f'{name}/drop 0.3') for name in BY_NIGHT]
    third = [sparse.get(name) for name in BY_NIGHT]
    season = [row for name, row in driven.items() if name.startswith('nordland/')]
    aims = ('', '>= 0.5 recall') if is_gradient else ('>= 0.98, >= 0.95', '>= 0.99, >= 0.8')
    rows = [
        (rate, 'by night, five drives both ways', night, aim)
        for rate, aim in zip(RATES, aims, strict=True)
    ]
    aim = '' if is_gradient else '>= 0.95, >= 0.9'
    rows.append((RATES[0], 'by night, every third place and 30 % lost', [*lost, *third], aim))
    aim = '' if is_gradient else '>= 0.98, >= 0.9'
    rows.append(
        (RATES[0], 'Nordland, all speeds and detours', [*season, detours.get('nordland')], aim)
    )
    cells = {}
    for rate, label, drives, aim in rows:
        values = np.array([row['rates'][rate] for row in drives if row and 'rates' in row])
        if len(values):
            text = ', '.join(f'{value:.3f}' for value in values.min(axis=0))
            cells[f'`max_error` {rate}, {label}: lowest precision, recall'] = text, aim
    return cells


def _sparse_and_early(
    sparse: dict[str, dict[str, Any]], driven: Iterable[dict[str, Any]]
) -> dict[str, tuple[str, str]]:
    """Return the rows of maps of every third place, and the row of early matches."""
    cells = {}
    for name, row in sparse.items():
        text = f'{row["precision"]:.3f}, {row["recall"]:.3f}'
        cells[f'every third place, {name}: precision, recall'] = text, '>= 0.95, >= 0.9'
    early = [row for row in driven if 'early' in row]
    if early:
        text = percent(*(sum(row[name] for row in early) for name in ('early_wrong', 'early')))
        cells['early matches of drives and detours: wrong'] = text, ''
    return cells


def _starts(rows: dict[str, dict[str, Any]], is_gradient: bool) -> dict[str, tuple[str, str]]:
    """Return the rows of the images until the first right match."""
    cells = {}
    night = [rows.get(f'{name}/whole map') for name in BY_NIGHT]
    if medians := [f'{row["median"]:g}' for row in night if row and row['median']]:
        label = 'first right match by night; on the map of the night: median'
        cells[label] = f'{"; ".join(medians)} images', '' if is_gradient else '<= 6 images'
    for label, is_jump in (('start in the middle', False), (JUMP, True)):
        group = {name: row for name, row in rows.items() if name.endswith(JUMP) == is_jump}
        if group:
            aim = f'{25 if is_gradient else 20} images'
            cells[f'{label}: right within 30 images'] = _start_text(group), aim
    return cells


def _start_text(rows: dict[str, Any]) -> str:
    """Return how many starts were right, and the images until then."""
    right, count = (sum(row[name] for row in rows.values()) for name in ('right', 'starts'))
    medians = [row['median'] for row in rows.values() if row['median']] or [0]
    longest = max((row['longest'] or 0 for row in rows.values()), default=0)
    text = f'{percent(right, count)}; medians {min(medians):.0f} to {max(medians):.0f}'
    return f'{text}, at most {longest} images'


def summary_section(results: Results) -> list[str]:
    """Return the summary: a row a question, a column a kind of features."""
    features = sorted({key.split('/')[1] for key in results}, key=list(KINDS).index)
    columns = {feature: summary(results, feature) for feature in features}
    labels = list(dict.fromkeys(label for column in columns.values() for label in column))
    lines = []
    for label in labels:
        cells = [columns[feature].get(label, ('-', '')) for feature in features]
        lines.append([label, *(text for cell in cells for text in cell)])
    head = [title for feature in features for title in (KINDS[feature], 'wanted')]
    return table(['', *head], lines)


def drives_section(results: Results) -> list[str]:
    """Return precision and recall of each drive, of each kind of features at each rate."""
    cells: dict[str, dict[tuple[str, str], str]] = {}
    for section, suffix in (('drives', ''), ('sparse', '/every third place')):
        for feature, name, row in _rows(results, section):
            for rate, (precision, recall) in row['rates'].items():
                text = f'{precision:.3f} / {recall:.3f}'
                cells.setdefault(name + suffix, {})[feature, rate] = text
    columns = sorted({column for row in cells.values() for column in row})
    head = [f'{KINDS[feature]}, {rate}' for feature, rate in columns]
    rows = [[name, *(row.get(key, '-') for key in columns)] for name, row in cells.items()]
    return table(['drive', *head], rows)


def markdown(about: dict[str, Any], results: Results) -> list[str]:
    """Return the lines of the page."""
    return [
        *heading('Off the map, at night, at other speeds', 'make off-map', about),
        TEXT.format(stretches=about['stretches']),
        *summary_section(results),
        *('## Drives', '', DRIVES, ''),
        *drives_section(results),
    ]
