# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The contest of three methods: today's, today's less single mechanisms, and a small filter.

``python benchmarks/contest.py``; ``--quick``: fewer drives; ``--rows a c``, ``--features g``.
Rows: a, mode robust with its defaults; b, the same with one mechanism removed, each in a process
of its own; c, the small filter of contest_filter.py on the same distances. What is fitted is
fitted without the set that it is shown on. Writes benchmarks/results/contest.md.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
import multiprocessing
import os
from pathlib import Path
import pickle
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any, NamedTuple
import zlib

from accuracy import short_cases
from contest_filter import SmallFilter, SmallModel
import cv2
from data import data_folder
from numba.core.caching import NullCache
import numpy as np
from off_map import extracted, extractor, Pair, stretches
from off_map_page import HYBRID, KINDS
from results import environment, heading, options_parser, table, write_lines
from sessions import LAP, path
from stavpr_lab.evaluation.drive import Drive as ChangedDrive
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.alignment.settings import SpatialSettings
from stavpr_ros.features import FeatureExtractor, LocalFeatures, registry
from stavpr_ros.filter import checks, choice, evidence, refine
from stavpr_ros.filter.model import MODEL
from stavpr_ros.filter.motion import ImageChange
from stavpr_ros.filter.place_filter import PlaceFilter
from stavpr_ros.mapping import PlaceMap, select_places
from stavpr_ros.prepare import centering
from stavpr_ros.recognition import filter_window, PlaceRecognizer, RecognizerSettings
from stavpr_ros.recognition.cells import CellAgreement
from stavpr_ros.recognition.error_rate import least_probability
from stavpr_ros.recognition.settings import RobustOptions
from stavpr_ros.sources import open_source

LENGTH = SmallModel.length
MIDDLE = (LENGTH - 1) // 2
CHANGES = 'same', 'drop 0.3', '0.5x', '2x', '3x'  # the first two of damaged drives, and --quick
HALF = 450  # images of a half of Nordland that are shown
DETOURS = 6  # stretches that the map lacks, a pair
MOST = 400  # places of a map of the track, of an unrelated route
SETS = (
    'day', 'crops', 'night', 'night map', 'damaged night', 'corridor', 'summer map', 'winter map',
    'office', 'track',
)  # fmt: skip
NEGATIVES = 'floors', 'reverse', 'unrelated', 'unseen'
DAMAGES = 'dark', 'covered', 'rolled', 'rain', 'crop 0.14'
ERRORS = 0.05, 0.01
EQUAL = 'as .5', 'as .01'  # of row a
AND = '; '  # between mechanisms that are removed together
SURE = float(np.log(1 / (1 / least_probability(0.01) - 1)))  # log odds of today's .01
A = {'p': 0, 'lead': 1, 'cells': 2, 'recent': 3}  # columns of the quantities of row a
C = {'belief': 0, 'lead': 1, 'cells': 2, 'excess': 3, 'share': 4, 'uneven': 5}  # of row c
CERTAIN = 4.0  # log odds of the belief of row c at most, before the checks


# ------------------------------------------------ sets


class Sets(NamedTuple):
    """Pairs with the set that they count for and their group; negatives with kind and groups."""

    pairs: list[tuple[str, str, Pair]]
    negatives: list[tuple[str, tuple[str, ...], PlaceMap, PlaceMap]]


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
    places: PlaceMap
    features: LocalFeatures
    stamps: np.ndarray
    images: np.ndarray
    truth: GroundTruth | None = None
    unseen: np.ndarray | None = None
    use: str = 'both'


def damaged(image: np.ndarray, damage: str) -> np.ndarray:
    """Return an image of a darker, covered, rolled or wet camera, or of one that sees less."""
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

    def read(name: str, damage: str = '', by: FeatureExtractor = making) -> PlaceMap:
        source: Any = open_source(folder / name)
        if damage:
            source = [replace(f, image=damaged(f.image, damage)) for f in source]
        return extracted(source, by)

    sets, places = Sets([], []), dict[str, PlaceMap]()
    named = {'walk_day': 'day', 'walk_night': 'night', 'walk_night_map': 'night map'}
    for case in short_cases(folder):
        reference, query = extracted(case.places, making), extracted(case.query, making)
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
        truth = truth.on_places(np.arange(min(n, MOST)))
        counted = np.flatnonzero(truth.has_match)[:: 1 if end else 2]
        lap, other = _first(lap), select_places(other, counted)
        sets.pairs.append((kind, kind, Pair(kind, lap, other, truth.select(counted))))
        places[kind] = lap
    towers = sorted(each.name for each in (folder / 'tower').iterdir() if each.is_dir())
    for half in towers[::2], towers[1::2]:
        floors = {name: read(f'tower/{name}') for name in half}
        for a, b in ((a, b) for a in half for b in half if a != b):
            sets.negatives.append(('floors', (half[0],), floors[a], floors[b]))
        places[half[0]] = floors[half[0]]
    ways = {
        f'{car}/{way}': read(f'both_ways/{car}/{way}')
        for car in ('car_a', 'car_b') for way in ('forward', 'backward')
    }  # fmt: skip
    for a, b in ((a, b) for a in ways for b in ways if a.partition('/')[2] != b.partition('/')[2]):
        sets.negatives.append(('reverse', ('reverse',), ways[a], ways[b]))
    for a, b in ((a, b) for a in places for b in places if a != b):
        query = select_places(places[b], np.arange(min(100, len(places[b]))))
        sets.negatives.append(('unrelated', (a, b), places[a], query))
    return sets


def _cut(places: PlaceMap, end: int | None) -> PlaceMap:
    return select_places(places, np.arange(len(places))[:end])


def _first(places: PlaceMap) -> PlaceMap:
    return _cut(places, MOST)


def drives_of(sets: Sets, quick: bool) -> Iterator[Drive]:
    """Yield all drives; ``quick``: two changes and fewer detours a pair, half of the negatives."""
    for kind, group, pair in sets.pairs:
        is_few, n = quick or kind in ('crops', 'damaged night'), len(pair.query)
        for name in CHANGES[:2] if is_few else CHANGES:
            drive = DriveChanges.named(name, n).apply(pair.truth)
            if not pair.long:
                yield _of_pair(kind, group, pair, drive, np.arange(len(drive.images)))
                continue
            for use, first in (('fit', 0), ('decide', n // 2)):
                begin = int(np.searchsorted(drive.images, first))
                end = int(np.searchsorted(drive.images, first + n // 2))
                shown = np.arange(begin, min(end, begin + HALF))
                yield _of_pair(kind, group, pair, drive, shown, use)
        if kind in ('crops', 'damaged night', 'track'):
            continue
        listed = stretches(pair)
        for at in np.linspace(0, len(listed) - 1, DETOURS // 2 if quick else DETOURS).astype(int):
            first, last = listed[at]
            drive = DriveChanges(removed=((first, last),)).apply(pair.truth)
            shown = np.arange(len(drive.images))[max(0, first - 80) : last + 60]
            use = 'both' if not pair.long else 'fit' if first < n // 2 else 'decide'
            yield _of_pair(kind, group, pair, drive, shown, use)
    for kind, groups, places, query in sets.negatives[:: 2 if quick else 1]:
        images = np.arange(min(len(query), MOST))
        stamps = (images + 1) * 100_000_000
        yield Drive(kind, groups, places, query.features[images], stamps, images)


def _of_pair(
    kind: str, group: str, pair: Pair, drive: ChangedDrive, shown: np.ndarray, use: str = 'both'
) -> Drive:
    unseen, removed = None, drive.removed
    if removed:
        unseen = np.any(drive.unseen(), axis=0)[shown]
    places = select_places(pair.places, drive.places) if removed else pair.places
    images = drive.images[shown]
    features, truth = pair.query.features[images], drive.truth.select(shown)
    return Drive(kind, (group,), places, features, drive.stamps[shown], images, truth, unseen, use)


# ------------------------------------------------ mechanisms


def _constants(module: Any, **values: Any) -> Callable[[], None]:
    """Return a function that sets constants of a module, or of the model of the filter."""

    def apply() -> None:
        for name, value in values.items():
            if module is MODEL:
                object.__setattr__(MODEL, name, value)
            else:
                setattr(module, name, value)

    return apply


def _settings(**values: Any) -> Callable[[], None]:
    def apply() -> None:
        global SETTINGS  # noqa: PLW0603  (of this process)
        SETTINGS = replace(SETTINGS, **values)

    return apply


def _no_speed_prior() -> None:
    update = PlaceFilter.update
    PlaceFilter.update = lambda self, z, weight, speeds, *rest: update(  # type: ignore
        self, z, weight, np.ones_like(speeds), *rest
    )


def _no_change() -> None:
    _no_speed_prior()
    _constants(MODEL, speed_weight=1e-9)()


def _no_refinement() -> None:
    def refined(z: Any, path: Any, exponents: Any, images: Any, *_: Any) -> Any:
        near, moves = z[:, refine.BAND], np.diff(images, prepend=-1) != 0
        masses = np.zeros(z.shape)
        masses[:, refine.BAND] = 1
        uneven = checks.unevenness(path, near)
        return path, path, near, masses, uneven, near[moves & np.isfinite(near)]

    vars(choice)['refined'] = refined


def _no_straight_paths() -> None:
    refine.EVENLY = 0.0
    for each in (refine.refine, refine.refined):  # the cache does not know of the constant
        each._cache = NullCache()


def _no_stamps() -> None:
    refined = refine.refined
    vars(choice)['refined'] = lambda z, path, exponents, numbers, stamps, *rest: refined(
        z, path, exponents, numbers, np.zeros_like(stamps), *rest
    )
    choice.PathChoice.learn_times = lambda *_: None  # type: ignore


SETTINGS = RecognizerSettings()
MECHANISMS: dict[str, Callable[[], Any]] = {
    'evenness of z': _constants(checks, UNEVEN_WEIGHT=0.0),
    'excess motion': _constants(checks, EXCESS_WEIGHT=0.0),
    'both checks of the path': _constants(checks, UNEVEN_WEIGHT=0.0, EXCESS_WEIGHT=0.0),
    'three candidates': _constants(choice, CANDIDATES=1),
    'levels': _constants(MODEL, levels=(-2.3,)),
    'prior of the speed': _no_speed_prior,
    'likelihood of the speed': _constants(MODEL, speed_weight=1e-9),
    'image change in the filter': _no_change,
    'alpha by change': _constants(MODEL, most_change=1.0, least_change=1.0),
    'offsets beside the path': _no_refinement,
    'straight paths': _no_straight_paths,
    'times by stamps': _no_stamps,
    'half of the speeds': _constants(MODEL, speeds=(0.0, *MODEL.speeds[1::2])),
    'one place more or less': _constants(MODEL, spread=0.0),
    'leaving and entering': _constants(MODEL, leave=1e-9, enter=1e-9),
    'limit of own evidence': _constants(evidence, GAIN=1e9),
    'sure windows': _constants(evidence, SURE=np.inf),
    "running mean of the query's features": _constants(centering, PRIOR=10**9),
    'whitening': _settings(robust_options=RobustOptions(whitening=False)),
    'places weighted by change': _constants(centering, change_weights=lambda c: np.ones(len(c))),
    'equal places left out': _constants(ImageChange, distinct=lambda _, n: np.ones(n, bool)),
    "the map's stops": _constants(ImageChange, at_rest=lambda _: np.empty(0, np.int64)),
    'dark stretches': _constants(ImageChange, is_dark_stretch=lambda *_: False),
    'rest of the camera': _constants(ImageChange, is_standstill=lambda *_: False),
    'shifts of two strips': _settings(spatial=SpatialSettings('rigid', xi=2)),
    'all shifts': _settings(spatial=SpatialSettings('rigid', xi=1)),
}  # each in a process of its own, which ends afterwards
TERMS = {
    'p of the regression': [1, 2, 3], 'lead of the regression': [0, 2, 3],
    'cells of the regression': [0, 1, 3], 'recent windows': [0, 1, 2],
}  # fmt: skip


# ------------------------------------------------ what windows show


class Recorder:
    """
    Drives a query on a map by mode robust, and notes what each window shows.

    ``rows`` are image, place, images of the window, log odds, and the quantities ``A``.
    """

    def __init__(self, places: PlaceMap) -> None:
        self.recognizer = recognizer = PlaceRecognizer(places, SETTINGS)
        self.window: Any = recognizer._window
        self._match, self._newest = self.window.match, self.window.match_newest
        self._push = self.window.push
        vars(self.window).update(match=self.match, match_newest=self.match_newest, push=self.push)
        filter_window.own_evidence = self._own_evidence  # type: ignore
        self.rows: list[tuple[float, ...]] = []
        self._evidence: list[tuple[float, ...]] = []
        self.image, self.strips = -1, np.empty(0)

    def push(self, row: Any, strips: np.ndarray, stamp: int) -> None:
        """Keep the strips of an image."""
        self._push(row, strips, stamp)
        self.image, self.strips = self.image + 1, strips

    def _own_evidence(self, constant: float, p: float, lead: float, l: int, cells: float) -> float:
        self._evidence.append((p, lead, l, cells))
        return evidence.own_evidence(constant, p, lead, l, cells)

    def match(self, radius: int) -> Any:
        """Match a window, with the share of recent windows before it."""
        recent = self.window.recent.share
        return self._noted(self._match(radius), recent)

    def match_newest(self, radius: int) -> Any:
        """Match the newest images."""
        return self._noted(self._newest(radius), self.window.recent.share)

    def _noted(self, match: Any, recent: float) -> Any:
        if match.nearest is not None:
            p, lead, l, cells = (self._evidence or [(0.0, 0.0, 1, 0.0)])[0]
            l = match.images or len(self.window.images)
            quantities = _log_odds(p), np.log1p(l * lead), np.log1p(max(cells, 0.0))
            recent = min(0.0, float(_log_odds(recent, 0.2)))
            # whole windows have the number 0: also those of few images that moved
            row = self.image - (l - 1) + (l - 1) // 2, match.nearest.middle, match.images
            self.rows.append((*row, _log_odds(match.probability, 1e-12), *quantities, recent))
        self._evidence.clear()
        return match


def _log_odds(p: float, least: float = 1e-4) -> float:
    p = float(min(max(p, least), 1 - least))
    return float(np.log(p / (1 - p)))


class SmallRecorder:
    """
    Drives the small filter on the distances of a recorder.

    ``rows`` are as of the recorder, log odds of 0, with the quantities ``C``; ``kept`` are the
    images that moved.

    :param weighted: with today's weight of an image by its change.
    """

    def __init__(self, recorder: Recorder, weighted: bool) -> None:
        self.recorder, self.window, self.weighted = recorder, recorder.window, weighted
        self.filter, self.cells = SmallFilter(recorder.recognizer.places), None
        if self.window.cells is not None:
            strips_of = recorder.recognizer._matcher.strips_of
            self.cells = CellAgreement(self.window.cells._cells, strips_of, LENGTH)
        self.kept: list[int] = []
        self.rows: list[tuple[float, ...]] = []

    def update(self) -> None:
        """Add the recorder's newest image, unless the camera is at rest."""
        small, change = self.filter, self.window.change
        # at rest, unless the map's own images are equal there
        if self.window.is_standstill and not change.is_dark_stretch(small.by_place):
            return
        self.kept.append(self.recorder.image)
        weight = change.weight(float(self.window.images['change'][-1])) / MODEL.weight
        z = self.recorder.recognizer.newest_row()[: self.recorder.recognizer.places]
        small.update(z, weight if self.weighted else 1.0)
        if self.cells is not None:
            self.cells.push(self.recorder.strips)
        if (shown := small.window()) is None:
            return
        l, agreeing = min(small.count, LENGTH), 0.0
        if self.cells is not None:
            agreeing = self.cells.lead(np.ones(l, bool), shown.path, shown.competitor)
        image = self.kept[len(self.kept) - l + shown.position]
        row = image, round(shown.place), 0 if l == LENGTH else l, 0.0
        excess = change.excess(max(shown.speed, 0.0))
        uneven = checks.unevenness(shown.path, shown.z)
        leads = np.log1p(l * shown.lead), np.log1p(max(agreeing, 0.0))
        self.rows.append((*row, _log_odds(shown.belief), *leads, excess, shown.share, uneven))


Shown = list[tuple[np.ndarray, np.ndarray]]


def recorded(drive: Drive, with_small: bool) -> Shown:
    """Return rows and images that moved, by today's method and by both forms of the filter."""
    recorder = Recorder(drive.places)
    small = [SmallRecorder(recorder, weighted) for weighted in (False, True)[: 2 * with_small]]
    for i, stamp in enumerate(drive.stamps.tolist()):
        recorder.recognizer.update(drive.features[i : i + 1], stamp)
        for each in small:
            each.update()
    rows = np.array(recorder.rows, float).reshape(-1, 4 + len(A))
    return [(rows, np.arange(len(drive.images)))] + [
        (np.array(each.rows, float).reshape(-1, 4 + len(C)), np.array(each.kept)) for each in small
    ]


def record(feature: str, mechanism: str, quick: bool, sets: Path, to: Path) -> None:
    """Write what the windows of all drives show, without a mechanism; '' = with all."""
    for name in filter(None, mechanism.split(AND)):
        MECHANISMS[name]()
    with sets.open('rb') as file:
        drives = list(drives_of(pickle.load(file), quick))
    if mechanism:  # nothing is fitted on it
        drives = [replace(d, stamps=d.stamps[:0]) if d.use == 'fit' else d for d in drives]
    began = time.perf_counter()
    windows = [recorded(each, not mechanism) for each in drives]
    to.write_bytes(pickle.dumps(windows))
    print(feature, mechanism or 'now', f'{time.perf_counter() - began:.0f} s', flush=True)


# ------------------------------------------------ evidence


@dataclass(frozen=True, eq=False)
class Windows:
    """
    The windows of all drives with one kind of features, or with several; arrays (M, ...).

    :param drive: number of the drive; early: of the newest images alone.
    :param x: quantities; score: log odds, if the row has a probability.
    """

    drives: tuple[Drive, ...]
    feature: np.ndarray
    drive: np.ndarray
    early: np.ndarray
    x: np.ndarray
    score: np.ndarray
    right: np.ndarray
    has_match: np.ndarray
    unseen: np.ndarray

    def each(self, value: Callable[[Drive], Any]) -> np.ndarray:
        """Return a value of the drive of each window, (M,)."""
        return np.array([value(drive) for drive in self.drives])[self.drive]

    @classmethod
    def of(cls, drives: Sequence[Drive], rows: Sequence[Any], feature: str) -> 'Windows':
        """Judge what windows show; images that have no whole window are of no place."""
        parts = []
        for number, (drive, (of_drive, moved)) in enumerate(zip(drives, rows, strict=True)):
            whole = of_drive[:, 2] == 0
            early, full = of_drive[~whole], of_drive[whole]
            full = full[np.unique(full[:, 0], return_index=True)[1]]
            counted = _counted(drive.images)
            # an image of a camera at rest has the match of the last one that moved
            last = moved[np.searchsorted(moved, counted, 'right') - 1]
            full = np.append(full, np.full((1, full.shape[1]), np.inf), axis=0)
            at = np.searchsorted(full[:, 0], last)
            shown = full[at]
            is_missing = shown[:, 0] != last
            shown[is_missing], shown[is_missing, 1], shown[is_missing, 3:5] = 0, -1, _log_odds(0)
            images = np.append(counted, early[:, 0]).astype(int)
            both = np.concatenate([shown, early])
            right = has = unseen = np.zeros(len(images), bool)
            if drive.truth is not None and len(images):
                truth = drive.truth.select(images)
                right, has = truth.accepts(both[:, 1].astype(int)), truth.has_match
            if drive.unseen is not None:
                unseen = drive.unseen[images]
            is_early = np.arange(len(images)) >= len(counted)
            parts.append((
                np.full(len(images), feature), np.full(len(images), number), is_early,
                both[:, 4:], both[:, 3], right, has, unseen,
            ))  # fmt: skip
        columns = [np.concatenate(each) for each in zip(*parts, strict=True)]
        return cls(tuple(drives), *columns)

    @classmethod
    def pooled(cls, parts: Sequence['Windows']) -> 'Windows':
        """Return windows of several kinds of features as one."""
        names = [name for name in cls.__dataclass_fields__ if name != 'drives']
        columns = (np.concatenate([getattr(each, name) for each in parts]) for name in names)
        return cls(parts[0].drives, *columns)


def _counted(images: np.ndarray) -> np.ndarray:
    """Return the images in the middle of a whole window of images that moved, (m,)."""
    number = np.cumsum(np.diff(images, prepend=images[:1]) != 0)
    return np.flatnonzero((number >= MIDDLE) & (number[-1] - number >= LENGTH - 1 - MIDDLE))


def fit(x: np.ndarray, right: np.ndarray, weights: np.ndarray, ridge: float = 1e-3) -> np.ndarray:
    """
    Return the weights of a logistic regression, (Q,), by Newton's method.

    :param x: (M, Q), a constant among the quantities; right: (M,); weights: (M,), mean 1.
    :param ridge: of each weight's square, over the number of windows.
    """
    w, penalty = np.zeros(x.shape[1]), ridge * len(x) / 2
    for _ in range(50):
        p = 1 / (1 + np.exp(-np.clip(x @ w, -30, 30)))
        curvature = (x * (weights * p * (1 - p))[:, None]).T @ x + penalty * np.eye(len(w))
        step = np.linalg.solve(curvature, x.T @ (weights * (right - p)) - penalty * w)
        w = w + step
        if np.abs(step).max() < 1e-6:
            break
    return w


def fit_weights(windows: Windows) -> np.ndarray:
    """Return the weight of each window: equal for groups and kinds of negatives, 0 = not used."""
    label = windows.each(lambda d: d.kind if d.truth is None else d.groups[0])
    is_detour = windows.each(lambda d: d.unseen is not None)
    used = windows.has_match | windows.unseen | windows.each(lambda d: d.truth is None)
    used &= windows.each(lambda d: d.use != 'decide')
    weights = np.zeros(len(label))
    for feature in np.unique(windows.feature):
        for name in np.unique(label):
            own = used & (label == name) & (windows.feature == feature)
            for part in own & ~is_detour, own & is_detour:
                for early, share in ((False, 1.0), (True, 0.25)):
                    rows = part & (windows.early == early)
                    weights[rows] = share / max(int(np.count_nonzero(rows)), 1)
    return weights


Scores = tuple[np.ndarray, list[np.ndarray]]


def left_out(row: 'Row') -> Scores:
    """
    Score each window by a fit on drives without its groups.

    :returns: log odds of each window, (M,), and for each its thresholds at .5 and at the errors.
    """
    windows = row.scored
    features, groups = np.unique(windows.feature), windows.each(lambda d: frozenset(d.groups))
    constants = (windows.feature[:, None] == features).astype(float)
    x = np.concatenate([windows.x, constants], axis=1)
    weights, log_odds = fit_weights(windows), windows.score.copy()
    thresholds = [np.zeros(len(x)) for _ in (0.5, *ERRORS)]
    for fold in sorted(set(groups), key=sorted):
        own = groups == fold
        train = (weights > 0) & np.array([not each & fold for each in groups])
        score = log_odds
        if windows.x.shape[1]:
            of_windows = weights[train] / weights[train].mean()
            w = fit(x[train], windows.right[train], of_windows)
            score = x @ w
            if row.recent:
                # in units of today's evidence, for its limits of likely and sure windows
                score = score + row.recent * recent_odds(windows, 2 * score - 1.6)
            log_odds[own] = score[own]
        rows = train & ~windows.early
        for threshold, error in zip(thresholds[1:], ERRORS, strict=True):
            threshold[own] = least_score(score[rows], windows.right[rows], weights[rows], error)
    return log_odds, thresholds


def recent_odds(windows: Windows, own: np.ndarray) -> np.ndarray:
    """Return the log odds of today's share r of a drive's likely windows, at most 0, (M,)."""
    odds, before, recent = np.zeros(len(own)), None, evidence.RecentWindows()
    for i in np.flatnonzero(~windows.early):
        if before != (windows.feature[i], windows.drive[i]):
            before = windows.feature[i], windows.drive[i]
            recent = evidence.RecentWindows()
        odds[i] = min(_log_odds(recent.share, evidence.MIN_RECENT), 0.0)
        recent.add(own[i])
    return odds


def least_score(scores: np.ndarray, right: np.ndarray, weights: np.ndarray, error: float) -> float:
    """Return the score above which a share ``error`` of the matches is wrong, by weights."""
    order = np.argsort(-scores)
    wrong = np.cumsum((weights * ~right)[order]) / np.cumsum(weights[order])
    kept = np.flatnonzero(wrong <= error)
    return float(scores[order[kept[-1]]]) - 1e-9 if len(kept) else np.inf


def numbers(
    windows: Windows, feature: str, scores: Scores, equal: dict[str, int]
) -> dict[str, Any]:
    """
    Return recall, precision and matched negatives at all limits.

    :param equal: matched negatives of row a, by limit; empty = this is row a.
    """
    kinds, is_detour = windows.each(lambda d: d.kind), windows.each(lambda d: d.unseen is not None)
    of_feature = (windows.feature == feature) & windows.each(lambda d: d.use != 'fit')
    own = of_feature & ~windows.early
    negatives = {name: own & (kinds == name) for name in NEGATIVES[:-1]}
    negatives['unseen'] = own & windows.unseen & is_detour
    off = np.any(list(negatives.values()), axis=0)
    on = own & windows.has_match & ~is_detour
    score, thresholds = scores
    descending = np.sort(score[off])[::-1]
    limits = dict(zip(('.5', '.05', '.01'), thresholds, strict=True))
    if not equal:
        equal |= {k: int((score[off] > t).sum()) for k, t in zip(EQUAL, (0, SURE), strict=True)}
    for name, count in equal.items():
        limits[name] = np.full(len(score), descending[min(count, len(descending) - 1)])
    result: dict[str, Any] = {'images': {k: int(v.sum()) for k, v in negatives.items()}}
    for name, limit in limits.items():
        matched = score > limit
        rows = {}
        for kind in SETS:
            rows_of = on & (kinds == kind)
            if rows_of.any():
                a, right = matched & rows_of, windows.right
                rows[kind] = {
                    'recall': round(float((a & right).sum() / rows_of.sum()), 3),
                    'precision': round(float(right[a].mean()) if a.any() else 1.0, 4),
                }
        result[name] = {
            'sets': rows,
            'matched': int((matched & on).sum()),
            'wrong': int((matched & on & ~windows.right).sum()),
            'negatives': {k: int((matched & v).sum()) for k, v in negatives.items()},
        }
    place = [windows.right[on & (kinds == kind)] for kind in SETS]
    result['place alone'] = [round(float(each.mean()), 3) for each in place if len(each)]
    early, right = of_feature & windows.early & (score > SURE), windows.right
    parts = windows.has_match & right, windows.has_match & ~right, np.isin(kinds, NEGATIVES)
    result['early'] = [int((early & part).sum()) for part in parts]
    return result


def recalls(row: dict[str, Any], limit: str) -> np.ndarray:
    """Return the recall of each set at a limit."""
    return np.array([each['recall'] for each in row[limit]['sets'].values()])


# ------------------------------------------------ page


def page(about: dict[str, Any], results: dict[str, dict[str, Any]]) -> list[str]:
    """Return the lines of the page."""
    lines = heading('The contest: mode robust, less one mechanism, and a small filter', about)
    lines += [*TEXT.strip().splitlines(), '']
    if about['quick']:
        lines += ['With `--quick`: at two changes a pair, half of the negatives and detours.', '']
    for feature, rows in results.items():
        now, sets = rows['a'], list(rows['a']['.5']['sets'])
        lines += [f'## {KINDS[feature]}', '', '### Equal matches off the map', '']
        for limit in EQUAL:
            off = sum(now[limit]['negatives'].values()), sum(now['images'].values())
            lines += [f'Recall where {off[0]} of {off[1]} images off the map are matched:', '']
            cells = [
                [
                    name, *(f'{each:.2f}' for each in recalls(row, limit)),
                    f'{recalls(row, limit).mean():.3f}',
                    f'{row[limit]["wrong"]} of {row[limit]["matched"]}',
                ]
                for name, row in rows.items() if not name.startswith('b ')
            ]  # fmt: skip
            lines += table(['row', *sets, 'mean', 'wrong of matched on the map'], cells)
        lines += ['### Own thresholds: precision / recall, left out', '']
        cells = []
        for name, row in rows.items():
            for limit in ('.5', '.05', '.01') if not name.startswith('b ') else ():
                of_sets = row[limit]['sets'].values()
                cells.append([
                    f'{name}, {limit}',
                    *(f'{e["precision"]:.3f}/{e["recall"]:.2f}' for e in of_sets),
                    ' '.join(str(each) for each in row[limit]['negatives'].values()),
                ])  # fmt: skip
        images = ' '.join(str(each) for each in now['images'].values())
        last = f'matched: {", ".join(NEGATIVES)} (of {images})'
        lines += table(['row, limit', *sets, last], cells)
        names = [name for name in rows if not name.startswith('b ')]
        lines += ['The place alone, right of all images:', '']
        cells = [[name, *(f'{each:.3f}' for each in rows[name]['place alone'])] for name in names]
        lines += table(['row', *sets], cells)
        early = (f'{name}: {", ".join(map(str, rows[name]["early"]))}' for name in names)
        lines += [f'First images above .95: right, wrong, off the map: {"; ".join(early)}.', '']
        if removed := [name for name in rows if name.startswith('b ')]:
            lines += ['### Less one mechanism', '', REMOVED.strip(), '']
            cells = []
            for name in removed:
                cell = [name.removeprefix('b ')]
                for limit in EQUAL:
                    change = changes(rows, name, limit)
                    worst = int(change.argmin())
                    cell += [f'{change.mean():+.3f}', f'{change[worst]:+.3f} ({sets[worst]})']
                cells.append([*cell, 'yes' if costs_nothing({feature: rows}, name) else ''])
            head = ['removed', 'as .5: mean', 'worst set', 'as .01: mean', 'worst set']
            lines += table([*head, 'costs nothing'], cells)
    return lines


def changes(rows: dict[str, Any], name: str, limit: str) -> np.ndarray:
    """Return the change of recall of each set by a mechanism."""
    basis = rows['a refit' if name.removeprefix('b ') in TERMS else 'a']
    return recalls(rows[name], limit) - recalls(basis, limit)


def costs_nothing(results: dict[str, dict[str, Any]], name: str) -> bool:
    """Whether a row loses less than .01 of recall in every set, at equal matches off the map."""
    every = [changes(rows, name, each) for rows in results.values() for each in EQUAL]
    return bool(np.min(every) > -0.01)


TEXT = """
Question: does a small filter, or today's method with fewer mechanisms, do as well as today's?
Data: drives of one session in which the camera moves (the same, at half, double and triple speed,
30 % of the images lost; damaged ones without the other speeds); of Nordland, the second half of
the query decides and the first one is fitted on. Off the map: floors that look alike, reverse
drives, unrelated routes, and stretches that the map lacks. Only images in the middle of a whole
window of images that moved count. The weights and the thresholds at .05 and .01 (that share of the
matches is wrong, each group and each kind off the map with the same weight) have not seen the set:
groups are Gardens Point with the walk, corridor, Nordland, office, track, two halves of the tower,
reverse drives, and each pair of unrelated routes with both its groups.

Rows: a, mode robust as it is; a refit, its quantities with weights fitted like c's; c, the small
filter (benchmarks/contest_filter.py: belief, lead, cells, creep, share of recent windows that
agree); c less share, without the last one. With mechanisms of today's method: recent, instead of
the share, today's share r of likely and sure windows, with its weight of 5; checks, the odds of
its belief, at most e^4, are multiplied by today's factor of evenness and excess motion instead of
creep; by today, both, and today's evidence instead of a fit; alpha, today's weight of an image by
its change. *Equal matches off the map*: the threshold at which as many images off the map are
matched as by row a at .5, and at its .01.
"""
REMOVED = """
Change of recall at equal matches off the map, mean of the sets and the worst set. Terms of the
regression are compared with a refit without them, the others with row a.
"""


# ------------------------------------------------ command


@dataclass(frozen=True, eq=False)
class Row:
    """
    A row of the contest.

    :param quantities: of the regression, (M, Q); none = the row has log odds.
    :param recent: weight of the log odds of :class:`RecentWindows`, below one half.
    """

    windows: Windows
    quantities: np.ndarray | None = None
    recent: float = 0.0

    @property
    def scored(self) -> Windows:
        """Return the windows with the quantities of the regression."""
        x = self.windows.x[:, :0] if self.quantities is None else self.quantities
        return replace(self.windows, x=x)


def small_rows(windows: Windows) -> Iterator[tuple[str, Row]]:
    """Yield the rows of the small filter: as it is, and with mechanisms of today's method."""
    belief, lead, cells, excess, share, uneven = windows.x.T
    creep = np.clip(excess - checks.EXCESS, 0, 1)
    yield 'c', Row(windows, np.stack([belief, lead, cells, creep, share], 1))
    yield 'c less share', Row(windows, np.stack([belief, lead, cells, creep], 1))
    certain = np.clip(belief, -CERTAIN, CERTAIN)
    yield 'c, recent', Row(windows, np.stack([certain, lead, cells, creep], 1), evidence.RECENT)
    odds = certain - checks.UNEVEN_WEIGHT * uneven - checks.EXCESS_WEIGHT * creep
    odds = np.clip(odds, _log_odds(0), _log_odds(1))
    checked = np.stack([odds, lead, cells], 1)
    yield 'c, checks', Row(windows, checked)
    yield 'c, checks, recent', Row(windows, checked, evidence.RECENT)
    constants = np.array([registry.KINDS[KINDS[f]].with_cells for f in windows.feature])
    own = constants + checked @ [evidence.POSTERIOR, evidence.LEAD, evidence.CELLS]
    own = np.where(odds < 0, np.minimum(own, odds + evidence.GAIN), own)
    score = own + evidence.RECENT * recent_odds(windows, own)
    yield 'c by today', Row(replace(windows, score=score))


def results_of(
    drives: Sequence[Drive], shown: dict[tuple[str, str], Any], features: Sequence[str],
    with_small: bool,
) -> dict[str, dict[str, Any]]:  # fmt: skip
    """Return the numbers of all rows, by kind of features."""

    def pooled(mechanism: str, side: int) -> Windows:
        rows = {f: [each[side] for each in shown[f, mechanism]] for f in features}
        return Windows.pooled([Windows.of(drives, rows[f], f) for f in features])

    now = pooled('', 0)
    rows = {'a': Row(now), 'a refit': Row(now, now.x)}
    if with_small:
        rows |= dict(small_rows(pooled('', 1)))
        weighted = dict(small_rows(pooled('', 2)))
        rows['c by today, alpha'] = weighted['c by today']
    if any(mechanism for _, mechanism in shown):
        rows |= {f'b {name}': Row(now, now.x[:, columns]) for name, columns in TERMS.items()}
    for mechanism in dict.fromkeys(name for _, name in shown if name):
        rows[f'b {mechanism}'] = Row(pooled(mechanism, 0))
    results: dict[str, dict[str, Any]] = {feature: {} for feature in features}
    equal: dict[str, dict[str, int]] = {feature: {} for feature in features}
    for name, row in rows.items():
        scores = left_out(row)
        for feature in features:
            results[feature][name] = numbers(row.windows, feature, scores, equal[feature])
    return results


def shown_by(
    mechanisms: Sequence[str], features: Sequence[str], cache: Path, quick: bool, jobs: int
) -> dict[tuple[str, str], list[Shown]]:
    """Return what windows show without each mechanism, recorded in processes of their own."""
    files = {}
    for key in ((feature, mechanism) for feature in features for mechanism in mechanisms):
        digest = f'{zlib.crc32(key[1].encode()):08x}'
        files[key] = cache / f'windows-{key[0]}{"-quick" * quick}-{digest}.pickle'
    todo = [
        (*key, quick, cache / f'sets-{key[0]}.pickle', file)
        for key, file in files.items() if not file.exists()
    ]  # fmt: skip
    with multiprocessing.get_context('spawn').Pool(jobs, maxtasksperchild=1) as pool:
        pool.starmap(record, todo, 1)
    return {key: pickle.loads(file.read_bytes()) for key, file in files.items()}


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = options_parser(__doc__, 'two changes a pair, half of the negatives')
    kinds: dict[str, Any] = {'default': ['g', HYBRID], 'choices': tuple(KINDS), 'nargs': '+'}
    parser.add_argument('--features', **kinds, help='of %(choices)s, default: %(default)s')
    parser.add_argument('--rows', nargs='+', choices=('a', 'b', 'c'), default=['a', 'b', 'c'])
    parser.add_argument('--mechanisms', nargs='+', default=list(MECHANISMS), help='of row b')
    parser.add_argument('--cache', type=Path, help='folder of features and windows, kept')
    parser.add_argument('--jobs', type=int, default=1, help='processes at a time')
    options = parser.parse_args(arguments)
    began = time.perf_counter()
    about = environment(named_commit=options.commit) | {'quick': options.quick}
    folder = data_folder()
    with TemporaryDirectory() as temporary:
        cache = options.cache or Path(temporary)
        cache.mkdir(parents=True, exist_ok=True)
        # of the processes: threads of several would wait for each other
        os.environ.update(OMP_NUM_THREADS='1', NUMBA_NUM_THREADS='1')
        gradient, mechanisms = extractor('g', folder), ['']
        for feature in options.features:
            if not (file := cache / f'sets-{feature}.pickle').exists():
                sets = read_sets(folder, extractor(feature, folder), gradient)
                file.write_bytes(pickle.dumps(sets))
        drives = list(drives_of(pickle.loads(file.read_bytes()), options.quick))
        if 'b' in options.rows:
            mechanisms += options.mechanisms
        run = options.features, cache, options.quick, options.jobs
        shown = shown_by(mechanisms, *run)
        results = results_of(drives, shown, options.features, 'c' in options.rows)
        free = [name for name in mechanisms[1:] if costs_nothing(results, f'b {name}')]
        if len(free) > 1:  # with all of them removed
            shown |= shown_by([AND.join(free)], *run)
            results = results_of(drives, shown, options.features, 'c' in options.rows)
    lines = page(about, results)
    options.output.mkdir(parents=True, exist_ok=True)
    write_lines(options.output / f'contest{"-quick" * options.quick}.md', lines)
    print(*lines, f'took {time.perf_counter() - began:.0f} s', sep='\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
