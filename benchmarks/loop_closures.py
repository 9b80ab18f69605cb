# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Loop closures of routes that are driven twice, and of unrelated or reversed second drives.

``fit.py --routes`` writes it, on the routes of the fit. A right closure counts 1, a
wrong one -20; with the constant K that is best without a route's group, the route is left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from drives import Sets
from fit_windows import half_and_double, set_value, value_of
import numpy as np
from off_map_page import KINDS
from results import table
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.features import LocalFeatures, registry
from stavpr_ros.mapping import Map
from stavpr_ros.method import RecognizerSettings
from stavpr_ros.method.loop_closer import LoopCloser

MAX_FIRST, MAX_SECOND = 900, 450  # images of a drive, at most
EXCLUDED, EVERY = 30, 3  # latest places that are no closures; of the negatives that are driven
STEPS = -0.6, -0.3, 0.0, 0.3, 0.6  # changes of K
NUMBERS = 'CONFIRMED', 'ROUTE_IMAGES'
WRONG = 20.0


class Drives(NamedTuple):
    """Two drives, the second one's truth on the first one (None = no place is right), groups."""

    first: Map
    second: Map
    truth: GroundTruth | None
    groups: tuple[str, ...]


def drives_twice(sets: Sets) -> Iterator[Drives]:
    """Yield the pairs of drives."""
    for kind, group, pair in sets.pairs:
        if kind not in ('crops', 'damaged night'):
            yield Drives(pair.places, pair.query, pair.truth, (group,))
    unrelated = [negative for negative in sets.negatives if negative[0] != 'floors']
    for _, groups, first, second in unrelated[::EVERY]:
        yield Drives(first, second, None, groups)


def closures(drives: Drives) -> np.ndarray:
    """Return how many closures of the second drive are right and wrong, on time and late, (4,)."""
    first, second = drives.first.features[:MAX_FIRST], drives.second.features[:MAX_SECOND]
    strips, weights = (
        np.concatenate([getattr(part, name)[:] for part in (first, second)], axis=1)
        for name in ('strips', 'weights')
    )
    route = LocalFeatures(strips, weights, first.settings, first.cells)
    closer, counts = LoopCloser(RecognizerSettings(), EXCLUDED, route.settings), np.zeros(4, int)
    for i in range(len(route)):
        match = closer.update(route[i : i + 1], (i + 1) * 100_000_000)
        for closure, late in [(match, 0)] * match.accepted + [(late, 1) for late in match.late]:
            image = closure.first_image + closure.position - len(first)
            if image >= 0:
                counts[2 * late + (not is_right(drives.truth, image, closure.place))] += 1
    return counts


def is_right(truth: GroundTruth | None, image: int, place: int) -> bool:
    """Whether an image shows a place."""
    return truth is not None and bool(
        truth.select(np.array([image])).accepts(np.array([place]))[0]
    )


def routes_section(sets: Sets, feature: str) -> list[str]:
    """Return the lines on the closures of a kind of features."""
    drives, kind = list(drives_twice(sets)), KINDS[feature].split()[0]
    entry, cells = registry.KINDS[kind], []

    def measure(k: float) -> np.ndarray:
        registry.KINDS[kind] = replace(entry, route=k)
        return np.array([closures(pair) for pair in drives])

    by_k = {round(entry.route + step, 2): measure(entry.route + step) for step in STEPS}
    for k, counts in by_k.items():
        cells.append([f'K {k}', *_cells(drives, counts)])
    left_out = np.array([by_k[_best(drives, by_k, d.groups)][i] for i, d in enumerate(drives)])
    cells.append(['K left out', *_cells(drives, left_out)])
    for name in NUMBERS:
        before = value_of(name)
        values = (0.86, 0.965) if name == 'CONFIRMED' else half_and_double(name)
        for value in values:  # of a probability, half and double of the odds against it
            set_value(name, value)
            cells.append([f'{name} {value:g}', *_cells(drives, measure(entry.route))])
        set_value(name, before)
    registry.KINDS[kind] = entry
    head = kind, 'right, on time + late', 'wrong', 'wrong on unrelated and reversed drives'
    return table(head, cells)


def _best(drives: Sequence[Drives], by_k: dict[float, Any], groups: tuple[str, ...]) -> float:
    """Return the K of the most right closures, less wrong ones, of drives without the groups."""
    rows = [not set(pair.groups) & set(groups) for pair in drives]
    score = np.array([1, -WRONG, 1, -WRONG])
    return max(by_k, key=lambda k: float((by_k[k][rows] @ score).sum()))


def _cells(drives: Sequence[Drives], counts: np.ndarray) -> list[str]:
    is_route = np.array([pair.truth is not None for pair in drives])
    routes, others = counts[is_route].sum(axis=0), counts[~is_route].sum(axis=0)
    pairs = routes[[0, 2]], routes[[1, 3]], others[[1, 3]]
    return [f'{on_time} + {late}' for on_time, late in pairs]
