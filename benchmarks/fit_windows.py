# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the windows of all drives show, recorded once, and the evidence that is computed from that.

The evidence is replayed with other numbers in milliseconds; numbers that change what is recorded
are set in a process of its own.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
import itertools
import multiprocessing
from pathlib import Path
import pickle
import sys
import time
from typing import Any
import zlib

from drives import Drive, drives_of, NEGATIVES, SETS
import numba as nb
from numba.core.caching import NullCache
import numpy as np
from off_map_page import KINDS
from stavpr_ros.features import registry
from stavpr_ros.method import localizer, PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.evidence import log_odds, probability_of
from stavpr_ros.method.model import EARLY, MODEL
from stavpr_ros.threads import limit_threads

LENGTH = RecognizerSettings().sequence.length
MIDDLE = (LENGTH - 1) // 2
LIMITS = 0.007, 0.002  # share of the images off the map that are matched, where recall is compared
TARGET = 0.007  # the same at .5; all are means of the kinds of such images
# numbers of the evidence, which are replayed, in the order of the kernel
REPLAYED = (
    'BELIEF', 'LEAD', 'CELLS', 'RECENT', 'CERTAIN', 'UNEVEN_WEIGHT', 'EXCESS', 'EXCESS_WEIGHT',
    'LAST', 'CREEP',
)  # fmt: skip
RECORDED = (
    'speeds', 'level', 'weight', 'most', 'change', 'spread', 'leave', 'enter', 'start',
    'STANDSTILL', 'MAX_CHANGE', 'MIN_CHANGE', 'OFFSET', 'MIN_LOCAL', 'MAX_CREEP',
    'LOOK_AHEAD', 'STRETCH', 'DARK_PROBABILITY', 'CLOSE', 'LINE', 'ON_LINE', 'MAX_STEP', 'APART',
    'STRAIGHT', 'EVEN', 'EVEN_SHARE', 'BLOCKS', 'NEGLIGIBLE', 'FAR',
)  # fmt: skip
GRID = {
    'BELIEF': (0.4, 0.5, 0.6), 'LEAD': (1.0, 1.2, 1.5), 'CELLS': (2.0, 2.5, 3.0),
    'CREEP': (1.0, 2.0, 3.0), 'RECENT': (5.0, 7.0),
}  # fmt: skip
WEIGHTS = 'BELIEF', 'LEAD', 'CELLS', 'CREEP', 'RECENT'
LATE = 150  # images off the map
ELSEWHERE = np.array([-5.0, 0, 0, 0, 0, 0, 0])  # what their windows show
REPEATED, NEW, REST = 0.0, 1.0, 2.0
Z = 1.96  # half width of intervals at 95 %, in deviations
Values = dict[str, float]


# ------------------------------------------------ what windows show


def record_drive(drive: Drive, with_early: bool = True) -> np.ndarray:
    """
    Return what each window of a drive shows, (m, 13), in order.

    Columns: number of the newest image, -1 = no match; matched image, place, whether by the newest
    images alone, ``NEW``, ``REPEATED`` or ``REST`` (the camera rests since the matched image),
    log odds of the belief, unevenness, excess, creep, logarithms of 1 + lead and 1 + cells,
    whether nothing is probable, probability.

    :param with_early: also what the newest images alone show, matched or not.
    """
    recognizer = PlaceRecognizer(drive.places, RecognizerSettings())
    window: Any = recognizer._window
    rows: list[tuple[float, ...]] = []
    entries: list[Any] = []
    state = {'image': -1, 'early': -1}
    show, assess, match, newest = window._assess, window.assess, window.match, window.match_newest

    def quantities(of: Any) -> tuple[float, ...]:
        q = of.quantities
        cells, nothing = np.log1p(max(q.cells, 0.0)), float(not q.belief)
        lead = np.log1p(q.images * q.lead)
        return log_odds(q.belief), q.uneven, q.excess, q.creep, lead, cells, nothing

    def note(result: Any, is_early: bool) -> Any:
        path = result.path
        if path.place >= 0:
            l = len(path.pairs)
            image = state['image'] - (l - 1) + (l - 1) // 2
            middle = int(window.images['number'][(l - 1) // 2])
            rest, place = not is_early and middle == window.filter.count - 1, path.place
            about = image, place, float(is_early)
            if rest and any(
                window._view is earlier for earlier in entries
            ):  # it counts as a recent one, but is not the match
                rows.append((-1, *about, NEW, *quantities(window._view), 0.0))
            which = window._by_half if rest else entries[-1] if entries else window._view
            kind = REST if rest else NEW if entries else REPEATED
            rows.append((state['image'], *about, kind, *quantities(which), path.probability))
        return result

    def assess_view() -> None:
        entries.clear()
        assess()

    def note_match() -> Any:
        return note(match(), False)

    def early() -> Any:
        state['early'] = state['image']
        entries.clear()
        return note(newest(), True) if with_early else type(match())()

    def keep(*arguments: Any) -> Any:
        entries.append(show(*arguments))
        return entries[-1]

    vars(window).update(_assess=keep, assess=assess_view, match=note_match, match_newest=early)
    for i, stamp in enumerate(drive.stamps.tolist()):
        state['image'] = i
        recognizer.update(drive.features[i : i + 1], stamp)
        if with_early and state['early'] < i:
            early()
    return np.array(rows, float).reshape(-1, 13)


def _prepare_once() -> None:
    """Prepare each map once for all drives on it."""
    prepare, prepared = vars(localizer)['prepare_map'], dict[Any, Any]()

    def prepare_map(features: Any, *rest: Any) -> Any:
        key = id(features), *rest
        if key not in prepared:
            prepared[key] = features, prepare(features, *rest)
        if (centering := prepared[key][1].centering) is not None:
            centering.reset()
        return prepared[key][1]

    vars(localizer)['prepare_map'] = prepare_map


def record(sets: Path, quick: bool, files: dict[tuple[str, Any], Path]) -> None:
    """Write what all drives show, with each value of a number; '' = as they are."""
    limit_threads(1)
    with sets.open('rb') as file:
        drives = list(drives_of(pickle.load(file), quick))
    _prepare_once()
    for (name, value), to in files.items():
        began, before = time.perf_counter(), value_of(name) if name else None
        if name:  # nothing is fitted on it
            set_value(name, value)
        selection = [d if not name or d.use != 'fit' else None for d in drives]
        rows = [record_drive(d, not name) if d else np.empty((0, 13)) for d in selection]
        to.write_bytes(pickle.dumps(rows))
        if name:
            set_value(name, before)
        print(sets.stem, name, value, f'{time.perf_counter() - began:.0f} s', flush=True)


def settings_of(names: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Yield the numbers that are recorded anew with their values."""
    for name in names:
        yield from ((name, value) for value in half_and_double(name))


def records_of(
    feature: str, cache: Path, quick: bool, settings: Sequence[tuple[str, Any]]
) -> dict[tuple[str, Any], Any]:
    """Return the records of all drives with each value, recorded in a process of its own."""
    files = {}
    for name, value in settings:
        digest = f'{zlib.crc32(repr((name, value)).encode()):08x}'
        files[name, value] = cache / f'records-{feature}{"-quick" * quick}-{digest}.pickle'
    todo = {key: file for key, file in files.items() if not file.exists()}
    if todo:
        with multiprocessing.get_context('spawn').Pool(1) as pool:
            pool.apply(record, (cache / f'sets-{feature}.pickle', quick, todo))
    return {key: pickle.loads(file.read_bytes()) for key, file in files.items()}


def value_of(name: str) -> Any:
    """Return a number of the method."""
    return getattr(MODEL, name) if hasattr(MODEL, name) else _modules(name)[0][name]


def _modules(name: str) -> list[dict[str, Any]]:
    modules = [vars(m) for key, m in sys.modules.items() if key.startswith('stavpr_ros.method.')]
    return [module for module in modules if name in module]


def set_value(name: str, value: Any) -> None:
    """Set a number of the method in this process, and compile the kernels that contain it."""
    if hasattr(MODEL, name):
        object.__setattr__(MODEL, name, value)
        return
    for module in _modules(name):
        module[name] = type(module[name])(value)
    for module in _modules(name):
        for kernel in module.values():
            function = getattr(kernel, 'py_func', None)
            if function is not None and name in function.__code__.co_names:
                kernel._cache = NullCache()  # it knows the sources alone
                kernel.recompile()


def half_and_double(name: str) -> tuple[Any, Any]:
    """Return half and double of a number; of several speeds, every second one, and others."""
    value = value_of(name)
    if isinstance(value, tuple):
        between = np.sqrt(np.array(value[1:]) * value[:-1])
        return value[::2], tuple(np.sort([*value, *between]).tolist())
    return type(value)(value / 2), type(value)(
        min(value * 2, 1.0) if name == 'start' else value * 2
    )


# ------------------------------------------------ evidence


@dataclass(frozen=True, eq=False)
class Windows:
    """
    The windows of all drives with one kind of features; arrays (M, ...).

    :param feature: the kind; drive: number of the drive; image: newest of the window.
    :param early, kind, x, probability: see :func:`recorded`.
    :param counted: in the middle of a whole window of images that moved; once an image.
    """

    feature: str
    drives: tuple[Drive, ...]
    drive: np.ndarray
    image: np.ndarray
    early: np.ndarray
    kind: np.ndarray
    x: np.ndarray
    probability: np.ndarray
    counted: np.ndarray
    right: np.ndarray
    has_match: np.ndarray
    unseen: np.ndarray

    @classmethod
    def of(cls, feature: str, drives: Sequence[Drive], records: Sequence[np.ndarray]) -> 'Windows':
        """Judge what windows show; images that have no whole window are of no place."""
        parts = []
        for number, (drive, shown_rows) in enumerate(zip(drives, records, strict=True)):
            rows = shown_rows
            images = _middle_images(drive.images) if len(rows) else np.empty(0, int)
            whole = np.flatnonzero((rows[:, 3] == 0) & (rows[:, 0] >= 0))
            middles, first = np.unique(rows[whole, 1], return_index=True)
            counted = np.zeros(len(rows), bool)
            counted[whole[first]] = np.isin(middles, images)
            missing = np.setdiff1d(images, middles)
            more = np.zeros((len(missing), 13))
            more[:, 0], more[:, 1], more[:, 2], more[:, 4], more[:, 11] = -1, missing, -1, NEW, 1
            rows, counted = np.append(rows, more, axis=0), np.append(counted, missing >= 0)
            at, n = rows[:, 1].astype(int), len(rows)
            right = has = unseen = np.zeros(n, bool)
            if drive.truth is not None and n:
                truth = drive.truth.select(at)
                right, has = truth.accepts(rows[:, 2].astype(int)), truth.has_match
            if drive.unseen is not None:
                unseen = drive.unseen[at]
            parts.append((
                np.full(n, number), rows[:, 0], rows[:, 3] > 0, rows[:, 4], rows[:, 5:12],
                rows[:, 12], counted, right, has, unseen,
            ))  # fmt: skip
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return cls(feature, tuple(drives), *columns)

    def each(self, value: Callable[[Drive], Any]) -> np.ndarray:
        """Return a value of the drive of each window, (M,)."""
        return np.array([value(drive) for drive in self.drives])[self.drive]

    @cached_property
    def decides(self) -> np.ndarray:
        """Return which windows are not only for a fit, (M,)."""
        return self.each(lambda drive: drive.use != 'fit')

    @cached_property
    def trains(self) -> np.ndarray:
        """Return which windows a fit may use, (M,)."""
        return self.each(lambda drive: drive.use != 'decide')

    @cached_property
    def set_of(self) -> np.ndarray:
        """Return the set that each window counts for, -1 = none, (M,)."""
        index = self.each(lambda d: SETS.index(d.kind) if d.truth and d.unseen is None else -1)
        return np.where(self.counted & self.has_match, index, -1)

    @cached_property
    def negative(self) -> np.ndarray:
        """Return the kind of negatives that each window counts for, -1 = none, (M,)."""
        index = self.each(lambda d: -1 if d.truth else NEGATIVES.index(d.kind))
        index = np.where(self.unseen, NEGATIVES.index('unseen'), index)
        return np.where(self.counted, index, -1)

    def scores(self, values: Values) -> np.ndarray:
        """Return the log odds x of all windows, (M,), before those below 0 are changed."""
        return scores_of(
            self.x, self.drive, self.early, self.kind, *numbers_of(values, self.feature)
        )

    def threshold(self, scores: np.ndarray, share: float, rows: np.ndarray) -> float:
        """Return the score above which a share of the rows off the map is matched."""
        off = rows & (self.negative >= 0)
        order = np.argsort(-scores[off])
        kinds = self.negative[off][order]
        counts = np.bincount(kinds)
        shares = np.cumsum(1 / counts[kinds]) / np.count_nonzero(counts)
        return float(scores[off][order][np.searchsorted(shares, share + 1e-9)])

    def recalls(self, scores: np.ndarray, threshold: float, rows: np.ndarray) -> np.ndarray:
        """Return the recall of each set in some rows, (10,), NaN where there is none."""
        rows = rows & (self.set_of >= 0)
        hits = rows & self.right & (scores > threshold)
        counts = (np.bincount(self.set_of[mask], minlength=len(SETS)) for mask in (hits, rows))
        with np.errstate(invalid='ignore'):
            hits, every = counts
            return hits / every

    def matched_off(self, scores: np.ndarray) -> np.ndarray:
        """Return how many images of each kind off the map are matched, (4,)."""
        rows = (scores > 0) & self.decides & (self.negative >= 0)
        return np.bincount(self.negative[rows], minlength=len(NEGATIVES))


def _middle_images(images: np.ndarray) -> np.ndarray:
    """Return the images in the middle of a whole window of images that moved, (m,)."""
    number = np.cumsum(np.diff(images, prepend=images[:1]) != 0)
    return np.flatnonzero((number >= MIDDLE) & (number[-1] - number >= LENGTH - 1 - MIDDLE))


@nb.njit
def scores_of(
    x: np.ndarray, drive: np.ndarray, early: np.ndarray, kind: np.ndarray, constant: float,
    numbers: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the log odds of windows as :mod:`stavpr_ros.method.evidence` has them."""
    out, newest, likely, count = np.empty(len(x)), -np.inf, 0.5, 0.0
    w_belief, w_lead, w_cells, w_recent, certain, w_uneven, limit, w_excess = numbers[:8]
    last, w_creep = numbers[8], numbers[9]
    for i in range(len(x)):
        if i == 0 or drive[i] != drive[i - 1]:
            newest, likely, count = -np.inf, 0.5, 1.0
        belief, uneven, excess, creep, lead, cells, nothing = x[i]
        odds = max(min(belief, certain), -certain)
        odds = max(odds - w_uneven * uneven - w_excess * min(max(excess - limit, 0.0), 1.0), -9.21)
        own = constant + w_belief * odds + w_lead * lead + w_cells * cells - w_creep * creep
        if nothing:
            own = -np.inf
        share = min(max(likely, 1e-4), 1 - 1e-4)
        out[i] = own + w_recent * min(np.log(share / (1 - share)), 0.0)
        if not early[i]:
            if kind[i] != NEW:
                out[i] = newest if kind[i] == REPEATED else min(newest, out[i])
                continue
            newest, count = out[i], min(count + 1, last)
            likely += ((own > 0) - likely) / count
    return out


def numbers_of(values: Values, feature: str) -> tuple[float, np.ndarray]:
    """Return K and the other numbers of the evidence, for the kernel."""
    return values[feature], np.array([values[name] for name in REPLAYED], float)


def probability(x: float) -> float:
    """Return the probability of log odds x."""
    return probability_of(x, 0.5)


def values_now(features: Sequence[str]) -> Values:
    """Return the numbers of the evidence as they are in the code."""
    constants = {f: registry.KINDS[KINDS[f].split()[0]].with_cells for f in features}
    return {name: float(value_of(name)) for name in REPLAYED} | constants


def mean_recall(every: Sequence[Windows], values: Values, rows: Sequence[np.ndarray]) -> float:
    """Return the mean recall at ``LIMITS``, of sets and kinds of features."""
    means = []
    for windows, own in zip(every, rows, strict=True):
        scores = windows.scores(values)
        for share in LIMITS:
            limit = windows.threshold(scores, share, own)
            means.append(np.nanmean(windows.recalls(scores, limit, own)))
    return float(np.mean(means))


def search(every: Sequence[Windows], values: Values, rows: Sequence[np.ndarray]) -> Values:
    """Return the weights of ``GRID``, with constants, of the largest mean recall in some rows."""
    grid = []
    for weights in itertools.product(*GRID.values()):
        chosen = values | dict(zip(GRID, weights, strict=True))
        for windows, own in zip(every, rows, strict=True):
            chosen[windows.feature] = constant_at(windows, chosen, own)
        grid.append(chosen)
    return max(grid, key=lambda v: mean_recall(every, v, rows))


def without(every: Sequence[Windows], group: str) -> list[np.ndarray]:
    """Return the windows that a fit without a group may use, of each kind of features."""
    return [w.trains & w.each(lambda drive: group not in drive.groups) for w in every]


def folds_of(every: Sequence[Windows], values: Values) -> dict[str, tuple[Values, float, float]]:
    """Return for each group the weights without it, and the recall there before and after."""
    folds = {}
    for group in sorted({group for drive in every[0].drives for group in drive.groups}):
        rows = without(every, group)
        chosen = search(every, values, rows)
        before, after = (mean_recall(every, numbers, rows) for numbers in (values, chosen))
        folds[group] = chosen, before, after
    return folds


def recalls_left_out(windows: Windows, of_group: dict[str, Values], share: float) -> np.ndarray:
    """Return the recall of each set by the weights without its group, at equal matches, (10,)."""
    recalls = np.full(len(SETS), np.nan)
    for group, values in of_group.items():
        scores, rows = windows.scores(values), windows.decides
        of_sets = windows.recalls(scores, windows.threshold(scores, share, rows), rows)
        own = {SETS.index(d.kind) for d in windows.drives if d.truth and group in d.groups}
        recalls[list(own)] = of_sets[list(own)]
    return recalls


def late_recall(windows: Windows, values: Values) -> float:
    """Return the mean recall of drives that come to the map after ``LATE`` images."""
    limit = windows.threshold(windows.scores(values), LIMITS[0], windows.decides)
    recalls = []
    for number, drive in enumerate(windows.drives):
        rows = np.flatnonzero(windows.drive == number)
        counted = windows.set_of[rows] >= 0
        if not counted.any() or drive.use == 'fit':
            continue
        x = np.append(np.tile(ELSEWHERE, (LATE, 1)), windows.x[rows], axis=0)
        early, kind = (np.append(np.full(LATE, v), of[rows]) for v, of in
                       ((0.0, windows.early), (NEW, windows.kind)))  # fmt: skip
        scores = scores_of(
            x, np.zeros(len(x)), early > 0, kind, *numbers_of(values, windows.feature)
        )[LATE:]
        recalls.append((counted & windows.right[rows] & (scores > limit)).sum() / counted.sum())
    return float(np.mean(recalls))


def constant_at(windows: Windows, values: Values, rows: np.ndarray) -> float:
    """Return the constant K with which ``TARGET`` of the rows off the map are matched at .5."""
    low, high = -20.0, 5.0
    for _ in range(16):
        middle = (low + high) / 2
        scores = windows.scores(values | {windows.feature: middle})
        is_low = windows.threshold(scores, TARGET, rows) <= 0
        low, high = (middle, high) if is_low else (low, middle)
    return low


# ------------------------------------------------ error rates


@dataclass(frozen=True, eq=False)
class Risks:
    """
    Matches of drives above log odds t, early ones included; arrays (T, D).

    :param wrong, matched: counts; off the map, of all images.
    """

    t: np.ndarray
    drives: tuple[Drive, ...]
    wrong: np.ndarray
    matched: np.ndarray

    @classmethod
    def of(cls, windows: Windows, scores: np.ndarray, t: np.ndarray) -> 'Risks':
        """Count the matches of all drives above each t, ascending."""
        number = np.cumsum(np.diff(windows.drive * 1e6 + windows.image, prepend=-1) != 0)
        whole = np.full(number[-1] + 1, -np.inf)  # by the newest image
        whole[number[~windows.early]] = scores[~windows.early]
        low = np.where(windows.early, whole[number], -np.inf)  # a whole window is preferred
        low[windows.early & (scores <= log_odds(EARLY))] = np.inf
        is_drive = windows.each(lambda d: d.truth is not None)
        counts = windows.has_match | windows.unseen | ~is_drive
        rows = (counts & (windows.image >= 0) & (scores > low))[None]
        rows = rows & (t[:, None] < scores) & (t[:, None] >= low)
        n = len(windows.drives)

        def count(which: np.ndarray) -> np.ndarray:
            return np.array([np.bincount(windows.drive[row & which], minlength=n) for row in rows])

        matched = count(windows.drive >= 0)
        lengths = np.array([0 if d.truth else len(d.images) for d in windows.drives])
        return cls(t, windows.drives, count(~windows.right), np.maximum(matched, lengths))

    @property
    def rates(self) -> np.ndarray:
        """Return the share of wrong matches, (T, D)."""
        return self.wrong / np.maximum(self.matched, 1)

    def first_row(self, error: float, rows: np.ndarray) -> int:
        """Return the row of the least t that keeps an error rate over some drives; T = none."""
        bounds = (self.rates[:, rows].sum(axis=1) + 1) / (np.count_nonzero(rows) + 1)
        return int(len(self.t) - np.argmin(np.append(bounds[::-1] <= error, False)))


def pool_risks(every: Sequence[Risks]) -> Risks:
    """Return the drives of several kinds of features as one."""
    counts = (
        np.concatenate(columns, axis=1)
        for columns in ([r.wrong for r in every], [r.matched for r in every])
    )
    drives = tuple(itertools.chain.from_iterable(r.drives for r in every))
    return Risks(every[0].t, drives, *counts)


def count_matches(risks: Risks, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Return wrong matches and matches of each drive, with the t of drives without its groups."""
    groups = [frozenset(d.groups) for d in risks.drives]
    wrong, matched = np.zeros(len(groups)), np.zeros(len(groups))
    for fold in set(groups):
        at = risks.first_row(error, np.array([not g & fold for g in groups]))
        own = np.array([g == fold for g in groups])
        if at < len(risks.t):
            wrong[own], matched[own] = risks.wrong[at, own], risks.matched[at, own]
    return wrong, matched


def wilson(wrong: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interval of rates at 95 %."""
    n = np.maximum(count, 1)
    p, scale = wrong / n, 1 + Z**2 / n
    middle, half = p + Z**2 / (2 * n), Z * np.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    return (middle - half) / scale, (middle + half) / scale
