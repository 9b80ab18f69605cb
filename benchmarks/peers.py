# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Matching by programs of other groups beside ours: the same features, ground truth and metrics.

``python benchmarks/peers.py --vpr-tutorial FOLDER --pyseqslam FOLDER --seqnet FOLDER``: checkouts
of stschubert/VPR_Tutorial, tmadl/pySeqSLAM and oravus/seqNet, whose own functions run.
"""

from collections.abc import Iterator
from importlib.machinery import SourceFileLoader
import json
from pathlib import Path
import sys
from types import ModuleType
from typing import Any

from accuracy import Case, extractors, identity, short_cases
from data import data_folder
import numpy as np
from results import environment, options_parser, write_json
from stavpr_lab.commands.evaluate_export import image_vectors
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_lab.evaluation.evaluate import evaluate_on_map
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_lab.evaluation.metrics import evaluate_ranking, Ranking
from stavpr_lab.evaluation.seqslam import match_differences, SeqSlamSettings
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import build_map, Map, select_places
from stavpr_ros.method import RecognizerSettings
from stavpr_ros.sources.folder import FolderSource
import torch

LENGTH = 20  # images in a window, our default; seqNet has 5, pySeqSLAM 10
MARGIN = LENGTH // 2  # first and last images, in the middle of no window: not counted
PLACES = 300  # of Nordland: seqNet takes a millisecond for each pair of windows of 20 images
PROJECTION = 64  # dimensions of a strip of the network, for the same reason
Matches = tuple[np.ndarray, np.ndarray]  # place of each image, and its distance


def load(file: Path) -> Any:
    """Import a file of a checkout by its path."""
    module = ModuleType(f'peer_{file.stem}')
    SourceFileLoader(module.__name__, str(file)).exec_module(module)
    return module


class Whole(int):
    """A number that ``/`` divides as in Python 2, for which pySeqSLAM is written."""

    __truediv__ = int.__floordiv__


class Matrix(np.ndarray):
    """An array whose ``flatten(1)`` is in the order of columns, as in NumPy before 1.10."""

    __array_priority__ = 1.0  # of the results of vstack

    def flatten(self, order: Any = 'C') -> np.ndarray:
        """Return a flat copy."""
        return np.asarray(self).flatten('F' if order == 1 else order)


def pyseqslam(folder: Path, D: np.ndarray, length: int) -> Matches:
    """
    Match by ``enhanceContrast`` and ``getMatches`` of pySeqSLAM.

    :param D: distances of places and images, shape (n, N).
    """
    sys.path.insert(0, str(folder / 'pyseqslam'))
    vars(np)['infty'] = np.inf
    parameters = load(folder / 'pyseqslam/parameters.py').defaultParameters()
    matching, contrast = parameters.matching, parameters.contrastEnhancement
    matching.ds, matching.Rwindow = Whole(length), Whole(matching.Rwindow)
    contrast.R = Whole(contrast.R)
    peer = load(folder / 'pyseqslam/seqslam.py').SeqSLAM(parameters)
    matches = peer.getMatches(peer.enhanceContrast(D).view(Matrix))
    missing = np.isnan(matches).any(axis=1)
    places = np.where(missing, -1, np.nan_to_num(matches[:, 0])).astype(np.int64)
    return np.minimum(places, len(D) - 1), np.where(missing, np.inf, matches[:, 1])


def seqmatch(folder: Path, places: np.ndarray, queries: np.ndarray, length: int) -> Matches:
    """Match descriptors (n, D) and (N, D) by ``aggregateMatchScores`` of seqNet."""
    windows_of, peer = load(folder / 'datasets.py').getSeqInds, load(folder / 'test.py')
    tensors = [
        torch.from_numpy(rows[[windows_of(i, length, len(rows)) for i in range(len(rows))]])
        for rows in (places, queries)
    ]
    scores = peer.aggregateMatchScores(*tensors, 'cpu')
    return scores.argmin(axis=0), scores.min(axis=0)


def center_vectors(rows: np.ndarray) -> np.ndarray:
    """Return vectors (n, D) less their mean, of unit norm, a common preparation of descriptors."""
    rows = rows - rows.mean(axis=0)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def differences(places: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """Return cosine distances of vectors, shape (n, N)."""
    # black images have no contrast, and a division by zero makes all of pySeqSLAM's values NaN
    noise = np.random.default_rng(0).uniform(0, 1e-6, (len(places), len(queries)))
    return 1 - places @ queries.T + noise


def peer_methods(
    options: Any, places: np.ndarray, queries: np.ndarray
) -> Iterator[tuple[str, Matches]]:
    """Yield name and matches of each method of another group for vectors (n, D) and (N, D)."""
    S = places @ queries.T
    best = load(options.vpr_tutorial / 'matching/matching.py').best_match_per_query(S)
    yield 'VPR_Tutorial, single images', (best.argmax(axis=0), -S.max(axis=0))
    for length in (5, LENGTH):
        yield f'seqNet seqMatch, l = {length}', seqmatch(options.seqnet, places, queries, length)
    D = differences(places, queries)
    for length in (10, LENGTH):
        yield f'pySeqSLAM, l = {length}', pyseqslam(options.pyseqslam, D, length)


def methods(
    options: Any, place_map: Map, query: Map, truth: GroundTruth
) -> Iterator[tuple[str, Matches]]:
    """Yield name and matches of each method."""
    places, queries = (image_vectors(traverse.features) for traverse in (place_map, query))
    yield from peer_methods(options, places, queries)
    for name, matches in peer_methods(options, center_vectors(places), center_vectors(queries)):
        yield f'{name}, centered', matches
    for length in (10, LENGTH):
        settings = SeqSlamSettings(length=length)
        yield (
            f'ours, SeqSLAM, l = {length}',
            match_differences(differences(places, queries).T, settings),
        )
    for mode in ('paper', 'robust'):
        ours = evaluate_on_map(place_map, query.features, truth, RecognizerSettings(mode=mode))
        results = ours.results
        if mode == 'paper':
            yield 'ours, aligned single images', (results.single.best, results.single.scores)
        yield f'ours, mode {mode}, l = 20', (results.sequence.best, results.sequence.scores)


def numbers(metrics: Any, matches: Matches, truth: GroundTruth) -> dict[str, float]:
    """Return the metrics of matches by our functions and by VPR_Tutorial's."""
    counted, (places, scores) = slice(MARGIN, truth.N - MARGIN), matches
    ours = evaluate_ranking(
        Ranking(places[:, None].astype(np.int64), scores.astype(np.float64)), truth, counted
    )
    correct = np.zeros((truth.n, truth.N), bool)
    correct[truth.pairs[:, 1], truth.pairs[:, 0]] = True
    worst = scores[np.isfinite(scores)].max()
    S = np.full(correct.shape, -worst - 2)
    wrong = correct.argmin(axis=0)  # the place of images without a match
    S[np.where(places < 0, wrong, places), np.arange(truth.N)] = -np.minimum(scores, worst + 1)
    theirs = S[:, counted], correct[:, counted]
    return {
        'recall_at_1': ours.recall_at[1],
        'recall_at_100_precision': ours.recall_at_full_precision,
        'recall_at_1_vpr_tutorial': float(metrics.recallAtK(*theirs)),
        'recall_at_100_precision_vpr_tutorial': float(
            metrics.recallAt100precision(*theirs, matching='single')
        ),
    }


def measure(options: Any) -> Iterator[tuple[str, str, str, dict[str, float]]]:
    """Yield features, case, method and numbers."""
    folder = data_folder()
    metrics = load(options.vpr_tutorial / 'evaluation/metrics.py')
    summer, winter = (FolderSource(folder / 'nordland_64x32' / n) for n in ('summer', 'winter'))
    summer.files, winter.files = summer.files[:PLACES], winter.files[:PLACES]
    cases = [*short_cases(folder), Case('nordland', summer, winter, identity(3))]
    for feature in ('g',) if options.quick else ('g', 'o'):
        extractor = extractors(feature, folder)['robust']
        if feature == 'o':
            settings = extractor.settings
            extractor = FeatureExtractor(settings.kind, settings.backbone, projection=PROJECTION)
        for case in cases[:1] if options.quick else cases:
            place_map, query = (
                build_map(source, extractor, thumbnails=False, progress=False)
                for source in (case.places, case.query)
            )
            recorded = case.truth(len(query), len(place_map))
            for drive in ('same', '2x', 'vary') if case.warps else ('same',):
                images = DriveChanges.from_name(drive, len(query)).images(len(query))
                part, truth = select_places(query, images), recorded.select(images)
                name = case.name if drive == 'same' else f'{case.name} {drive}'
                for method, matches in methods(options, place_map, part, truth):
                    yield feature, name, method, numbers(metrics, matches, truth)


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = options_parser(__doc__, 'gradient features on Gardens Point')
    for name in ('vpr-tutorial', 'pyseqslam', 'seqnet'):
        parser.add_argument(f'--{name}', type=Path, required=True, metavar='CHECKOUT')
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)  # seqNet's products are too small for more
    about, rows = environment(named_commit=options.commit), []
    for feature, case, method, values in measure(options):
        rows.append({'features': feature, 'case': case, 'method': method} | values)
        print(json.dumps(rows[-1]), flush=True)
    write_json(options.output / 'peers.json', about | {'rows': rows})
    return 0


if __name__ == '__main__':
    sys.exit(main())
