# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A map that is updated day by day, beside the first session alone.

``python3 -m stavpr_lab.demonstration.days 30 benchmarks/results/days`` (``make days``) drives
the synthetic street and writes a table and a plot, in ten minutes; a third argument is the seed
of another street.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import sys

import numpy as np
from stavpr_lab.demonstration import FEATURES
from stavpr_lab.demonstration.street.days import DAY, Days
from stavpr_lab.demonstration.street.traverses import EPOCH
from stavpr_lab.style import legend_above, page
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.maintenance.upkeep import update_map
from stavpr_ros.mapping import build_map, Map
from stavpr_ros.mapping.versions import Version
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings

TOLERANCE = 8.0  # meters from the right position
DETOUR = -1000.0  # meters, of positions in the detour
MAPS = ('first session', 'updated map', 'updated map in int8')
PRECISIONS = 'float32', 'float32', 'int8'  # of MAPS
LINES = '-o', '-', '--'  # of MAPS


@dataclass(frozen=True)
class Day:
    """
    The result of a day, of each of ``MAPS`` before it learns from it.

    :param recall: share of the images that are rightly matched.
    :param wrong: number of wrong matches.
    :param places: number of places of the map after the day.
    :param vanished: places of the updated map after the day that show replaced buildings.
    :param changes: sentences on what the update changed.
    """

    number: int
    recall: tuple[float, ...]
    wrong: tuple[int, ...]
    places: tuple[int, ...]
    vanished: int
    changes: tuple[str, ...]


def drive_of(days: Days, day: int, positions: dict[int, float]) -> Map:
    """
    Return the drive of a day as a map of all its images.

    :param positions: meters by stamp; the images are added.
    """
    traverse = days.drive(day)
    meters = np.where(traverse.detour, DETOUR - traverse.along, traverse.along)
    positions |= dict(zip(traverse.stamps.tolist(), meters.tolist(), strict=True))
    return build_map(traverse, FeatureExtractor(FEATURES), progress=False)


def measure(
    place_map: Map, drive: Map, positions: dict[int, float], precision: str = 'float32'
) -> tuple[float, int]:
    """Return the share of the images that are rightly matched, and the number of wrong ones."""
    recognizer = PlaceRecognizer(place_map, RecognizerSettings(), precision=precision)
    right = wrong = 0
    for i in range(len(drive)):
        match = recognizer.update(drive.features[i : i + 1], int(drive.stamps[i]))
        if match.accepted:
            image = i - len(match.window_stamps) + 1 + match.position
            stamps = int(drive.stamps[image]), int(place_map.stamps[match.place])
            is_right = abs(positions[stamps[0]] - positions[stamps[1]]) <= TOLERANCE
            right, wrong = right + is_right, wrong + (not is_right)
    return right / len(drive), wrong


def run(days: Days, count: int) -> Iterator[Day]:
    """Yield the results of days 1 to ``count``; the drive of day 0 is the map."""
    positions: dict[int, float] = {}
    first = drive_of(days, 0, positions)
    updated, version = first, Version('', base_places=len(first))
    for number in range(1, count + 1):
        drive, maps = drive_of(days, number, positions), (first, updated, updated)
        measurements = [
            measure(one, drive, positions, precision)
            for one, precision in zip(maps, PRECISIONS, strict=True)
        ]
        try:
            updated, version = update_map(updated, drive, f'day {number}', version)
            changes = version.changes
        except InputError as error:
            changes = (str(error),)
        recall, wrong = zip(*measurements, strict=True)
        begin, low, high = days.built
        rebuilt = EPOCH + begin * DAY if number >= begin else 0
        vanished = sum(
            stamp < rebuilt and low <= positions[stamp] < high for stamp in updated.stamps.tolist()
        )
        places = tuple(map(len, (first, updated, updated)))
        yield Day(number, recall, wrong, places, vanished, changes)


def table(results: list[Day]) -> str:
    """Return the results as a table in Markdown."""
    lines = [
        f'| day | recall: {", ".join(MAPS)} | wrong | places of the updated map | '
        'of them vanished | update |',
        '|' + '---|' * 6,
    ]
    for day in results:
        recall = ' '.join(f'{value:.3f}' for value in day.recall)
        wrong, text = ' '.join(map(str, day.wrong)), '; '.join(day.changes)
        cells = (day.number, recall, wrong, day.places[-1], day.vanished, text)
        lines.append(f'| {" | ".join(map(str, cells))} |')
    return '\n'.join(lines)


def plot(results: list[Day], path: Path) -> None:
    """Draw recall and places by day."""
    numbers = [day.number for day in results]
    with page(path, 9, 6) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        for i, (name, line) in enumerate(zip(MAPS, LINES, strict=True)):
            above.plot(numbers, [day.recall[i] for day in results], line, label=name)
            below.plot(numbers, [day.places[i] for day in results], line)
        above.set_ylabel('recall (share of the images)')
        below.set(xlabel='day (number)', ylabel='places (number)', ylim=(0, None))
        legend_above(above, 3)


def main() -> None:
    """Run the days, and write table and plot with each of them."""
    count, target = int(sys.argv[1]), Path(sys.argv[2])
    file, results = target.with_suffix('.md'), []
    text = f"""# Days

Written by `python3 -m stavpr_lab.demonstration.days {' '.join(sys.argv[1:])}` (`make
days`). The images of a day are matched before the map learns from them.

![recall and places]({target.name}.png)
"""
    days = Days(int(sys.argv[3])) if sys.argv[3:] else Days()
    for day in run(days, count):
        results.append(day)
        file.write_text(f'{text}\n{table(results)}\n')
        plot(results, target.with_suffix('.png'))


if __name__ == '__main__':
    main()
