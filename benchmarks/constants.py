# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Half and double of the constants of mode robust, on routes, floors and unrelated routes.

``python benchmarks/constants.py``; ``start=0.5 spread=0.1``: these values alone.
Writes constants.json, and prints the cells for benchmarks/results/evidence.md. The truth of the
office, the track and the hall is the best path of the first kind of features over the whole drive.
"""

from collections.abc import Iterator, Sequence
import contextlib
from dataclasses import dataclass
from itertools import combinations
import json
from pathlib import Path
import sys
from typing import Any

from accuracy import short_cases
from data import data_folder
import numpy as np
from off_map import changed, extracted, extractor, Outcome, outcome, Pair
from off_map_page import HYBRID, KINDS
from results import environment, options_parser, write_json
from sessions import LAP, path
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.errors import InputError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.filter.model import MODEL
from stavpr_ros.mapping import PlaceMap, select_places
from stavpr_ros.sources import open_source

SPEEDS = np.array(MODEL.speeds)
# by meaning: the constants of the place filter, of the checks and of the evidence
CONSTANTS = {
    'weight': 'alpha: evidence of an image over independent ones',
    'levels': 'mean z of right places',
    'speeds': 'half as many; the places between two as well',
    'least_change': 'change of an image over the change of neighboring places, times alpha: least',
    'most_change': 'the same: most',
    'standstill': 'the same change, of a camera at rest: most',
    'keep_level': 'probability of keeping the level (of changing it)',
    'keep_speed': 'probability of keeping the speed (of changing it)',
    'spread': 'probability of one place more than the speed has, and of one less',
    'leave': 'probability of leaving the map at an image',
    'enter': 'probability of entering the map at an image',
    'start': 'probability of starting on the map (beside it)',
    'change_deviation': 'deviation of the logarithm of the change at one speed',
    'speed_weight': 'exponent of the likelihood of a speed',
    'UNEVEN_WEIGHT': 'log odds by the deviation of z beyond the limit',
    'EXCESS': 'logarithm of the change of a path over the change of the map',
    'EXCESS_WEIGHT': 'log odds by the change beyond it',
    'SURE_AT_REST': 'probability that a camera at rest needs (1 less it)',
    'APART': 'places to the nearest look-alike path',
}
COMPLEMENTS = 'keep_level', 'keep_speed', 'start', 'SURE_AT_REST'  # probabilities near 1
CHANGES = 'varying', 'drop 0.3', 'same', 'stop 100'
REMOVED, STOP = 30, 100  # places of a stretch that the map lacks, images of a stop in the second
QUERY = 100  # images of an unrelated route
MOST = 400  # places of a map
HALL = slice(0, 490, 2), slice(500, 1000, 2)  # two laps, every second image
NEW = 'office', 'track', 'hall'  # the filter was not fitted on
OLD = 'walk_night', 'walk_night_map', 'corridor'


@dataclass(frozen=True, eq=False)
class Routes:
    """
    Data sets of a kind of features.

    :param pairs: routes; maps: of different ones; floors: that look alike.
    """

    pairs: Sequence[Pair]
    maps: Sequence[PlaceMap]
    floors: Sequence[PlaceMap]

    @classmethod
    def read(cls, folder: Path, features: FeatureExtractor, positions: dict[str, Any]) -> 'Routes':
        """
        Extract the features.

        :param positions: the best path of each route in ``NEW``; found if empty.
        """
        every = {
            name: extracted(open_source(folder / name), features)
            for name in ('office_circuit/day1', 'office_circuit/day2', 'running_track/lap1',
                         'running_track/lap2', 'donkeycar_hall', 'nordland_64x32/summer')
        }  # fmt: skip
        day1, day2, lap1, lap2, hall, summer = every.values()
        lap, other = (select_places(day, np.arange(LAP)) for day in (day1, day2))
        first, second = (select_places(hall, np.arange(1000)[lap]) for lap in HALL)
        routes = (lap, other, 5), (lap1, lap2, 7), (first, second, 5)
        laps = dict(zip(NEW, routes, strict=True))
        pairs = []
        for name, (places, query, tolerance) in laps.items():
            if name not in positions:
                positions[name] = path(places, query, name != 'track')
            n, off = len(places), np.arange(-tolerance, tolerance + 1)
            around = positions[name][:, None] + off
            around = around % n if name == 'office' else np.clip(around, 0, n - 1)
            images = np.repeat(np.arange(len(query)), len(off))
            truth = GroundTruth.from_pairs(images, around.ravel(), len(query), n)
            truth = truth.on_places(np.arange(min(n, MOST)))
            counted = np.flatnonzero(truth.has_match)[:: 2 if name == 'track' else 1]
            shown = select_places(query, counted)
            pairs.append(Pair(name, _first(places), shown, truth.select(counted)))
        for case in short_cases(folder):
            places, query = (extracted(each, features) for each in (case.places, case.query))
            if case.name in OLD:
                truth = case.truth(len(query), len(places))
                pairs.append(Pair(case.name, places, query, truth))
            elif case.name == 'gardens_point':
                walk = places
        paths = sorted(each for each in (folder / 'tower').iterdir() if each.is_dir())
        floors = [extracted(open_source(each), features) for each in paths]
        maps = [walk, pairs[-1].places, summer, lap, lap1, first, floors[0]]
        return cls(pairs, [_first(each) for each in maps], floors)

    def outcomes(self, quick: bool = False) -> Iterator[tuple[str, Outcome]]:
        """
        Yield the drives, each with the name of its route, ``floors`` or ``unrelated``.

        :param quick: three of seven a route, and half of the others.
        """
        step = 2 if quick else 1
        for pair in self.pairs:
            n = len(pair.query)
            for name in CHANGES[:2] if quick else CHANGES:
                yield pair.name, changed(pair, DriveChanges.named(name, n))
            for quarter in (1, 2, 3)[step - 1 :: step]:
                first = len(pair.places) * quarter // 4 - REMOVED // 2
                removed = (first, first + REMOVED)
                stops = ()
                if quarter == 2:  # in the middle of the stretch
                    image = int(np.argmax(pair.truth.accepts(np.full(n, first + REMOVED // 2))))
                    stops = ((image, STOP),)
                yield pair.name, changed(pair, DriveChanges((removed,), stops=stops))
        pairs = [(a, b) for a in self.floors for b in self.floors if a is not b]
        for a, b in pairs[:: 2 * step]:
            yield 'floors', _nothing(a, b)
        for a, b in list(combinations(self.maps, 2))[::step]:
            middle = max(len(b) - QUERY, 0) // 2
            query = select_places(b, np.arange(middle, min(middle + QUERY, len(b))))
            yield 'unrelated', _nothing(a, query)


def _first(places: PlaceMap) -> PlaceMap:
    """Return the first ``MOST`` places of a map."""
    return select_places(places, np.arange(min(len(places), MOST)))


def _nothing(places: PlaceMap, query: PlaceMap) -> Outcome:
    """Drive a query on a map where no match is right."""
    truth = GroundTruth(len(query), len(places), np.zeros(0, np.int64))
    return outcome(places, query.features, truth)


def value_of(name: str) -> Any:
    """
    Return a constant.

    :raises InputError: there is none of this name.
    """
    if hasattr(MODEL, name):
        return getattr(MODEL, name)
    if not (modules := _modules(name)):
        raise InputError(f'no constant {name!r}; there are {", ".join(CONSTANTS)}')
    return modules[0][name]


def _modules(name: str) -> list[dict[str, Any]]:
    """Return the contents of the modules that know a constant of the checks or the evidence."""
    packages = 'stavpr_ros.filter.', 'stavpr_ros.recognition.'
    modules = [vars(m) for key, m in sys.modules.items() if key.startswith(packages)]
    return [each for each in modules if name in each]


@contextlib.contextmanager
def constant(name: str, value: Any) -> Iterator[None]:
    """Set a constant for a while."""
    before = value_of(name)
    try:
        _set(name, value)
        yield
    finally:
        _set(name, before)


def _set(name: str, value: Any) -> None:
    if hasattr(MODEL, name):
        object.__setattr__(MODEL, name, value)
    else:
        for module in _modules(name):
            module[name] = value


def half_and_double(name: str) -> tuple[Any, Any]:
    """Return half and double of a constant; of probabilities near 1, of what is left to 1."""
    value = value_of(name)
    if name == 'speeds':
        moving = np.array(value[1:])
        between = np.sqrt(moving[:-1] * moving[1:])
        return (0.0, *moving[::2]), (0.0, *np.sort([*moving, *between]))
    if name in COMPLEMENTS:
        return 1 - (1 - value) / 2, 1 - (1 - value) * 2
    if isinstance(value, tuple):
        return tuple(each / 2 for each in value), tuple(each * 2 for each in value)
    return type(value)(value / 2), type(value)(value * 2)


def measured(
    routes: Routes, name: str = '', value: Any = None, quick: bool = False
) -> dict[str, Any]:
    """Return the numbers of all drives with another value of a constant; '' = as they are."""
    with constant(name, value) if name else contextlib.nullcontext():
        return numbers(list(routes.outcomes(quick)))


def numbers(outcomes: Sequence[tuple[str, Outcome]]) -> dict[str, Any]:
    """Return the numbers of a row from all drives."""
    names = dict.fromkeys(name for name, _ in outcomes)
    pooled = {
        name: Outcome.pooled([each for of, each in outcomes if of == name]) for name in names
    }
    rows = {name: each.numbers() for name, each in pooled.items()}
    values: dict[str, Any] = {'routes': rows}
    for group, routes in (('new', NEW), ('old', OLD)):
        for name in ('precision', 'recall'):
            values[f'{name} {group}'] = float(np.mean([rows[route][name] for route in routes]))
    for name in ('floors', 'unrelated'):
        values[name] = rows[name]['matched'] / rows[name]['images']
    unseen, matched = (
        sum(rows[route][name] for route in (*NEW, *OLD)) for name in ('unseen', 'unseen_matched')
    )
    values['unseen'] = matched / unseen
    for name in ('early', 'early_wrong'):
        values[name] = sum(row[name] for row in rows.values())
    return values


def cell(values: dict[str, Any]) -> str:
    """Return the text of a row's cell."""
    pairs = [f'{values[f"precision {a}"]:.3f} {values[f"recall {a}"]:.3f}' for a in ('new', 'old')]
    shares = [f'{100 * values[name]:.1f}' for name in ('floors', 'unrelated', 'unseen')]
    return f'{", ".join(pairs)}, {" ".join(shares)}, {values["early_wrong"]} of {values["early"]}'


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = options_parser(__doc__, 'three of seven drives a route, half of the others')
    parser.add_argument('values', nargs='*', metavar='NAME=VALUE', help='default: half and double')
    kinds = {'default': [HYBRID, 'g'], 'choices': tuple(KINDS), 'nargs': '+'}
    parser.add_argument('--features', **kinds, help='of %(choices)s, default: %(default)s')
    options = parser.parse_args(arguments)
    about, folder, rows = environment(named_commit=options.commit), data_folder(), {}
    settings = [(name, value) for name in CONSTANTS for value in half_and_double(name)]
    if options.values:
        pairs = [each.partition('=') for each in options.values]
        settings = [(name, json.loads(value)) for name, _, value in pairs]
    positions: dict[str, np.ndarray] = {}
    for feature in options.features:
        routes = Routes.read(folder, extractor(feature, folder), positions)
        for name, value in [('', None), *settings]:
            row = measured(routes, name, value, options.quick)
            rows[f'{feature}/{name or "now"}{f"={value}" if name else ""}'] = row
            print(feature, name or 'now', value or '', cell(row), flush=True)
    write_json(options.output / 'constants.json', about | {'results': rows})
    return 0


if __name__ == '__main__':
    sys.exit(main())
