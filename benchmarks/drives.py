# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Drives that the evidence is fitted on: of one session while the camera moves, and off the map.

The same, at half, double and triple speed, and with 30 % of the images lost; damaged ones without
the other speeds; of Nordland, the second half of the query decides and the first one is fitted on.
Off the map: floors that look alike, reverse drives, unrelated routes, and stretches that the map
lacks. Groups: Gardens Point with the walk, corridor, Nordland, office, track, two halves of the
tower, reverse drives; unrelated routes are of both groups.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from accuracy import short_cases
import cv2
import numpy as np
from off_map import extract_map, Pair, stretches
from sessions import LAP, path
from stavpr_lab.evaluation.drive import Drive as ChangedDrive
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import Map, select_places
from stavpr_ros.sources import open_source

CHANGES = 'same', 'drop 0.3', '0.5x', '2x', '3x'  # the first two of damaged drives, and --quick
HALF = 450  # images of a half of Nordland that are shown
DETOURS = 6  # stretches that the map lacks, a pair
MAX_PLACES = 400  # places of a map of the track, of an unrelated route
SETS = (
    'day', 'crops', 'night', 'night map', 'damaged night', 'corridor', 'summer map', 'winter map',
    'office', 'track',
)  # fmt: skip
NEGATIVES = 'floors', 'reverse', 'unrelated', 'unseen'
DAMAGES = 'dark', 'covered', 'rolled', 'rain', 'crop 0.14'


class Sets(NamedTuple):
    """Pairs with the set that they count for and their group; negatives with kind and groups."""

    pairs: list[tuple[str, str, Pair]]
    negatives: list[tuple[str, tuple[str, ...], Map, Map]]


@dataclass(frozen=True, eq=False)
class Drive:
    """
    A query on a map.

    :param kind: the set, or the kind of negatives.
    :param groups: drives with one of these are left out together.
    :param images: recorded image of each; equal ones in a row are of a camera at rest.
    :param truth: None = no match is right; unseen: the place was removed from the map.
    :param use: ``both``, or only ``fit`` or ``decide``.
    """

    kind: str
    groups: tuple[str, ...]
    places: Map
    features: LocalFeatures
    stamps: np.ndarray
    images: np.ndarray
    truth: GroundTruth | None = None
    unseen: np.ndarray | None = None
    use: str = 'both'


def damage_image(image: np.ndarray, damage: str) -> np.ndarray:
    """Return an image of a darker, covered, rolled or wet camera, or of a narrower view."""
    h, w = image.shape[:2]
    kind, _, share = damage.partition(' ')
    out: Any = image.astype(np.float32)
    if kind == 'dark':
        out *= 0.35
    elif kind == 'covered':
        out[:, : w * 3 // 10] = 10
    elif kind == 'rolled':
        turn = cv2.getRotationMatrix2D((w / 2, h / 2), 6, 1.08)
        out = cv2.warpAffine(out, turn, (w, h), borderMode=cv2.BORDER_REPLICATE)
    elif kind == 'rain':
        rng, drops = np.random.default_rng(0), np.zeros((h, w), np.float32)
        for x, y in rng.integers((w, h), size=(150, 2)).tolist():
            cv2.line(drops, (x, y), (x + h // 50, y + h // 16), 60.0, max(1, w // 400))
        out = 0.8 * cv2.GaussianBlur(out, (0, 0), w / 250) + 15
        out += cv2.GaussianBlur(drops, (0, 0), 1)[..., None]
    else:  # crop: on the left; zoom: on all sides
        x = int(float(share) * w)
        y, right = (int(float(share) * h), w - x) if kind == 'zoom' else (0, w)
        out = cv2.resize(out[y : h - y, x:right], (w, h))
    return np.clip(out, 0, 255).astype(np.uint8)


def read_sets(folder: Path, making: FeatureExtractor, gradient: FeatureExtractor) -> Sets:
    """Extract the features; the truth of office and track is the best path by gradient."""

    def read(name: str, damage: str = '', by: FeatureExtractor = making) -> Map:
        source: Any = open_source(folder / name)
        if damage:
            source = [replace(f, image=damage_image(f.image, damage)) for f in source]
        return extract_map(source, by)

    sets, places = Sets([], []), dict[str, Map]()
    named = {'walk_day': 'day', 'walk_night': 'night', 'walk_night_map': 'night map'}
    for case in short_cases(folder):
        reference, query = extract_map(case.places, making), extract_map(case.query, making)
        truth = case.truth(len(query), len(reference))
        kind = {'gardens_point': 'day', 'corridor': 'corridor', **named}[case.name]
        group = 'corridor' if kind == 'corridor' else 'gardens'
        sets.pairs.append((kind, group, Pair(case.name, reference, query, truth)))
        places.setdefault(group, reference)
        if case.name in ('gardens_point', 'walk_night'):
            is_day = kind == 'day'
            name = 'gardens_point/day_right' if is_day else 'walk_by_night/right_night'
            for damage in ('crop 0.14', 'crop 0.28', 'zoom 0.075') if is_day else DAMAGES:
                pair = Pair(damage, reference, read(name, damage), truth)
                sets.pairs.append(('crops' if is_day else 'damaged night', group, pair))
    summer, winter = (read(f'nordland_64x32/{name}') for name in ('summer', 'winter'))
    for kind, reference, query in ('summer map', summer, winter), ('winter map', winter, summer):
        truth = GroundTruth.identity(len(query), len(reference), 3)
        sets.pairs.append((kind, 'nordland', Pair(kind, reference, query, truth)))
    places['nordland'] = _first(summer)
    laps = ('office', 'office_circuit/day1', 'office_circuit/day2', LAP, 5), (
        'track', 'running_track/lap1', 'running_track/lap2', None, 7)  # fmt: skip
    for kind, first, second, end, tolerance in laps:
        lap, other = (_cut(read(name), end) for name in (first, second))
        truths = (_cut(read(name, '', gradient), end) for name in (first, second))
        position = path(next(truths), next(truths), bool(end))
        n, off = len(lap), np.arange(-tolerance, tolerance + 1)
        around = position[:, None] + off
        around = around % n if end else np.clip(around, 0, n - 1)
        queries = np.repeat(np.arange(len(other)), len(off))
        truth = GroundTruth.from_pairs(queries, around.ravel(), len(other), n)
        truth = truth.on_places(np.arange(min(n, MAX_PLACES)))
        counted = np.flatnonzero(truth.has_match)[:: 1 if end else 2]
        lap, other = _first(lap), select_places(other, counted)
        sets.pairs.append((kind, kind, Pair(kind, lap, other, truth.select(counted))))
        places[kind] = lap
    towers = sorted(floor.name for floor in (folder / 'tower').iterdir() if floor.is_dir())
    for half in towers[::2], towers[1::2]:
        floors = {name: read(f'tower/{name}') for name in half}
        for a, b in ((a, b) for a in half for b in half if a != b):
            sets.negatives.append(('floors', (half[0],), floors[a], floors[b]))
        places[half[0]] = floors[half[0]]
    driven = {
        f'{car}/{direction}': read(f'both_ways/{car}/{direction}')
        for car in ('car_a', 'car_b') for direction in ('forward', 'backward')
    }  # fmt: skip
    for a, b in ((a, b) for a in driven for b in driven):
        if a.partition('/')[2] != b.partition('/')[2]:
            sets.negatives.append(('reverse', ('reverse',), driven[a], driven[b]))
    for a, b in ((a, b) for a in places for b in places if a != b):
        query = select_places(places[b], np.arange(min(100, len(places[b]))))
        sets.negatives.append(('unrelated', (a, b), places[a], query))
    return sets


def _cut(places: Map, end: int | None) -> Map:
    return select_places(places, np.arange(len(places))[:end])


def _first(places: Map) -> Map:
    return _cut(places, MAX_PLACES)


def drives_of(sets: Sets, quick: bool) -> Iterator[Drive]:
    """Yield all drives; ``quick``: two changes and fewer detours a pair, half of the negatives."""
    for kind, group, pair in sets.pairs:
        is_few, n = quick or kind in ('crops', 'damaged night'), len(pair.query)
        for name in CHANGES[:2] if is_few else CHANGES:
            drive = DriveChanges.from_name(name, n).apply(pair.truth)
            if not pair.long:
                yield _of_pair(kind, group, pair, drive, np.arange(len(drive.images)))
                continue
            for use, first in (('fit', 0), ('decide', n // 2)):
                begin = int(np.searchsorted(drive.images, first))
                end = int(np.searchsorted(drive.images, first + n // 2))
                part = np.arange(begin, min(end, begin + HALF))
                yield _of_pair(kind, group, pair, drive, part, use)
        if kind in ('crops', 'damaged night', 'track'):
            continue
        listed = stretches(pair)
        for at in np.linspace(0, len(listed) - 1, DETOURS // 2 if quick else DETOURS).astype(int):
            first, last = listed[at]
            drive = DriveChanges(removed=((first, last),)).apply(pair.truth)
            part = np.arange(len(drive.images))[max(0, first - 80) : last + 60]
            use = 'both' if not pair.long else 'fit' if first < n // 2 else 'decide'
            yield _of_pair(kind, group, pair, drive, part, use)
    for kind, groups, places, query in sets.negatives[:: 2 if quick else 1]:
        images = np.arange(min(len(query), MAX_PLACES))
        stamps = (images + 1) * 100_000_000
        yield Drive(kind, groups, places, query.features[images], stamps, images)


def _of_pair(
    kind: str, group: str, pair: Pair, drive: ChangedDrive, part: np.ndarray, use: str = 'both'
) -> Drive:
    unseen, removed = None, drive.removed
    if removed:
        unseen = np.any(drive.unseen(), axis=0)[part]
    places = select_places(pair.places, drive.places) if removed else pair.places
    images = drive.images[part]
    features, truth = pair.query.features[images], drive.truth.select(part)
    return Drive(kind, (group,), places, features, drive.stamps[part], images, truth, unseen, use)
