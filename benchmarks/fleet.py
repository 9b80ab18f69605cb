# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recognition on a fleet's map beside exact recognition: a real route among distractors.

The distractors are real images of other places (``DISTRACTORS``) and routes that are generated of
them: each a walk of 500 places, a mean of the features of two of the traverses, of a random start
and direction each, at random speeds of 0.5 to 2, with their strips shifted sideways, unit norm.
"""

from pathlib import Path
import tempfile
import time

from data import data_folder
import numpy as np
from results import parser_of
from stavpr_fleet import FleetRecognizer, open_city_map, upload
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import build_map, descriptor_map, Map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.prepare.centering import unit_norm
from stavpr_ros.sources import open_source

ROUTES = {
    'gardens_point/day_left': 'gardens_point/day_right',
    'walk_by_night/left_day': 'walk_by_night/right_night',
}
OFF_THE_MAP = 'tower/floor5'
DISTRACTORS = ('corridor/ref', 'nordland_64x32/summer')
ROUTE = 500  # places of a generated route
TOLERANCE = 2
SETTINGS = RecognizerSettings(mode='robust')


def generate_places(traverses: list[LocalFeatures], count: int) -> LocalFeatures:
    """Return the features of ``count`` generated places, see the module."""
    rng = np.random.default_rng(0)
    W, _, d = traverses[0].strips.shape
    strips, weights = np.empty((W, count, d), np.float32), np.full((W, count), W**-0.5, np.float32)
    for low in range(0, count, ROUTE):
        high = min(low + ROUTE, count)
        total = np.zeros((W, high - low, d), np.float32)
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


def city(route: Map, distractors: list[Map], count: int) -> tuple[Map, int]:
    """Return a map of ``count`` places, the route in its middle, and the route's first place."""
    others = [one.features for one in distractors]
    extra = count - len(route) - sum(map(len, others))
    if extra > 0:
        others.append(generate_places(others, extra))
    joined = LocalFeatures.concatenate(others)
    first = len(joined) // 2
    parts = [joined[:first], route.features, joined[first:]]
    return descriptor_map(LocalFeatures.concatenate(parts)), first


def drive_places(
    recognizer: PlaceRecognizer | FleetRecognizer, query: LocalFeatures, times: list[float]
) -> list[int]:
    """Drive a query; return the place of each window, -1 = not matched."""
    recognizer.reset()
    places = []
    for i in range(len(query)):
        began = time.perf_counter()
        match = recognizer.update(query[i : i + 1])
        times.append((time.perf_counter() - began) * 1e3)
        places.append(match.place)
    return places[SETTINGS.sequence.length - 1 :]


def run(
    recognizer: PlaceRecognizer | FleetRecognizer,
    query: LocalFeatures,
    off_the_map: LocalFeatures,
    first: int,
) -> str:
    """Return cells of a row: precision, recall, images matched off the map, times."""
    times: list[float] = []
    places = np.array(drive_places(recognizer, query, times))
    middles = first + np.arange(len(places)) + (SETTINGS.sequence.length - 1) // 2
    right = np.count_nonzero(abs(places - middles) <= TOLERANCE)
    matched = int(np.count_nonzero(places >= 0))
    off = drive_places(recognizer, off_the_map, times)
    return (
        f'{right / max(matched, 1):.3f} | {right / len(places):.3f} | '
        f'{sum(place >= 0 for place in off)} of {len(off)} | '
        f'{np.median(times):.0f} | {np.percentile(times, 99):.0f}'
    )


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    parser.add_argument('--places', type=int, nargs='+', default=[20_000])
    parser.add_argument('--homes', nargs='+', default=['faiss', 'qdrant'])
    arguments = parser.parse_args()
    extractor = FeatureExtractor('gradient')
    opened = {
        name: build_map(open_source(data_folder() / name), extractor, progress=False)
        for name in (*ROUTES, *ROUTES.values(), OFF_THE_MAP, *DISTRACTORS)
    }
    print(
        '| query | places | home | precision | recall | off the map | ms, p50 | p99 | upload, s |'
    )
    print(f'|{"---|" * 9}')
    for count in arguments.places:
        for name, driven in ROUTES.items():
            whole, first = city(opened[name], [opened[one] for one in DISTRACTORS], count)
            inputs = opened[driven].features, opened[OFF_THE_MAP].features, first
            exact = run(PlaceRecognizer(whole, SETTINGS), *inputs)
            print(f'| {driven} | {count:,} | exact | {exact} | |', flush=True)
            for home in arguments.homes:
                with tempfile.TemporaryDirectory() as folder:
                    began = time.perf_counter()
                    address = f'{home}:{Path(folder, home)}'
                    upload(whole, address)
                    place_map = open_city_map(address)
                    spent = time.perf_counter() - began
                    result = run(FleetRecognizer(place_map, SETTINGS, timeout=60), *inputs)
                print(f'| {driven} | {count:,} | {home} | {result} | {spent:.1f} |', flush=True)


if __name__ == '__main__':
    main()
