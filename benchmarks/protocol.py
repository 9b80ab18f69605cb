# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recall@1 and recall at 100 % precision by method, tolerance and sequence length, on the data sets.

``make protocol``, ``make protocol ARGS=--quick``. Data sets and methods: docs/evaluation.md.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
import sys
import time
from typing import Any

from accuracy import extractors, FEATURES
import cv2
from data import data_folder
import numpy as np
from results import environment, heading, options_parser, table, write_json, write_lines
from stavpr_lab.evaluation.drive import FrameSource
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.protocol import (
    Estimate,
    evaluate_protocol,
    LENGTHS,
    match_sequences,
    METHODS,
    protocol_rows,
    ProtocolRow,
    TOLERANCES,
)
from stavpr_lab.evaluation.seqslam import differences, preprocess, SeqSlamSettings
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, PlaceMap, select_places
from stavpr_ros.sources import open_source

WALK, TRAIN = 'walk_by_night', 'nordland_64x32'
CASES = {  # map and query; image i shows place i
    'gardens_point': ('gardens_point/day_left', 'gardens_point/day_right'),
    'walk_day': (f'{WALK}/left_day', f'{WALK}/right_day'),
    'walk_night': (f'{WALK}/left_day', f'{WALK}/right_night'),
    'walk_night_map': (f'{WALK}/right_night', f'{WALK}/left_day'),
    'walk_right': (f'{WALK}/right_day', f'{WALK}/right_night'),
    'nordland': (f'{TRAIN}/summer', f'{TRAIN}/winter'),
    'nordland_winter_map': (f'{TRAIN}/winter', f'{TRAIN}/summer'),
}
DARK = 8.0  # standard deviation of the gray levels, below which an image shows nothing
STILL = 2.0  # mean change of the gray levels since the image before, below which a camera rests
FEW = (5, 20)  # images of sequences of SqueezeNet on Nordland, 0.1 s an image and length
PATCHES = 'p'
LABELS = FEATURES | {PATCHES: 'patches of SeqSLAM'}
# of docs/evaluation.md: data set, tolerance, images
EXCERPT = (
    ('nordland_clean', 1, 5),
    ('nordland', 1, 5),
    ('gardens_point', 2, 20),
    ('walk_night', 2, 20),
)
Results = dict[str, list[dict[str, Any]]]


def clean(*traverses: FrameSource) -> np.ndarray:
    """
    Return the images that are neither dark nor of a camera at rest in any traverse.

    :param traverses: N images each.
    :returns: shape (K,), int64, ascending.
    """
    kept = np.ones(len(traverses[0]), bool)
    for source in traverses:
        gray = np.stack([cv2.cvtColor(each.image, cv2.COLOR_RGB2GRAY) for each in source]) * 1.0
        kept &= gray.std(axis=(1, 2)) >= DARK
        kept[1:] &= np.abs(np.diff(gray, axis=0)).mean(axis=(1, 2)) >= STILL
    return np.flatnonzero(kept)


@cache
def features(path: Path, making: FeatureExtractor) -> PlaceMap:
    """Return a map of a folder of images."""
    return build_map(open_source(path), making, thumbnails=False, progress=False)


@cache
def patches(path: Path) -> np.ndarray:
    """Return the images of a folder as SeqSLAM compares them, shape (N, pixels), float32."""
    return preprocess((frame.image for frame in open_source(path)), SeqSlamSettings())


def rows(
    paths: Sequence[Path],
    kept: np.ndarray,
    making: dict[str, FeatureExtractor],
    lengths: Sequence[int],
) -> Iterator[ProtocolRow]:
    """
    Yield the rows of all methods on a map and a query, in which image i shows place i.

    :param paths: of the map and of the query.
    :param kept: the images of both that are used, shape (K,), int64.
    :param making: the extractor of each mode; empty for SeqSLAM on its own patches.
    """
    truths = {t: GroundTruth.identity(len(kept), len(kept), t) for t in TOLERANCES}
    if not making:
        D = differences(*(patches(path)[kept] for path in reversed(paths)))
        yield from protocol_rows('seqslam', match_sequences(D, 'seqslam', lengths), truths)
    for method in METHODS if making else ():
        extractor = making['paper' if method == 'paper' else 'robust']
        places, query = (select_places(features(path, extractor), kept) for path in paths)
        yield from evaluate_protocol(places, query.features, truths, None, (method,), lengths)


def measure(
    folder: Path, chosen: Sequence[str], quick: bool
) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield key and rows of each data set with each kind of features; report those left out."""
    cases = [
        (name, [folder / path for path in paths])
        for name, paths in CASES.items()
        if not (quick and TRAIN in paths[0])
    ]
    for feature in chosen:
        try:
            making = extractors(feature, folder) if feature in FEATURES else {}
        except UnavailableError as error:
            print(f'left out: {LABELS[feature]}: {error}', file=sys.stderr)
            continue
        for name, paths in cases:
            costly = feature == 'o' and name.startswith('nordland')
            if costly and name != 'nordland':
                continue
            sources = [open_source(path) for path in paths]
            variants = {name: np.arange(len(sources[0]))}
            if TRAIN in str(paths[0]):
                variants[f'{name}_clean'] = clean(*sources)
            for variant, kept in variants.items():
                found = [
                    row.to_json() for row in rows(paths, kept, making, FEW if costly else LENGTHS)
                ]
                yield f'{variant}/{feature}', [row | {'queries': len(kept)} for row in found]


def text(estimate: dict[str, float]) -> str:
    """Return an estimate with its interval."""
    return str(Estimate(**estimate))


def excerpt(results: Results) -> list[str]:
    """Return the table of docs/evaluation.md: recall@1, recall at 100 % precision."""
    cells: dict[tuple[str, str], list[str]] = {}
    for column, (name, tolerance, length) in enumerate(EXCERPT):
        for feature in LABELS:
            for row in results.get(f'{name}/{feature}', ()):
                if row['length'] == length:
                    found = row['recalls'][str(tolerance)]
                    full = found['recall_at_100_precision']['value']
                    line = cells.setdefault((LABELS[feature], row['method']), ['-'] * len(EXCERPT))
                    line[column] = f'{text(found["recall_at_1"])}, {full:.3f}'
    head = [f'`{name}` +-{t}, {length} images' for name, t, length in EXCERPT]
    return table(['features', 'method', *head], [[*key, *row] for key, row in cells.items()])


def markdown(about: dict[str, Any], results: Results) -> list[str]:
    """Return the lines of the page: a table a data set."""
    lines = heading('Recalls by tolerance and sequence length', about)
    lines += ['Cells: best F1 / recall@1 / recall at 100 % precision, with 95 % intervals.', '']
    for name in dict.fromkeys(key.split('/')[0] for key in results):
        found = []
        for feature in LABELS:
            for row in results.get(f'{name}/{feature}', ()):
                cells = [
                    ' / '.join(
                        [
                            f'{each["f1"]:.3f}',
                            text(each['recall_at_1']),
                            text(each['recall_at_100_precision']),
                        ]
                    )
                    for each in row['recalls'].values()
                ]
                found.append([LABELS[feature], row['method'], str(row['length']), *cells])
        tolerances = [f'+-{t}' for t in TOLERANCES]
        lines += [f'## {name}', '', *table(['features', 'method', 'images', *tolerances], found)]
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = options_parser(__doc__, 'gradient features, without Nordland')
    kinds = tuple(LABELS)
    parser.add_argument('--features', nargs='+', choices=kinds, default=kinds)
    options = parser.parse_args(arguments)
    chosen = ('g',) if options.quick else options.features
    about, began, results = environment(named_commit=options.commit), time.perf_counter(), {}
    for key, found in measure(data_folder(), chosen, options.quick):
        results[key] = found
        print(f'{key}: {time.perf_counter() - began:.0f} s', file=sys.stderr)
    path = options.output / f'protocol{"-quick" if options.quick else ""}.json'
    write_json(path, about | {'results': results})
    write_lines(path.with_suffix('.md'), markdown(about, results))
    print(*excerpt(results), sep='\n')
    print(f'took {time.perf_counter() - began:.0f} s\nwrote {path} and its .md')
    return 0


if __name__ == '__main__':
    sys.exit(main())
