# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recognition on a fleet's map beside exact recognition: two real routes among distractors.

The distractors are real images of other places (``DISTRACTORS``) and routes that are generated of
them: each a walk of 500 places, a mean of the features of two of the traverses, of a random start
and direction each, at random speeds of 0.5 to 2, with their strips shifted sideways, unit norm.
"""

import argparse
from pathlib import Path
import tempfile
import time

from data import data_folder
import numpy as np
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.fleet import CityMap, FleetRecognizer, MemoryStore, open_city_map, upload
from stavpr_ros.mapping import build_map, descriptor_map, PlaceMap
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from stavpr_ros.recognition.robust import unit_norm
from stavpr_ros.sources import open_source
import torch

ROUTES = {
    'gardens_point/day_left': ('gardens_point/day_right',),
    'walk_by_night/left_day': ('walk_by_night/right_night',),
}
OFF_THE_MAP = 'tower/floor5'
DISTRACTORS = ('corridor/ref', 'nordland_64x32/summer')
ROUTE = 500  # places of a generated route
TOLERANCE = 2
SETTINGS = RecognizerSettings(0.5, mode='robust')


def generated(traverses: list[LocalFeatures], count: int, seed: int = 0) -> LocalFeatures:
    """Return the features of ``count`` generated places, see the module."""
    rng = np.random.default_rng(seed)
    W, _, d = traverses[0].strips.shape
    strips, weights = torch.empty(W, count, d), torch.full((W, count), W**-0.5)
    for low in range(0, count, ROUTE):
        high = min(low + ROUTE, count)
        total = torch.zeros(W, high - low, d)
        for _ in range(2):
            source = traverses[rng.integers(len(traverses))].strips
            n = source.shape[1]
            steps = np.cumsum(rng.choice([-1, 1]) * rng.uniform(0.5, 2, high - low))
            places = np.rint(rng.integers(n) + steps).astype(np.int64)
            places = np.abs((places + n) % (2 * n) - n) % n  # back and forth
            shifted = np.roll(np.arange(W), rng.integers(-2, 3))
            total += source[shifted][:, places]
        strips[:, low:high] = unit_norm(total)
    return LocalFeatures(strips, weights, traverses[0].settings)


def city(opened: dict[str, PlaceMap], count: int) -> tuple[PlaceMap, dict[str, int]]:
    """Return a map of ``count`` places, and the first place of each of ``ROUTES``."""
    others = [opened[name].features for name in DISTRACTORS]
    extra = count - sum(len(opened[name]) for name in (*ROUTES, *DISTRACTORS))
    if extra > 0:
        others.append(generated(others, extra))
    distractors = LocalFeatures.concatenate(others)
    parts, firsts, share = [], {}, len(distractors) // (len(ROUTES) + 1)
    for i, name in enumerate(ROUTES):
        parts.append(distractors[i * share : (i + 1) * share])
        firsts[name] = sum(map(len, parts))
        parts.append(opened[name].features)
    parts.append(distractors[len(ROUTES) * share :])
    return descriptor_map(LocalFeatures.concatenate(parts)), firsts


def accepted(
    recognizer: PlaceRecognizer | FleetRecognizer, query: LocalFeatures, times: list[float]
) -> list[int]:
    """Drive a query; return the place of each window, -1 = not matched."""
    recognizer.reset()
    places = []
    for i in range(len(query)):
        began = time.perf_counter()
        match = recognizer.update(query[i : i + 1])
        times.append((time.perf_counter() - began) * 1e3)
        nearest = match.sequence
        places.append(nearest.middle if match.accepted and nearest is not None else -1)
    return places[SETTINGS.sequence.length - 1 :]


def run(
    recognizer: PlaceRecognizer | FleetRecognizer,
    opened: dict[str, PlaceMap],
    firsts: dict[str, int],
) -> str:
    """Return the cells of a row: precision / recall of each query, images matched off the map."""
    times: list[float] = []
    cells = []
    for name, queries in ROUTES.items():
        for query in queries:
            places = np.array(accepted(recognizer, opened[query].features, times))
            middles = firsts[name] + np.arange(len(places)) + (SETTINGS.sequence.length - 1) // 2
            right = np.count_nonzero(abs(places - middles) <= TOLERANCE)
            matched = np.count_nonzero(places >= 0)
            cells.append(f'{right / max(matched, 1):.3f} / {right / len(places):.3f}')
    off = accepted(recognizer, opened[OFF_THE_MAP].features, times)
    cells.append(f'{sum(place >= 0 for place in off)} of {len(off)}')
    cells.append(f'{np.median(times):.0f} / {np.percentile(times, 99):.0f}')
    return ' | '.join(cells)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--places', type=int, nargs='+', default=[20_000])
    parser.add_argument('--homes', nargs='+', default=['memory', 'faiss', 'qdrant'])
    arguments = parser.parse_args()
    extractor = FeatureExtractor()
    queries = [query for some in ROUTES.values() for query in some]
    opened = {
        name: build_map(open_source(data_folder() / name), extractor, progress=False)
        for name in (*ROUTES, *queries, OFF_THE_MAP, *DISTRACTORS)
    }
    print(f'| places | home | {" | ".join(queries)} | off the map | ms, p50 / p99 | upload, s |')
    print(f'|{"---|" * (5 + len(queries))}')
    for places in arguments.places:
        whole, firsts = city(opened, places)
        exact = run(PlaceRecognizer(whole, SETTINGS), opened, firsts)
        print(f'| {places:,} | exact | {exact} | |', flush=True)
        for home in arguments.homes:
            with tempfile.TemporaryDirectory() as folder:
                began = time.perf_counter()
                if home == 'memory':
                    place_map = CityMap.of(MemoryStore(whole))
                else:
                    path = Path(folder, home)
                    upload(whole, f'{home}:{path}')
                    place_map = open_city_map(f'{home}:{path}')
                spent = time.perf_counter() - began
                found = run(FleetRecognizer(place_map, SETTINGS, patience=60), opened, firsts)
                print(f'| {places:,} | {home} | {found} | {spent:.1f} |', flush=True)


if __name__ == '__main__':
    main()
