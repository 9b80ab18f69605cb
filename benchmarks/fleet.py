# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recognition on a fleet's map beside exact recognition: Gardens Point among distractors.

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

MAP, QUERY = 'gardens_point/day_left', 'gardens_point/day_right'
NIGHT = 'walk_by_night/right_night'
DISTRACTORS = ('walk_by_night/left_day', 'corridor/ref', 'nordland_64x32/summer', 'tower/floor3')
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


def city(real: PlaceMap, distractors: list[PlaceMap], count: int) -> PlaceMap:
    """Return a map of ``count`` places, with the real ones at its middle."""
    features = [one.features for one in distractors]
    extra = max(0, count - len(real) - sum(map(len, features)))
    if extra:
        features.append(generated(features, extra))
    others = LocalFeatures.concatenate(features)
    middle = len(others) // 2
    parts = [others[:middle], real.features, others[middle:]]
    return descriptor_map(LocalFeatures.concatenate(parts))


def run(
    recognizer: PlaceRecognizer | FleetRecognizer, query: LocalFeatures, first: int
) -> tuple[str, list[float]]:
    """Drive the query; return precision, recall and accepted images, and ms of each image."""
    accepted, right, times = 0, 0, []
    for i in range(len(query)):
        began = time.perf_counter()
        match = recognizer.update(query[i : i + 1])
        times.append((time.perf_counter() - began) * 1e3)
        if match.accepted and match.sequence is not None:
            accepted += 1
            middle = i - (SETTINGS.sequence.length - 1) + (SETTINGS.sequence.length - 1) // 2
            right += abs(match.sequence.middle - first - middle) <= TOLERANCE
    windows = len(query) - SETTINGS.sequence.length + 1
    precision = f'{right / accepted:.3f}' if accepted else '-'
    return f'{precision} | {right / windows:.3f}', times


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--places', type=int, nargs='+', default=[5_000, 20_000])
    parser.add_argument('--homes', nargs='+', default=['memory', 'faiss', 'qdrant'])
    arguments = parser.parse_args()
    extractor = FeatureExtractor()
    opened = {
        name: build_map(open_source(data_folder() / name), extractor, progress=False)
        for name in (MAP, QUERY, *DISTRACTORS)
    }
    distractors = [opened[name] for name in DISTRACTORS]
    query = opened[QUERY].features
    print('| places | home | precision | recall | ms, median | ms, 99 % | s, upload |')
    print('|---|---|---|---|---|---|---|')
    for places in arguments.places:
        whole = city(opened[MAP], distractors, places)
        first = (len(whole) - len(opened[MAP])) // 2
        first = (
            int(
                np.argmax(
                    [
                        torch.equal(whole.features.strips[:, i], opened[MAP].features.strips[:, 0])
                        for i in range(first - 2, first + 3)
                    ]
                )
            )
            + first
            - 2
        )
        exact = PlaceRecognizer(whole, SETTINGS)
        _row(places, 'exact', *run(exact, query, first))
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
                recognizer = FleetRecognizer(place_map, SETTINGS, patience=60)
                _row(places, home, *run(recognizer, query, first), spent)


def _row(
    places: int, home: str, numbers: str, times: list[float], spent: float | None = None
) -> None:
    middle, high = np.median(times), np.percentile(times, 99)
    upload_time = '' if spent is None else f'{spent:.1f}'
    print(f'| {places:,} | {home} | {numbers} | {middle:.0f} | {high:.0f} | {upload_time} |')


if __name__ == '__main__':
    main()
