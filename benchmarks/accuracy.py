# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Accuracy table: precision, recall and F1 of both modes on the data sets.

``make accuracy``, ``make accuracy ARGS=--quick``. Data sets and columns: benchmarks/README.md.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import json
from pathlib import Path
import sys
import time
from typing import Any

from data import data_folder
import numpy as np
from results import environment, heading, options_parser, table, write_json, write_lines
from stavpr_lab.evaluation.drive import crop, DriveChanges, KINDS
from stavpr_lab.evaluation.evaluate import (
    evaluate_loop_closures,
    evaluate_on_map,
    Evaluation,
    recognize_traverse,
)
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import accepted_counts
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import build_map, Map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.sources import open_source

MODES = ('paper', 'robust')
FEATURES = {'g': 'gradient', 'o': 'SqueezeNet 1.1, fire6/concat_1'}
NETWORK = 'squeezenet1_1_imagenet/squeezenet_fp16.onnx'
EXCLUDED = 20  # latest images in the hallway loop, as its ground truth has them
Results = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Case:
    """
    A query on a map.

    :param name: name of the case in the table.
    :param places, query: images of the map and of the query.
    :param truth: function of the numbers of queries and places.
    :param warps: also at other speeds of the query.
    """

    name: str
    places: Any
    query: Any
    truth: Callable[[int, int], GroundTruth]
    warps: bool = False


def identity(tolerance: int) -> Callable[[int, int], GroundTruth]:
    """Return the ground truth of sequences that are aligned image by image."""
    return lambda queries, places: GroundTruth.identity(queries, places, tolerance)


def short_cases(folder: Path) -> Iterator[Case]:
    """Yield the cases of both forms."""

    def images(name: str) -> Any:
        return open_source(folder / name)

    left, right = images('gardens_point/day_left'), images('gardens_point/day_right')
    yield Case('gardens_point', left, right, identity(2), warps=True)
    day, other_day, night = (
        images(f'walk_by_night/{name}') for name in ('left_day', 'right_day', 'right_night')
    )
    yield Case('walk_day', day, other_day, identity(2))
    yield Case('walk_night', day, night, identity(2), warps=True)
    yield Case('walk_night_map', night, day, identity(2))

    def corridor(queries: int, places: int) -> GroundTruth:
        return GroundTruth.from_file(folder / 'corridor/ground_truth.csv', queries, places, 0)

    yield Case('corridor', images('corridor/ref'), images('corridor/query'), corridor)


def long_cases(folder: Path, feature: str) -> Iterator[Case]:
    """Yield the cases of the full form."""
    summer, winter = (
        open_source(folder / 'nordland_64x32' / name) for name in ('summer', 'winter')
    )
    yield Case('nordland', summer, winter, identity(3))
    if feature == 'g':
        shifted = crop(summer, 0, 0.3), crop(winter, 0.1, 0)
        yield Case('synth_nordland', *shifted, identity(3))


def extractors(feature: str, folder: Path) -> dict[str, FeatureExtractor]:
    """
    Make the extractor of a feature for each mode.

    Mode paper is the reference and stays as it was: gradients of the intensity itself.

    :raises UnavailableError: the extra ``onnx`` or the network's file is missing.
    """
    if feature == 'g':
        linear = settings_class('gradient')(logarithm=False)
        return {
            mode: FeatureExtractor('gradient', linear if mode == 'paper' else None)
            for mode in MODES
        }
    model = folder / NETWORK
    if not model.is_file():
        raise UnavailableError(f'no file {model}')
    colors = {'channels': 'bgr', 'scale': 1.0, 'mean': (104, 117, 123), 'std': (1, 1, 1)}
    settings = settings_class('onnx')(model=str(model), layer='fire6/concat_1', **colors)
    return dict.fromkeys(MODES, FeatureExtractor('onnx', settings))


def numbers(evaluation: Evaluation, mode: str) -> dict[str, Any]:
    """Return the numbers of a row; mode paper has no default threshold."""
    values: dict[str, Any] = {
        name: {k: v for k, v in metrics.to_json().items() if isinstance(v, int | float)}
        for name, metrics in (('sequence', evaluation.sequence), ('single', evaluation.single))
    }
    if mode == 'robust':
        accepted, has_match = evaluation.results.accepted, evaluation.ground_truth.has_match
        counts = accepted_counts(accepted, evaluation.correct, has_match)
        values['at_default'] = {
            'threshold': 1 - RecognizerSettings.min_probability,
            'precision': counts.precision, 'recall': counts.recall,
        }  # fmt: skip
    return values


def evaluate_case(
    case: Case, feature: str, making: dict[str, FeatureExtractor]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield key and numbers of a case in each mode and at each speed."""
    before = None
    for mode, extractor in making.items():
        if extractor is not before:
            place_map, query = (_map(source, extractor) for source in (case.places, case.query))
            before = extractor
        truth = case.truth(len(query), len(place_map))
        settings = RecognizerSettings(mode=mode)
        for warp in ('same', *KINDS) if case.warps else ('same',):
            images = DriveChanges.from_name(warp, len(query)).images(len(query))
            evaluation = evaluate_on_map(
                place_map, query.features[images], truth.select(images), settings
            )
            yield f'{case.name}/{feature}/{mode}/{warp}', numbers(evaluation, mode)


def evaluate_hallway(
    folder: Path, feature: str, making: dict[str, FeatureExtractor]
) -> Iterator[tuple[str, Any]]:
    """Yield key and numbers of the loop closures in each mode, with late ones and without."""
    file = folder / 'rtabmap_hallway_loop/samples_GT.bmp'
    for mode, extractor in making.items():
        route = _map(open_source(folder / 'rtabmap_hallway_loop/samples'), extractor)
        truth = GroundTruth.from_file(file, len(route), len(route), 0).loop_closures(EXCLUDED - 1)
        settings = RecognizerSettings(mode=mode)
        for row, late in ('same', True), ('on time', False):
            evaluation = evaluate_loop_closures(
                route.features, truth, settings, EXCLUDED, late=late
            )
            yield f'hallway/{feature}/{mode}/{row}', numbers(evaluation, mode)


def evaluate_tower(folder: Path, feature: str, making: FeatureExtractor) -> dict[str, Any]:
    """Return the images of floors that match maps of other floors, all pairs, mode robust."""
    floors = [
        _map(open_source(p), making) for p in sorted((folder / 'tower').iterdir()) if p.is_dir()
    ]
    settings = RecognizerSettings(mode='robust')
    images = matched = 0
    for place_map in floors:
        for query in floors:
            if query is not place_map:
                recognizer = PlaceRecognizer(place_map, settings)
                results = recognize_traverse(recognizer, query.features, len(place_map), settings)
                images += len(query)
                matched += int(np.count_nonzero(results.accepted))
    return {'images': images, 'matched': matched}


def _map(source: Any, making: FeatureExtractor) -> Map:
    return build_map(source, making, thumbnails=False, progress=False)


def measure(folder: Path, quick: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield key and numbers of every row; report rows that are left out."""
    for feature in ('g',) if quick else FEATURES:
        try:
            making = extractors(feature, folder)
        except UnavailableError as error:
            print(f'left out: {FEATURES[feature]}: {error}', file=sys.stderr)
            continue
        for case in short_cases(folder):
            yield from evaluate_case(case, feature, making)
        yield from evaluate_hallway(folder, feature, making)
        if quick:
            continue
        yield f'tower/{feature}/robust', evaluate_tower(folder, feature, making['robust'])
        for case in long_cases(folder, feature):
            yield from evaluate_case(case, feature, making)


def markdown(about: dict[str, Any], results: Results) -> list[str]:
    """Return the lines of the table."""
    lines = []
    for key, values in results.items():
        name, feature, mode, *speed = key.split('/')
        row = [name, FEATURES[feature], mode, speed[0] if speed else '-']
        if 'sequence' not in values:
            share = values['matched'] / values['images']
            lines.append([*row, '-', '-', '-', '-', f'{share:.1%} of {values["images"]:,}'])
            continue
        best, default = values['sequence'], values.get('at_default')
        texts = [f'{best["f1"]:.4f}']
        texts += [f'{default[k]:.4f}' if default else '-' for k in ('precision', 'recall')]
        lines.append([*row, *texts, f'{best["recall_at_100_precision"]:.4f}', '-'])
    head = ['data set', 'features', 'mode', 'speed', 'best F1', 'P at default', 'R at default']
    head += ['R at 100 % P', 'unknown matched']
    return [*heading('Accuracy', 'make accuracy', about), *table(head, lines)]


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = options_parser(__doc__, 'gradient features, without Nordland and tower')
    options = parser.parse_args(arguments)
    about, began, results = environment(named_commit=options.commit), time.perf_counter(), {}
    for key, values in measure(data_folder(), options.quick):
        results[key] = values
        print(key, json.dumps(values.get('sequence', values).get('f1', values)), flush=True)
    name = f'accuracy-quick-{about["commit"]}' if options.quick else 'accuracy'
    path = options.output / f'{name}.json'
    write_json(path, about | {'results': results})
    write_lines(path.with_suffix('.md'), markdown(about, results))
    print(f'took {time.perf_counter() - began:.0f} s\nwrote {path} and its .md')
    return 0


if __name__ == '__main__':
    sys.exit(main())
