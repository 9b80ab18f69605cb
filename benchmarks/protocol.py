# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Recall@1 and recall at 100 % precision by method, tolerance and sequence length, on the data sets.

``make protocol``, ``make protocol ARGS=--quick``. Data sets and methods: results/evaluation.md.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
import sys
from typing import Any

from accuracy import extractors, FEATURES
import cv2
from data import data_folder
import numpy as np
from results import environment, heading, options_parser, table, write_lines
from stavpr_lab.evaluation.drive import FrameSource
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.protocol import (
    evaluate_matches,
    evaluate_protocol,
    LENGTHS,
    match_sequences,
    METHODS,
    Recalls,
    text,
    TOLERANCES,
)
from stavpr_lab.evaluation.seqslam import differences, preprocess, SeqSlamSettings
from stavpr_ros.errors import UnavailableError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, Map, select_places
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
SHORT_LENGTHS = (5, 20)  # images of sequences of SqueezeNet on Nordland, 0.1 s an image and length
PATCHES = 'p'
LABELS = FEATURES | {PATCHES: 'patches of SeqSLAM'}
# first table: data set, tolerance, images
EXCERPT = (
    ('nordland_clean', 1, 5),
    ('nordland', 1, 5),
    ('gardens_point', 2, 20),
    ('walk_night', 2, 20),
)
Row = dict[str, Any]
Results = dict[str, list[Row]]


def clean(*traverses: FrameSource) -> np.ndarray:
    """
    Return the images that are neither dark nor of a camera at rest in any traverse.

    :param traverses: N images each.
    :returns: shape (K,), int64, ascending.
    """
    is_usable = np.ones(len(traverses[0]), bool)
    for source in traverses:
        gray = np.stack([cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY) for frame in source]) * 1.0
        is_usable &= gray.std(axis=(1, 2)) >= DARK
        is_usable[1:] &= np.abs(np.diff(gray, axis=0)).mean(axis=(1, 2)) >= STILL
    return np.flatnonzero(is_usable)


@cache
def features(path: Path, making: FeatureExtractor) -> Map:
    """Return a map of a folder of images."""
    return build_map(open_source(path), making, thumbnails=False, progress=False)


def rows(
    paths: Sequence[Path], indices: np.ndarray, making: dict[str, Any], lengths: Sequence[int]
) -> Iterator[Recalls]:
    """
    Yield the numbers of all methods on a map and a query, in which image i shows place i.

    :param paths: folders of the map and of the query.
    :param indices: the images of both that are used, shape (K,), int64.
    :param making: the extractor of each mode; empty for SeqSLAM on its own patches.
    """
    truths = {t: GroundTruth.identity(len(indices), len(indices), t) for t in TOLERANCES}
    if not making:
        frames = ((frame.image for frame in open_source(path)) for path in reversed(paths))
        D = differences(*(preprocess(images, SeqSlamSettings())[indices] for images in frames))
        yield from evaluate_matches('seqslam', match_sequences(D, 'seqslam', lengths), truths)
    for method in METHODS if making else ():
        extractor = making['paper' if method == 'paper' else 'robust']
        places, query = (select_places(features(path, extractor), indices) for path in paths)
        yield from evaluate_protocol(places, query.features, truths, None, (method,), lengths)


def measure(folder: Path, quick: bool) -> Iterator[tuple[str, list[Row]]]:
    """Yield key and rows of each data set and kind of features; report kinds that are left out."""
    for feature in ('g',) if quick else LABELS:
        try:
            making = extractors(feature, folder) if feature in FEATURES else {}
        except UnavailableError as error:
            print(f'left out: {LABELS[feature]}: {error}', file=sys.stderr)
            continue
        for name, traverses in CASES.items():
            long, costly = TRAIN in traverses[0], TRAIN in traverses[0] and feature == 'o'
            if (long and quick) or (costly and name != 'nordland'):
                continue
            paths = [folder / path for path in traverses]
            sources = [open_source(path) for path in paths]
            variants = {name: np.arange(len(sources[0]))}
            if long:
                variants[f'{name}_clean'] = clean(*sources)
            for variant, indices in variants.items():
                recalls = rows(paths, indices, making, SHORT_LENGTHS if costly else LENGTHS)
                yield f'{variant}/{feature}', [asdict(row) for row in recalls]


def excerpt(results: Results) -> list[str]:
    """Return the first table: recall@1, recall at 100 % precision."""
    lines: dict[tuple[str, str], list[str]] = {}
    for column, (name, *case) in enumerate(EXCERPT):
        for feature, label in LABELS.items():
            for row in results.get(f'{name}/{feature}', ()):
                if [row['tolerance'], row['length']] == case:
                    line = lines.setdefault((label, row['method']), ['-'] * len(EXCERPT))
                    full = row['recall_at_100_precision'][0]
                    line[column] = f'{text(row["recall_at_1"])}, {full:.3f}'
    head = [f'`{name}` +-{t}, {length} images' for name, t, length in EXCERPT]
    return table(['features', 'method', *head], [[*key, *line] for key, line in lines.items()])


def markdown(about: dict[str, Any], results: Results) -> list[str]:
    """Return the lines of the page: a table of each data set with each kind of features."""
    lines = heading('Recalls by tolerance and sequence length', 'make protocol', about)
    lines += ['Recall@1 and recall at 100 % precision:', '']
    lines += excerpt(results)
    lines += ['Cells: best F1 / recall@1 / recall at 100 % precision, with 95 % intervals.', '']
    head = ['method', 'images', *(f'+-{t}' for t in TOLERANCES)]
    for key, entries in results.items():
        name, feature = key.split('/')
        cells: dict[tuple[str, str], list[str]] = {}
        for row in entries:
            estimates = text(row['recall_at_1']), text(row['recall_at_100_precision'])
            cell = ' / '.join([f'{row["f1"]:.3f}', *estimates])
            cells.setdefault((row['method'], str(row['length'])), []).append(cell)
        body = [[*start, *line] for start, line in cells.items()]
        lines += [f'## {name}, {LABELS[feature]}', '', *table(head, body)]
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = options_parser(__doc__, 'gradient features, without Nordland').parse_args(arguments)
    about = environment(named_commit=options.commit)
    results = dict(measure(data_folder(), options.quick))
    path = options.output / f'protocol{"-quick" if options.quick else ""}.md'
    write_lines(path, markdown(about, results))
    print(*excerpt(results), f'wrote {path}', sep='\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
