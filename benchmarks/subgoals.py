# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Temporal consistency of subgoals for learned policies: ours beside PlaceNav's filter.

The place of each image by the place of the nearest single image, by the topological filter of
PlaceNav (github.com/lasuomela/PlaceNav, after Xu et al., "Probabilistic Visual Place Recognition
for Hierarchical Localization"), written anew with its parameters, and by ``PlaceRecognizer`` in
mode robust, which keeps the last place where an image has no match. All have the same features;
they are one unit vector an image for the first two. ``python benchmarks/subgoals.py``, on Gardens
Point in STAVPR_DATA, in half a minute.
"""

from collections.abc import Iterator
from pathlib import Path

from data import data_folder
import numpy as np
from results import parser_of
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import build_map, extract_features
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.sources import open_source

DELTA, BEHIND, AHEAD = 5, -2, 10  # of PlaceNav: spread of likelihoods, motion in places an image
TOLERANCE, JUMP = 5, 5  # places from the truth; from the step that the truth makes
CASES = {
    'left to right, by day': ('gardens_point/day_left', 'gardens_point/day_right'),
    'right to left, by day': ('gardens_point/day_right', 'gardens_point/day_left'),
}


def placenav(distances: np.ndarray) -> np.ndarray:
    """Return the place of each image, (N,), from distances of unit vectors, (N, n)."""
    low, high = np.quantile(distances[0], [0.025, 0.975])
    likelihood = np.exp(-np.log(DELTA) / (high - low) * distances)
    belief, kernel, places = likelihood[0], np.ones(AHEAD - BEHIND), []
    for row in likelihood:
        padded = np.pad(belief, len(kernel) - 1, mode='symmetric')
        spread = np.convolve(padded, kernel, mode='valid')[-BEHIND : len(belief) - BEHIND]
        belief = spread * row / (spread * row).sum()
        places.append(belief.argmax())
    return np.array(places)


def ours(recognizer: PlaceRecognizer, queries: LocalFeatures) -> Iterator[int]:
    """Yield the place of each image; without a match the last one, at first -1."""
    place = -1
    for i in range(len(queries)):
        match = recognizer.update(queries[i : i + 1])
        place = match.newest if match.accepted else place
        yield place


def numbers(places: np.ndarray) -> str:
    """Return a row of the table: image i shows place i."""
    has = places >= 0
    right = np.abs(places - np.arange(len(places))) <= TOLERANCE
    steps = np.diff(places[has]) - 1
    return (
        f'{right.mean():.3f} | {right[has].mean():.3f} | {(np.abs(steps) > JUMP).sum()} | '
        f'{steps.std():.2f}'
    )


def main() -> None:
    """Print the table."""
    parser_of(__doc__).parse_args()
    print('| drive | method | right | right, of those with a place | jumps | deviation of steps |')
    print('|---|---|---|---|---|---|')
    for name, folders in CASES.items():
        paths: list[Path] = [data_folder() / folder for folder in folders]
        place_map = build_map(open_source(paths[0]), FeatureExtractor('gradient'), progress=False)
        queries = extract_features(open_source(paths[1]), place_map.extractor())
        vectors = [
            np.concatenate(features.strips.astype(np.float64), axis=1)
            for features in (place_map.features, queries)
        ]
        mean = vectors[0].mean(axis=0)
        a, b = (v - mean for v in vectors)
        a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
        distances = np.sqrt(np.maximum(0, 2 - 2 * b @ a.T))
        recognizer = PlaceRecognizer(place_map, RecognizerSettings(mode='robust'))
        methods = {
            'nearest image': distances.argmin(axis=1),
            "PlaceNav's filter": placenav(distances),
            'ours': np.array(list(ours(recognizer, queries))),
        }
        for method, places in methods.items():
            print(f'| {name} | {method} | {numbers(places)} |')


if __name__ == '__main__':
    main()
