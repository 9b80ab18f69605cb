# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Mode robust with fewer dimensions: no projection, principal components, random ones, int8.

``PYTHONPATH=. python benchmarks/projection.py`` writes ``benchmarks/results/projection.json`` and
the table of performance.md beside it: the lowest of best F1, precision and recall over the data
sets.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from accuracy import Case, extractors, long_cases, numbers, short_cases
from city import written_between
from data import data_folder
import numpy as np
from results import RESULTS, table, write_json
from stavpr_lab.evaluation.evaluate import evaluate_on_map
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import descriptor_map, PlaceMap
from stavpr_ros.mapping.builder import extract_features
from stavpr_ros.mapping.reduction import STRIPS_A_DIRECTION, with_principal_components
from stavpr_ros.prepare.centering import normalize
from stavpr_ros.recognition import RecognizerSettings

PAGE = RESULTS / 'performance.md'
BEGIN, END = '<!-- written by benchmarks/projection.py -->', '<!-- end of projection -->'
NUMBERS = ('f1', 'precision', 'recall')
COLUMNS = {  # name: projection, dimension, precision
    'all': ('', 0, 'float32'),
    'all, int8': ('', 0, 'int8'),
    'PCA 128': ('pca', 128, 'float32'),
    'PCA 64': ('pca', 64, 'float32'),
    'PCA 64, int8': ('pca', 64, 'int8'),
    'PCA 32': ('pca', 32, 'float32'),
    'random 64': ('random', 64, 'float32'),
}


def kinds(folder: Path) -> dict[str, FeatureExtractor]:
    """Return the extractors: strips of gradients, and strips and one vector of a network."""
    network = extractors('o', folder)['robust']
    return {
        'gradient': extractors('g', folder)['robust'],
        'SqueezeNet': network,
        'SqueezeNet, one vector': FeatureExtractor('onnx', network.settings.backbone, 1),
    }


def projected(
    place_map: PlaceMap, query: Any, projection: str, dimension: int
) -> tuple[PlaceMap, Any]:
    """Return the map and the query with fewer dimensions."""
    if not projection:
        return place_map, query
    if projection == 'pca':
        place_map = with_principal_components(place_map, dimension)
        assert place_map.projection is not None
        matrix = place_map.projection.matrix
    else:
        rng = np.random.default_rng(0)
        shape = place_map.features.dimension, dimension
        matrix = rng.standard_normal(shape).astype(np.float32)
        place_map = replace(place_map, features=_times(place_map.features, matrix))
    query = _times(query, matrix)
    return place_map, replace(query, settings=place_map.features.settings)


def _times(features: Any, matrix: np.ndarray) -> Any:
    strips = features.strips @ matrix
    normalize(strips)
    return replace(features, strips=strips, cells=None)


def rows(case: Case, kind: str, extractor: FeatureExtractor) -> Iterator[dict[str, Any]]:
    """Yield the numbers of a case in each column."""
    places, query = (
        extract_features(source, extractor, progress=False) for source in (case.places, case.query)
    )
    n = len(places)
    whole = descriptor_map(places)
    settings = RecognizerSettings(mode='robust')
    for name, (projection, dimension, precision) in COLUMNS.items():
        limit = len(places.weights) * n // STRIPS_A_DIRECTION
        if dimension >= places.dimension or (projection == 'pca' and dimension > limit):
            continue
        place_map, images = projected(whole, query, projection, dimension)
        evaluation = evaluate_on_map(
            place_map, images, case.truth(len(query), n), settings, precision=precision
        )
        values = numbers(evaluation, 'robust')
        yield {
            'kind': kind,
            'dimension': places.dimension,
            'case': case.name,
            'column': name,
            'f1': values['sequence']['f1'],
            'precision': values['at_default']['precision'],
            'recall': values['at_default']['recall'],
        }


def lines(results: list[dict[str, Any]]) -> list[str]:
    """Return a table of the lowest F1, precision and recall over the data sets."""
    of_cells: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for one in results:
        features = f'{one["kind"]}, {one["dimension"]}'
        of_cells.setdefault((features, one['column']), []).append(one)

    def cell(features: str, column: str) -> str:
        cases = of_cells.get((features, column), [])
        if not cases:
            return '-'
        numbers = [f'{min(one[key] for one in cases):.3f}' for key in NUMBERS]
        total = len(of_cells[features, 'all'])
        return ' '.join(numbers) + (f' ({len(cases)} of {total})' if len(cases) < total else '')

    rows = dict.fromkeys(features for features, _ in of_cells)
    body = [[features, *(cell(features, column) for column in COLUMNS)] for features in rows]
    return table(('features', *COLUMNS), body)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--kinds', nargs='+', metavar='KIND', help='of features (all)')
    parser.add_argument('--quick', action='store_true', help='without Nordland')
    parser.add_argument('--output', type=Path, default=RESULTS / 'projection.json')
    arguments = parser.parse_args()
    folder, results = data_folder(), []
    for kind, extractor in kinds(folder).items():
        if arguments.kinds and kind not in arguments.kinds:
            continue
        cases = [*short_cases(folder)]
        if not arguments.quick:
            cases += [case for case in long_cases(folder, 'o') if case.name == 'nordland']
        for case in cases:
            new = [*rows(case, kind, extractor)]
            print(case.name, lines(new)[2], flush=True)
            results += new
    write_json(arguments.output, results)
    if arguments.output == RESULTS / 'projection.json':
        written_between(PAGE, BEGIN, END, lines(results))


if __name__ == '__main__':
    main()
