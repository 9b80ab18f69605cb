# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Real sessions that update a map, beside the first session alone and all sessions kept.

``make days``; the rows are benchmarks/results/sessions.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
import time

from data import data_folder
import numpy as np
from results import parser_of, RESULTS, table, write_lines
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.maintenance.same_places import with_last_related
from stavpr_ros.maintenance.upkeep import update_map
from stavpr_ros.mapping import build_map, Map, merge_maps, select_places
from stavpr_ros.mapping.versions import Version
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.sources import open_source
from stavpr_ros.threads import limit_threads

TEXT = """\
# Real sessions

Written by `python benchmarks/sessions.py` (`make days`). The first session is the map, the next
ones update it, and the last one is matched on it; sums of the orders. Nordland and the track have
two sessions: the even images of the second update the map, the odd ones are matched. The office is
driven in two laps on two days, each lap is a session. Truth of the office and of the track: the
best path of a whole session. Poisoned drives (images of another route, mirrored ones, but for the
closed laps of the office the second half before the first): those that change a map, of all.
Milliseconds of an image on one thread, mean of the orders' medians.
"""
MAPS = 'first session', 'all sessions', 'updated map', 'updated map in int8'
PRECISIONS = 'float32', 'float32', 'float32', 'int8'  # of MAPS
LAP = 207  # images of the office


@dataclass(frozen=True)
class Session:
    """
    All images of a session.

    :param mirrored: the same images, left and right exchanged.
    :param position: position of each image along the route, in images of one session, (N,).
    """

    drive: Map
    mirrored: Map
    position: np.ndarray

    def part(self, images: slice) -> 'Session':
        """Return some of the images."""
        numbers = np.arange(len(self.drive))[images]
        drive, mirrored = (select_places(each, numbers) for each in (self.drive, self.mirrored))
        return Session(drive, mirrored, self.position[images])


@dataclass(frozen=True)
class Route:
    """
    Sessions of a route, and their orders: map, updates, query.

    :param period: images of a lap; infinite = not closed.
    """

    name: str
    tolerance: int
    orders: Sequence[Sequence[Session]]
    period: float = np.inf


def path(reference: Map, drive: Map, is_closed: bool) -> np.ndarray:
    """Return the best path of a whole drive on a reference, (N,)."""
    d = PlaceRecognizer(reference, RecognizerSettings()).distances(drive.features)
    z = (d - d.mean(axis=1, keepdims=True)) / d.std(axis=1, keepdims=True)
    n, numbers = len(reference), np.arange(len(reference))
    steps, cost = np.zeros(z.shape, int), np.where(numbers < 20, z[0], np.inf)
    for i in range(1, len(z)):
        before = np.array([np.roll(cost, step) for step in range(5)])
        if not is_closed:
            for step in range(1, 5):
                before[step, :step] = np.inf
        before[[0, 3, 4]] += 0.5  # the camera seldom stands or is so fast
        steps[i] = before.argmin(axis=0)
        cost = before.min(axis=0) + z[i]
    at = [int(cost.argmin())]
    for i in range(len(z) - 1, 0, -1):
        at.append((at[-1] - steps[i, at[-1]]) % n)
    return np.array(at[::-1])


def routes(folder: Path) -> Iterator[Route]:
    """Yield the routes with several sessions."""

    def session(name: str, reference: Map | None = None, is_closed: bool = False) -> Session:
        source = open_source(folder / name)
        flipped = (replace(frame, image=np.fliplr(frame.image)) for frame in source)
        drive, mirrored = (
            replace(drive, stamps=(1 + np.arange(len(drive))) * 10**9, same_as=None)
            for drive in (
                build_map(images, FeatureExtractor('gradient'), progress=False)
                for images in (source, flipped)
            )
        )
        numbers = np.arange(len(drive))
        position = numbers if reference is None else path(reference, drive, is_closed)
        return Session(drive, mirrored, position)

    odd, even = slice(1, None, 2), slice(0, None, 2)
    names = 'left_day', 'right_day', 'right_night'
    walks = [session(f'walk_by_night/{name}') for name in names]
    yield Route('walk, 6 orders', 2, tuple(permutations(walks)))
    left, right = (session(f'gardens_point/{name}') for name in ('day_left', 'day_right'))
    yield Route('Gardens Point, night last', 2, [(left, right, walks[2]), (right, left, walks[2])])
    summer, winter = (session(f'nordland_64x32/{name}') for name in ('summer', 'winter'))
    yield Route('Nordland', 3, [(summer, winter.part(even), winter.part(odd))])
    first = session('office_circuit/day1').drive
    lap = select_places(first, np.arange(LAP))
    days = [session(f'office_circuit/{day}', lap, True) for day in ('day1', 'day2')]
    one, two, three, four = (day.part(slice(a, a + LAP)) for day in days for a in (0, LAP))
    orders = (one, two, three, four), (one, three, two, four), (three, four, one, two)
    yield Route('office, 3 orders', 5, orders, LAP)
    track = session('running_track/lap1')
    other = session('running_track/lap2', track.drive)
    yield Route('track', 10, [(track, other.part(even), other.part(odd))])


def measure(
    place_map: Map,
    positions: dict[int, float],
    query: Session,
    route: Route,
    precision: str,
) -> tuple[np.ndarray, float]:
    """Return right and wrong matches, and ms of an image; positions by the stamps of the map."""
    one = PlaceRecognizer(place_map, RecognizerSettings(), precision=precision)
    counts, times = np.zeros(2, int), []
    for i in range(len(query.drive)):
        began = time.thread_time()
        match = one.update(query.drive.features[i : i + 1], int(query.drive.stamps[i]))
        times.append(1e3 * (time.thread_time() - began))
        if match.accepted:
            image = i - len(match.window_stamps) + 1 + match.position
            off = abs(query.position[image] - positions[int(place_map.stamps[match.place])])
            counts[int(min(off, route.period - off) > route.tolerance)] += 1
    return counts, float(np.median(times))


def poisoned_drives(session: Session, other: Map, is_closed: bool) -> Iterator[Map]:
    """Yield drives that must not change a map: another route, mirrored, the wrong start."""
    yield other
    yield session.mirrored
    n = len(session.drive)
    if not is_closed:  # a lap may begin anywhere
        yield select_places(session.drive, np.r_[n // 2 : n, : n // 2])


def drive_route(route: Route, other: Map) -> list[str]:
    """Return the cells of a route."""
    counts, places, times, changes = np.zeros((4, 2), int), np.zeros(4, int), np.zeros(4), []
    images = changed = poisons = 0
    for order in route.orders:
        positions: dict[int, float] = {}
        drives = []
        for number, session in enumerate(order[:-1]):
            stamps = session.drive.stamps + number * 10**15
            positions |= dict(zip(stamps.tolist(), session.position.tolist(), strict=True))
            drives.append(replace(session.drive, stamps=stamps))
        everything = first = merge_maps([drives[0]], ['0'])
        for number, drive in enumerate(drives[1:], 1):
            everything = with_last_related(merge_maps([everything, drive], ['', str(number)]))
        updated, version = drives[0], Version('', base_places=len(first))
        for number, drive in enumerate(drives[1:], 1):
            for bad in poisoned_drives(order[number], other, np.isfinite(route.period)):
                after, _, _ = update(updated, bad, version, 'poisoned')
                poisons, changed = poisons + 1, changed + (len(after) != len(updated))
            updated, version, text = update(updated, drive, version, str(number))
            changes.append(text)
        maps = first, everything, updated, updated
        for row, (place_map, precision) in enumerate(zip(maps, PRECISIONS, strict=True)):
            matches, ms = measure(place_map, positions, order[-1], route, precision)
            counts[row] += matches
            times[row] += ms / len(route.orders)
            places[row] += len(place_map)
        images += len(order[-1].drive)
    recall = ' '.join(f'{right / images:.3f}' for right, _ in counts)
    took = ' '.join(f'{ms:.2f}' for ms in times)
    wrong, sizes = (' '.join(map(str, column.tolist())) for column in (counts[:, 1], places))
    print(*changes, sep='\n')
    return [route.name, str(images), recall, wrong, sizes, took, f'{changed} of {poisons}']


def update(place_map: Map, drive: Map, version: Version, name: str) -> tuple[Map, Version, str]:
    """Return a map after a drive, its version, and what has changed; a rejected one: why."""
    try:
        place_map, version = update_map(place_map, drive, name, version)
    except InputError as error:
        return place_map, version, str(error)
    return place_map, version, '; '.join(version.changes)


def main() -> None:
    """Write the rows, with each route those so far."""
    parser_of(__doc__).parse_args()
    limit_threads(1)
    listed = list(routes(data_folder()))
    others = [route.orders[0][0].drive for route in [*listed[2:], *listed[:2]]]
    maps = ', '.join(MAPS)
    columns = ['route', 'images', f'recall: {maps}', 'wrong', 'places', 'ms', 'poisoned']
    rows = []
    for route, other in zip(listed, others, strict=True):
        rows.append(drive_route(route, other))
        write_lines(RESULTS / 'sessions.md', [TEXT, *table(columns, rows)])


if __name__ == '__main__':
    main()
