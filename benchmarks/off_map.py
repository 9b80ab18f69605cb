# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Off the map, at night, at other speeds: mode robust with its defaults on all data sets.

``make off-map``, ``make off-map ARGS=--quick``. Writes off_map.json and its table to
benchmarks/results/. Rows: benchmarks/README.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
import sys
import time
from typing import Any

from accuracy import extractors, FEATURES, long_cases, short_cases
from data import data_folder
import numpy as np
from off_map_page import (
    DAY,
    INT8,
    JUMP,
    KINDS,
    LEVEL,
    markdown,
    NIGHT,
    RATES,
    Results,
    summary_section,
)
from results import environment, options_parser, write_json, write_lines
from stavpr_lab.evaluation.calibration import calibrate
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.evaluate import recognize_all
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import (
    accepted_counts,
    ConfusionCounts,
    published_matches,
    sweep,
)
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import build_map, Map, select_places
from stavpr_ros.method import Match, PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.error_rate import least_probability
from stavpr_ros.progress import Progress
from stavpr_ros.sources import open_source

SETTINGS = RecognizerSettings(mode='robust')
LONG = 1000  # places from which a route is driven only around the removed stretch
MIN_STRETCH, MAX_STRETCH = 20, 40  # places of a removed stretch
LONG_STRETCHES = 100  # of a long route, at random; others have one at each place
STRETCHES = (
    f'stretches have {MIN_STRETCH} to {MAX_STRETCH} places, at random, and begin at {{step}} '
    'place (Nordland: {long} random ones)'
)
STEP, LONG_STEP = 10, 100  # places from one start to the next
BEFORE, AFTER = 80, 60  # images driven around the removed stretch of a long route
COARSER = 4  # --quick: so many times coarser steps, every fourth pair of floors
START_IMAGES, SMALL_MAP = 30, 40
TOWER = 'tower'
WARPED = (DAY, 'walk_day', NIGHT, 'walk_night_map')
SETS = (*WARPED, 'corridor', 'nordland')
REST_PLACES = 200  # places of a standstill in a map
SPARSE = 3  # places of the route a place of a sparse map
LONG_STOP = 'stop 1000'  # not pooled: so many images of one probability
CHANGES = ('same', '0.5x', 'varying', '2x', '3x', 'stop 30', 'stop 100', 'drop 0.3', LONG_STOP)


@dataclass(frozen=True, eq=False)
class Pair:
    """A query and a map of one route, features extracted."""

    name: str
    places: Map
    query: Map
    truth: GroundTruth

    @property
    def long(self) -> bool:
        """Whether the route is driven only around the removed stretch."""
        return len(self.places) >= LONG


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    The matches of a drive of N images, and M - N early ones; every array has the shape (M,).

    :param accepted: matched.
    :param probabilities: declared for the matches, NaN = none.
    :param correct: the match is right.
    :param has_match: the place is in the map.
    :param unseen: the place was removed from the map.
    :param early: the match is of the newest images alone.
    """

    accepted: np.ndarray
    probabilities: np.ndarray
    correct: np.ndarray
    has_match: np.ndarray
    unseen: np.ndarray
    early: np.ndarray

    @property
    def sure(self) -> np.ndarray:
        """Return the wrong matches whose probability is 0.95 or more, shape (M,), bool."""
        return self.accepted & ~self.correct & (self.probabilities >= LEVEL)

    @classmethod
    def pool(cls, outcomes: Sequence['Outcome']) -> 'Outcome':
        """Return the images of several drives as one."""
        names = cls.__dataclass_fields__
        return cls(*(np.concatenate([getattr(part, name) for part in outcomes]) for name in names))

    def numbers(self) -> dict[str, Any]:
        """Return counts, precision and recall at the default threshold, best F1; F1 of images."""
        is_image = ~self.early
        counts, recall = self._precision_and_recall(self.accepted)
        curve = sweep(
            np.where(np.isfinite(self.probabilities), 1 - self.probabilities, np.inf)[is_image],
            self.correct[is_image],
            self.has_match[is_image],
        )
        return {
            'images': int(np.count_nonzero(is_image)),
            'early': int(np.count_nonzero(self.early)),
            'early_wrong': int(np.count_nonzero(self.early & ~self.correct)),
            'matched': counts.accepted,
            'wrong': counts.false_positives,
            'sure': int(np.count_nonzero(self.sure)),
            'precision': counts.precision,
            'recall': recall,
            'rates': {rate: self._at(float(rate)) for rate in RATES},
            'f1': max(c.f1 for c in curve),
            'recall_at_100_precision': max(c.recall for c in curve if c.precision == 1),
            'unseen': int(np.count_nonzero(self.unseen & is_image)),
            'unseen_matched': int(np.count_nonzero(self.unseen & self.accepted)),
            'unseen_sure': int(np.count_nonzero(self.unseen & self.sure)),
        }

    def _precision_and_recall(self, accepted: np.ndarray) -> tuple[ConfusionCounts, float]:
        """Return the counts of all matches, and the recall of images."""
        columns, is_image = (accepted, self.correct, self.has_match), ~self.early
        of_images = accepted_counts(*(column[is_image] for column in columns))
        return accepted_counts(*columns), of_images.recall

    def _at(self, rate: float) -> tuple[float, float]:
        """
        Return precision and recall with ``max_error``, by the table.

        Up to the default threshold, a camera at rest counts as one that moves.
        """
        above = self.probabilities > least_probability(rate)
        counts, recall = self._precision_and_recall(
            above & (self.accepted | (self.probabilities <= SETTINGS.min_probability))
        )
        return counts.precision, recall

    def calibration(self) -> dict[str, Any]:
        """Return declared probabilities beside the share of right matches."""
        calibration = calibrate(self.probabilities, self.correct, self.has_match)
        if calibration is None:
            return {'images': 0, 'bins': [], 'levels': []}
        document = calibration.to_json()
        return document | {'bins': [row for row in document['bins'] if row['images']]}


def matches_of(
    place_map: Map, features: LocalFeatures, stamps: np.ndarray | None = None
) -> list[Match]:
    """Return the matches of a drive, one an image, by a recognizer of its own."""
    return recognize_all(PlaceRecognizer(place_map, SETTINGS), features, stamps)


def outcome(
    place_map: Map,
    features: LocalFeatures,
    truth: GroundTruth,
    unseen: np.ndarray | None = None,
    stamps: np.ndarray | None = None,
) -> Outcome:
    """
    Drive a query on a map.

    :param features: features of N images.
    :param truth: ground truth of the same images.
    :param unseen: images whose place was removed; None = none was.
    :param stamps: stamps of the images, ns; None = unknown.
    """
    length = SETTINGS.sequence.length
    matches, images = published_matches(matches_of(place_map, features, stamps), length)
    truth = truth.select(images)
    return Outcome(
        matches.accepted,
        matches.probabilities,
        truth.accepts(matches.places),
        truth.has_match,
        np.zeros(len(images), bool) if unseen is None else unseen[images],
        np.arange(len(images)) >= len(features),
    )


def drive_pair(pair: Pair, changes: DriveChanges, images: slice = slice(None)) -> Outcome:
    """
    Drive the query of a pair otherwise than it was recorded.

    :param images: images of the changed drive that are shown.
    """
    drive = changes.apply(pair.truth)
    indices = np.arange(len(drive.images))[images]
    unseen = np.any([np.zeros(len(drive.images), bool), *drive.unseen()], axis=0)
    return outcome(
        select_places(pair.places, drive.places) if changes.removed else pair.places,
        pair.query.features[drive.images[indices]],
        drive.truth.select(indices),
        unseen[indices],
        drive.stamps[indices],
    )


def sparse(pair: Pair) -> Outcome:
    """Drive a query on the map of every third place."""
    places = np.arange(0, len(pair.places), SPARSE)
    truth = pair.truth.on_places(places)
    return outcome(select_places(pair.places, places), pair.query.features, truth)


def stretches(pair: Pair, coarser: int = 1) -> list[tuple[int, int]]:
    """Return first place and end of each stretch that is removed, of random lengths."""
    n, rng = len(pair.places), np.random.default_rng(0)
    firsts = np.arange(n - MIN_STRETCH + 1)
    if pair.long:
        firsts = np.sort(rng.choice(firsts, LONG_STRETCHES, replace=False))
    lasts = np.minimum(firsts + rng.integers(MIN_STRETCH, MAX_STRETCH + 1, len(firsts)), n)
    return list(zip(firsts[::coarser].tolist(), lasts[::coarser].tolist(), strict=True))


def detours(pair: Pair, coarser: int = 1) -> Iterator[Outcome]:
    """Yield the outcome of each stretch that the map lacks."""
    for first, last in stretches(pair, coarser):
        stretch = slice(max(0, first - BEFORE), last + AFTER) if pair.long else slice(None)
        yield drive_pair(pair, DriveChanges(removed=((first, last),)), stretch)


def drives(pair: Pair) -> Iterator[tuple[str, Outcome]]:
    """Yield the outcome of each change of a query: all for day and night, few for the others."""
    names = CHANGES if pair.name in WARPED else CHANGES[:1]
    for name in (*names, '4.5x') if pair.long else names:
        changes = DriveChanges.from_name(name, len(pair.query))
        yield f'{pair.name}/{name}', drive_pair(pair, changes)


def first_right(matches: Sequence[Match], truth: GroundTruth, length: int) -> int | None:
    """
    Return how many images it took until a match was right; None = none was.

    :param truth: ground truth of the images.
    :param length: images of a window without stamps.
    """
    for count, match in enumerate(matches, 1):
        window = len(match.window_stamps) or length
        image = count - window + (window - 1) // 2  # the middle of the window
        if match.accepted and image >= 0:
            places = np.full(truth.N, -1)
            places[image] = match.path.place
            if truth.accepts(places)[image]:
                return count
    return None


def starts(pair: Pair, coarser: int = 1) -> Iterator[tuple[str, list[int | None]]]:
    """Yield the images until the first right match, for starts and jumps on the map."""
    n, step = len(pair.query), (LONG_STEP if pair.long else STEP) * coarser
    names = 'whole map', f'map of {SMALL_MAP} places', JUMP
    counts: dict[str, list[int | None]] = {name: [] for name in names}
    for start in range(STEP, n - START_IMAGES, step):
        images = np.arange(start, start + START_IMAGES)
        first = min(max(0, start - 5), len(pair.places) - SMALL_MAP)
        whole, before = (0, len(pair.places)), (start + n // 2) % (n - START_IMAGES)
        stretches = whole, (first, first + SMALL_MAP), whole
        for (name, firsts), stretch in zip(counts.items(), stretches, strict=True):
            places = np.arange(*stretch)
            truth = pair.truth.select(images).on_places(places)
            if truth.has_match.any():
                selection = images
                if name == JUMP:
                    selection = np.append(np.arange(before, before + START_IMAGES), images)
                matches = matches_of(
                    select_places(pair.places, places), pair.query.features[selection]
                )
                length = SETTINGS.sequence.length
                firsts.append(first_right(matches[-START_IMAGES:], truth, length))
    for name, firsts in counts.items():
        yield f'{pair.name}/{name}', firsts


def start_numbers(counts: Sequence[int | None]) -> dict[str, Any]:
    """Return the numbers of a row from the images that each start took."""
    right = [count for count in counts if count is not None]
    return {
        'starts': len(counts),
        'right': len(right),
        'median': float(np.median(right)) if right else None,
        'longest': max(right) if right else None,
    }


def with_standstill(place_map: Map) -> Map:
    """Return a map whose camera stood for ``REST_PLACES`` places more in its middle."""
    n = len(place_map)
    return select_places(place_map, np.sort(np.append(np.arange(n), np.full(REST_PLACES, n // 2))))


@dataclass
class Measurement:
    """
    The table's rows for one kind of features, and the outcomes that are pooled.

    :param coarser: factor on all steps.
    """

    feature: str
    coarser: int = 1
    rows: Results = field(default_factory=dict)
    driven: list[Outcome] = field(default_factory=list)
    off_map: list[Outcome] = field(default_factory=list)

    def add(self, section: str, name: str, values: dict[str, Any]) -> None:
        """Add a row."""
        self.rows[f'{section}/{self.feature}/{name}'] = values

    def pair(self, pair: Pair) -> None:
        """Add the rows of a pair."""
        by_name = dict(drives(pair))
        for name, result in by_name.items():
            self.add('drives', name, result.numbers())
        pooled = [result for name, result in by_name.items() if not name.endswith(LONG_STOP)]
        if len(by_name) > 1:
            self.add('drives', f'{pair.name}/all', Outcome.pool(pooled).numbers())
        each_third = sparse(pair)
        self.add('sparse', pair.name, each_third.numbers())
        self.driven += [*pooled, each_third]
        self.add('set_calibration', pair.name, Outcome.pool([*pooled, each_third]).calibration())
        if not pair.long:
            self.add('reverse', pair.name, drive_pair(pair, DriveChanges(reverse=True)).numbers())
        outcomes = list(detours(pair, self.coarser))
        numbers = [one.numbers() for one in outcomes]
        shares = [one['unseen_matched'] / one['unseen'] for one in numbers if one['unseen']]
        values = Outcome.pool(outcomes).numbers() | {'positions': len(numbers)}
        self.add('detours', pair.name, values | {'worst': max(shares, default=0.0)})
        self.off_map += outcomes
        for name, counts in starts(pair, self.coarser):
            self.add('start', name, start_numbers(counts))

    def floors(self, floors: dict[str, Map]) -> None:
        """Add the rows of floors on maps of other floors: each match is wrong."""
        self.off_map += self._floors(TOWER, floors, floors)
        standing = {name: with_standstill(place_map) for name, place_map in floors.items()}
        self._floors(f'{TOWER}, standstill', standing, floors)

    def _floors(self, name: str, maps: dict[str, Map], floors: dict[str, Map]) -> list[Outcome]:
        pairs = [(a, b) for a in floors for b in floors if a != b][:: self.coarser]
        shares, outcomes = {}, []
        for map_name, query_name in Progress(pairs, desc='floors', leave=False):
            place_map, query = maps[map_name], floors[query_name]
            nothing = GroundTruth(len(query), len(place_map), np.zeros(0, np.int64))
            one = outcome(place_map, query.features, nothing)
            shares[f'{query_name} on {map_name}'] = one.accepted.sum() / len(query)
            outcomes.append(one)
        pooled = Outcome.pool(outcomes)
        worst = max(shares, key=shares.__getitem__)
        matched = int(np.count_nonzero(pooled.accepted))
        values = {'images': int(np.count_nonzero(~pooled.early)), 'matched': matched}
        values |= {'pairs': len(pairs), 'early': int(np.count_nonzero(pooled.early))}
        values['sure'] = int(np.count_nonzero(pooled.sure))
        self.add('floors', name, values | {'worst_pair': worst, 'worst': shares[worst]})
        return outcomes

    def finish(self) -> Results:
        """Add the pooled rows, and return all."""
        if self.driven:
            pooled = Outcome.pool(self.driven)
            self.add('calibration', 'drives', pooled.calibration())
        if self.off_map:
            pooled = Outcome.pool(self.driven + self.off_map)
            self.add('calibration', 'with detours and floors', pooled.calibration())
        return self.rows


def extractor(feature: str, folder: Path) -> FeatureExtractor:
    """
    Return the extractor of a kind of features.

    :raises UnavailableError: its extra or its model is missing.
    """
    if feature in FEATURES:
        return extractors(feature, folder)['robust']
    kind, *model = KINDS[feature].split()
    settings = settings_class(kind)
    return FeatureExtractor(kind, settings(model=model[0]) if model else settings())


def extract_map(source: Any, making: FeatureExtractor) -> Map:
    """Return a map of all images of a source."""
    return build_map(source, making, thumbnails=False, progress=False)


def pairs_of(folder: Path, feature: str, making: FeatureExtractor) -> Iterator[Pair]:
    """Yield the pairs of the data sets; the features of a source are extracted once."""
    pairs: dict[int, tuple[Any, Map]] = {}  # with its source, so that its id stays its own

    def features(source: Any) -> Map:
        if id(source) not in pairs:
            pairs[id(source)] = source, extract_map(source, making)
        return pairs[id(source)][1]

    for case in (*short_cases(folder), *long_cases(folder, feature)):
        if case.name not in SETS:
            continue
        places, query = features(case.places), features(case.query)
        yield Pair(case.name, places, query, case.truth(len(query), len(places)))


def measure(folder: Path, features: Sequence[str], coarser: int) -> Results:
    """Return all rows; report features that are left out."""
    results: Results = {}
    for feature in features:
        try:
            making = extractor(feature, folder)
        except UnavailableError as error:
            print(f'left out: {KINDS[feature]}: {error}', file=sys.stderr)
            continue
        measurement = Measurement(feature, coarser)
        for pair in pairs_of(folder, feature, making):
            print(f'{KINDS[feature]}: {pair.name}', file=sys.stderr)
            measurement.pair(pair)
        paths = sorted(path for path in (folder / TOWER).iterdir() if path.is_dir())
        measurement.floors({path.name: extract_map(open_source(path), making) for path in paths})
        results |= measurement.finish()
    return results


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = options_parser(__doc__, 'gradient features, coarser steps; to off_map-quick')
    parser.add_argument(
        '--features', nargs='+', choices=tuple(KINDS), help=f'default: all but {INT8}'
    )
    options = parser.parse_args(arguments)
    about, began = environment(named_commit=options.commit), time.perf_counter()
    steps = COARSER if options.quick else 1
    every = [feature for feature in KINDS if feature != INT8]
    features = options.features or (['g'] if options.quick else every)
    results = measure(data_folder(), features, steps)
    path = options.output / f'off_map{"-quick" if options.quick else ""}.json'
    step = 'each' if steps == 1 else f'every {steps}th'
    about |= {'stretches': STRETCHES.format(step=step, long=LONG_STRETCHES // steps)}
    write_json(path, about | {'results': results})
    write_lines(path.with_suffix('.md'), markdown(about, results))
    print(*summary_section(results), sep='\n')
    print(f'took {time.perf_counter() - began:.0f} s\nwrote {path} and its page')
    return 0


if __name__ == '__main__':
    sys.exit(main())
