# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Front, rear and panoramic cameras on the synthetic street, on the way out and on the way back.

``python benchmarks/directions.py [SEED]`` writes benchmarks/results/directions.md and .png. Maps
are by day, drives in the other lane. A panorama is the front and the rear image side by side.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import cycle
from math import degrees, pi
import sys

import numpy as np
from results import environment, RESULTS, table, write_lines
from stavpr_lab.demonstration.street.street import make_street, Street, VIEW
from stavpr_lab.demonstration.street.traverses import (
    AFTERNOON,
    Conditions,
    GOOD_LIGHT,
    LENGTH,
    PLACES,
    RAINY_DUSK,
    Traverse,
)
from stavpr_lab.evaluation import plots
from stavpr_lab.evaluation.evaluate import evaluate_on_map, Evaluation
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import descriptor_map, merge_maps, PlaceMap
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from stavpr_ros.threads import limit_threads
from timing import Job, measure, timed

TOLERANCE = 3  # places, 6 m
SIZE = 160, 120
DRIVEN = 330  # images of a drive
SIZES = PLACES, 2_000
HEAD = ['map', 'camera', 'direction', 'matched', 'declared .9', 'P', 'R', 'R at P .99']


@dataclass(frozen=True)
class Line:
    """A street without detour, from its start or from its end, that begins before the places."""

    seed: int
    from_end: bool = False

    @cached_property
    def streets(self) -> tuple[Street, Street]:
        """Return the street, twice."""
        street = make_street(self.seed, LENGTH + VIEW)
        return (street.backward() if self.from_end else street,) * 2


def images(
    seed: int, along: np.ndarray, conditions: Conditions, is_rear: bool
) -> list[np.ndarray]:
    """Render the images of a camera of a robot that drives out; along: of each, meters."""
    line = Line(seed, is_rear)
    if is_rear:
        turn = 180 + degrees(Line(seed).streets[0].headings[-1])
        along = line.streets[0].reach - along
        conditions = replace(
            conditions, lane=-conditions.lane, sun_azimuth=conditions.sun_azimuth - turn
        )
    traverse = Traverse(line, along, np.zeros(len(along), bool), conditions, size=SIZE)
    return [frame.image for frame in traverse]


class Cameras:
    """Images of a drive out, by camera."""

    def __init__(self, seed: int, along: np.ndarray, conditions: Conditions) -> None:
        front, rear = (images(seed, along, conditions, is_rear) for is_rear in (False, True))
        half = SIZE[0] // 2
        panorama = [
            np.concatenate([b[:, half:], a, b[:, :half]], axis=1)
            for a, b in zip(front, rear, strict=True)
        ]
        turned = [np.roll(image, image.shape[1] // 2, axis=1) for image in panorama]
        self.of = {'front': front, 'rear': rear, 'panorama': panorama, 'turned panorama': turned}

    def features(self, camera: str, is_back: bool, is_mirrored: bool = False) -> LocalFeatures:
        """Return the features of the images in the order of the drive."""
        step = -1 if is_mirrored else 1
        each = [np.ascontiguousarray(image[:, ::step]) for image in self.of[camera]]
        return FeatureExtractor('gradient').extract(each[::-1] if is_back else each)

    def map_of(self, *cameras: str) -> PlaceMap:
        """Return the map of one camera, or of two that look ahead and back."""
        maps = [descriptor_map(self.features(camera, False)) for camera in cameras]
        if len(maps) == 1:
            return maps[0]
        return merge_maps(maps, cameras, list(zip(cameras, (0.0, pi), strict=True)))


def positions(seed: int) -> np.ndarray:
    """Return where the images of a drive are, meters, at half to twice the mean speed."""
    drawn = np.random.default_rng(seed).random(12)
    at = np.interp(np.arange(DRIVEN), np.linspace(0, DRIVEN, 12), drawn)
    meters = np.cumsum(0.5 * 4**at)
    return VIEW + LENGTH * 0.999 * (meters - meters[0]) / (meters[-1] - meters[0])


# map, camera of the drive on the way out, whether it comes back: its images in reverse order, that
# a camera at the other side takes; whether they are mirrored; direction; number of the session
# that shows them, None = none
CASES = [
    (('front',), 'front', False, False, 'forward', 0),
    (('front',), 'front', False, False, 'both', 0),
    (('front',), 'front', True, False, 'both', 0),
    (('front', 'rear'), 'front', False, False, 'both', 0),
    (('front', 'rear'), 'front', True, False, 'both', 0),
    (('front', 'rear'), 'rear', True, False, 'both', 1),
    (('front', 'rear'), 'rear', False, False, 'both', 1),
    (('panorama', 'turned panorama'), 'panorama', False, False, 'both', 0),
    (('panorama', 'turned panorama'), 'turned panorama', True, False, 'both', 1),
    (('front',), 'rear', True, False, 'both', None),
    (('front',), 'rear', False, False, 'both', None),
    (('front',), 'front', True, True, 'both', None),
    (('front', 'rear'), 'rear', True, True, 'both', None),
    (('front', 'rear'), 'front', True, True, 'both', None),
]


def name_of(camera: str, is_back: bool, is_mirrored: bool) -> str:
    """Return the camera that takes the images of a camera of the drive out, in words."""
    if is_back:
        others = {'front': 'rear', 'rear': 'front', 'turned panorama': 'panorama'}
        camera = f'{others[camera]}, on the way back'
    return f'{camera}, mirrored' if is_mirrored else camera


def row_of(evaluation: Evaluation) -> list[str]:
    """Return the cells of a drive."""
    results, truth = evaluation.results, evaluation.ground_truth
    accepted, correct = results.accepted, evaluation.correct
    cells = [
        f'{accepted.sum()} of {len(accepted)}',
        str(int((accepted & (results.probabilities >= 0.9)).sum())),
    ]
    if not truth.has_match.any():
        return [*cells, '', '', '']
    precision = (accepted & correct).sum() / max(accepted.sum(), 1)
    curve = evaluation.sequence.curve
    best = curve[curve[:, 1] >= 0.99, 2].max(initial=0)
    return [*cells, f'{precision:.3f}', f'{(accepted & correct).mean():.3f}', f'{best:.3f}']


def drives(seed: int) -> Iterator[tuple[str, list[str], Evaluation]]:
    """Drive all cases; yield the light, the cells of a row, and the evaluation."""
    places = VIEW + np.arange(PLACES) * LENGTH / PLACES
    mapped, along = Cameras(seed, places, GOOD_LIGHT), positions(seed)
    nearest = np.argmin(abs(along[:, None] - places), axis=1)
    lights = {'afternoon': AFTERNOON, 'rainy dusk': RAINY_DUSK}
    for light, conditions in lights.items():
        driven = Cameras(seed, along, conditions)
        for cameras, camera, is_back, is_mirrored, direction, session in CASES:
            place_map = mapped.map_of(*cameras)
            right = nearest[::-1] if is_back else nearest
            right = np.full(DRIVEN, -1) if session is None else right + session * PLACES
            truth = GroundTruth.from_pairs(
                np.arange(DRIVEN), right, DRIVEN, len(place_map), TOLERANCE
            )
            query = driven.features(camera, is_back, is_mirrored)
            settings = RecognizerSettings(direction=direction)
            evaluation = evaluate_on_map(place_map, query, truth, settings)
            label = name_of(camera, is_back, is_mirrored)
            yield light, [' and '.join(cameras), label, direction], evaluation


def cost() -> list[list[str]]:
    """Return milliseconds of an image by places: one camera, both directions, two cameras."""
    rng, rows = np.random.default_rng(0), []
    for n in SIZES:
        strips = rng.standard_normal((7, n, 224), np.float32)
        strips /= np.linalg.norm(strips, axis=2, keepdims=True)
        features = LocalFeatures(
            strips, np.ones((7, n), np.float32), FeatureExtractor('gradient').settings
        )
        one_camera = descriptor_map(features)
        two = merge_maps([one_camera] * 2, ['front', 'rear'], [('front', 0.0), ('rear', pi)])
        images = [features[i : i + 1] for i in range(100)]

        def job(place_map: PlaceMap, direction: str, images: list[LocalFeatures] = images) -> Job:
            one = PlaceRecognizer(place_map, RecognizerSettings(direction=direction))
            each = cycle(images)
            return timed(lambda: one.update(next(each)))

        jobs = {
            'forward': job(one_camera, 'forward'),
            'both': job(one_camera, 'both'),
            'two cameras, both': job(two, 'both'),
        }
        times = {name: timing.median_s for name, timing in measure(jobs, 6.0).items()}
        rows += [
            [f'{n:,}', name, f'{1e3 * value:.2f}', f'{value / times["forward"]:.2f}']
            for name, value in times.items()
        ]
    return rows


def draw(evaluation: Evaluation) -> None:
    """Draw the distances and the matches of a drive, benchmarks/results/directions.png."""
    results, truth = evaluation.results, evaluation.ground_truth
    outcomes = plots.outcomes(results.accepted, evaluation.correct, truth.has_match)
    pairs = np.column_stack([np.arange(truth.N), results.sequence.best])
    matches = {name: pairs[outcomes == name] for name in ('right', 'wrong')}
    shape, path = (truth.N, truth.n), RESULTS / 'directions.png'
    plots.reduced_matrix(path, results.distances.values, shape, None, matches)


def main(arguments: list[str]) -> int:
    """Run the command."""
    seed = int(arguments[0]) if arguments else 7
    limit_threads(1)
    lines = [
        '# Front, rear and panoramic cameras, out and back',
        '',
        f'`python benchmarks/directions.py {seed}`: maps of {PLACES} places of the street by day,',
        f'drives of {DRIVEN} images in the other lane at half to twice the speed. P, R: matches',
        f'at .5 within {TOLERANCE} places, in the right session. A panorama is the front image',
        'between the halves of the rear one; its map has both yaws, 0 and 180 degrees.',
        '',
    ]
    by_light: dict[str, list[list[str]]] = {}
    for light, cells, evaluation in drives(seed):
        by_light.setdefault(light, []).append([*cells, *row_of(evaluation)])
        print(light, *by_light[light][-1], sep=' | ', flush=True)
        if cells[:2] == ['front and rear', 'front, on the way back'] and light == 'rainy dusk':
            draw(evaluation)
    for light, rows in by_light.items():
        lines += [f'## {light.capitalize()}', '', *table(HEAD, rows)]
    lines += [
        '![distances and matches](directions.png)',
        '',
        'Distances and matches of the front camera on the way back, in rain at dusk, on both.',
        '',
        '## Cost',
        '',
        f'Gaussian features, one thread, {environment()["machine"]["cpu"]}, medians of an image:',
        '',
        *table(['places', 'direction', 'ms', 'over forward'], cost()),
    ]
    write_lines(RESULTS / 'directions.md', lines)
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
