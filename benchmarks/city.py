# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Mode robust in a city: a real map among simulated places.

The simulated places are a route of images whose features have the mean, the covariance (of all
strips together, its ``RANK`` largest directions) and the correlation from image to image of the
real map: a first-order autoregressive Gaussian, each strip made unit norm. The real places lie
together within it. ``PYTHONPATH=. python benchmarks/city.py --places 1000000`` adds to
``benchmarks/results/city.json``, and writes results/city.md from it.
"""

from collections.abc import Iterator
import json
import os
from pathlib import Path
import time
from typing import Any

from data import data_folder
import numpy as np
from results import commit, cpu_model, parser_of, RESULTS, table, write_json, write_lines
from scipy.signal import lfilter
from stavpr_lab.evaluation.drive import DriveChanges
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import descriptor_map, Map, save_map
from stavpr_ros.mapping.builder import extract_features
from stavpr_ros.mapping.reduction import with_principal_components
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.prepare.centering import unit_norm
from stavpr_ros.sources import open_source
from stavpr_ros.threads import thread_count

RANK, PIECE = 256, 4096
AT = 0.37  # where in the city the real places begin
CASES = {  # map, query, tolerance, speed of the query
    'gardens_point': ('gardens_point/day_left', 'gardens_point/day_right', 2, '1x'),
    'walk_night': ('walk_by_night/left_day', 'walk_by_night/right_night', 2, '1x'),
    'corridor': ('corridor/ref', 'corridor/query', 3, '1x'),
    'nordland': ('nordland_64x32/summer', 'nordland_64x32/winter', 3, '1x'),
    # on these, matching makes errors
    'night_map': ('walk_by_night/right_night', 'walk_by_night/left_day', 2, 'vary'),
    'night_map_half': ('walk_by_night/right_night', 'walk_by_night/right_day', 2, '0.5x'),
    'nordland_vary': ('nordland_64x32/winter', 'nordland_64x32/summer', 3, 'vary'),
}
IMAGES = 200  # of a query
FILE = RESULTS / 'city.json'
TEXT = """\
# A city

Written by `python benchmarks/city.py`. Precision and recall at the default threshold; processor
and elapsed time of an image without extraction (int8, median), beside other programs (load).
64 dimensions: `map compact --pca 64`. Processors and commits: [city.json](city.json).
"""


class HalfFeatures(LocalFeatures):
    """Features in float16, read as float32: a city's fit into memory."""

    def __post_init__(self) -> None:
        """Accept float16, which features of a map are not."""

    def require_fit(self, *_: Any) -> None:
        """Accept it for a recognizer as well."""

    def __getitem__(self, images: slice | np.ndarray) -> LocalFeatures:
        strips, weights = self.strips[:, images].astype(np.float32), self.weights[:, images]
        return LocalFeatures(strips, weights, self.settings, self.cells)


def simulate_places(real: LocalFeatures, n: int) -> Iterator[np.ndarray]:
    """Yield the strips (W, m, d) of n simulated places, block by block."""
    rng = np.random.default_rng(0)
    W, m, d = real.strips.shape
    images = real.strips.transpose(1, 0, 2).reshape(m, W * d).astype(np.float64)
    mean = images.mean(axis=0)
    images = images - mean
    keep = float((images[1:] * images[:-1]).sum() / (images**2).sum())
    _, scales, directions = np.linalg.svd(images, full_matrices=False)
    rank = min(RANK, m - 1)
    basis = (scales[:rank, None] * directions[:rank] / np.sqrt(m - 1)).astype(np.float32)
    state = rng.standard_normal((1, rank)).astype(np.float32)
    for low in range(0, n, PIECE):
        shape = min(PIECE, n - low), rank
        new = rng.standard_normal(shape, np.float32) * np.float32(np.sqrt(1 - keep**2))
        route = lfilter([1.0], [1.0, -keep], new, axis=0, zi=keep * state)[0].astype(np.float32)
        state = route[-1:]
        strips = (route @ basis + mean.astype(np.float32)).reshape(-1, W, d).transpose(1, 0, 2)
        yield unit_norm(strips)


def city(real: LocalFeatures, n: int) -> tuple[HalfFeatures, int]:
    """Return a city of n places, and the first of the real ones."""
    W, m, d = real.strips.shape
    half, low = np.empty((W, n, d), dtype=np.float16), 0
    for strips in simulate_places(real, n):
        half[:, low : low + strips.shape[1]] = strips
        low += strips.shape[1]
    first = int(AT * (n - m))
    half[:, first : first + m] = real.strips
    weights = np.full((W, n), W**-0.5, np.float32)
    return HalfFeatures(half, weights, real.settings, real.cells), first


def reduce_dimensions(
    features: LocalFeatures, query: LocalFeatures, dimension: int
) -> tuple[Map, LocalFeatures]:
    """Return a city and a query, projected as ``map compact --pca`` does."""
    place_map = with_principal_components(descriptor_map(features), dimension)
    projection = place_map.projection
    assert projection is not None
    strips = unit_norm(projection.apply(query.strips))
    return place_map, LocalFeatures(strips, query.weights, place_map.settings)


def drive(
    place_map: Map, query: LocalFeatures, true: np.ndarray, tolerance: int
) -> dict[str, float]:
    """
    Return precision, recall and times of a query.

    :param true: place of each image.
    """
    settings = RecognizerSettings(mode='robust')
    began = time.perf_counter()
    recognizer = PlaceRecognizer(place_map, settings, 'cpu', 'int8')
    start, matches, wall, used = time.perf_counter() - began, [], [], []
    for i in range(len(query)):
        before, cpu = time.perf_counter(), time.process_time()
        matches.append(recognizer.update(query[i : i + 1]))
        wall.append(time.perf_counter() - before)
        used.append(time.process_time() - cpu)
    length = settings.sequence.length
    middles = [match.path.place for match in matches[length - 1 :] if match.path.place >= 0]
    accepted = np.array([match.accepted for match in matches[length - 1 :]])
    true = true[(length - 1) // 2 :][: len(middles)]
    right = np.abs(np.array(middles) - true) <= tolerance
    return {
        'precision': float(right[accepted].mean()) if accepted.any() else 1.0,
        'recall': float((right & accepted).mean()),
        'wall_ms_p50': 1e3 * float(np.median(wall[length:])),
        'wall_ms_p99': 1e3 * float(np.percentile(wall[length:], 99)),
        'processor_ms': 1e3 * float(np.median(used[length:])),
        'least_processor_ms': 1e3 * min(used[length:]),
        'start_s': start,
    }


def measure(name: str, n: int, pca: int, save: Path | None) -> dict[str, Any]:
    """Return the numbers of one case."""
    folder, (reference, query_folder, tolerance, speed) = data_folder(), CASES[name]
    extractor = FeatureExtractor('gradient')
    real = extract_features(open_source(folder / reference), extractor, progress=False)
    query = extract_features(open_source(folder / query_folder), extractor, progress=False)
    indices = DriveChanges.from_name(speed, len(query)).images(len(query))
    indices = indices[:IMAGES]
    query = query[indices]
    features, first = city(real, n)
    place_map = descriptor_map(features)
    if pca:
        place_map, query = reduce_dimensions(features, query, pca)
    if save is not None:
        save_map(place_map, save, force=True)
    return {
        'case': name,
        'places': n,
        'dimension': place_map.dimension,
        'images': len(query),
        'cpu': cpu_model(),
        'threads': thread_count(),
        'commit': commit(),
        'load': os.getloadavg()[0],
        'exact': drive(place_map, query, first + indices, tolerance),
    }


def lines(results: list[dict[str, Any]]) -> list[str]:
    """Return the table of the results."""
    rows = []
    for one in results:
        exact = one['exact']
        rows.append([
            *(one['case'], f'{one["places"]:,}', f'{one["dimension"]}'),
            f'{exact["precision"]:.3f} / {exact["recall"]:.3f}',
            *(f'{exact["processor_ms"]:.0f}', f'{exact["wall_ms_p50"]:.0f}'),
            *(f'{one["threads"]}', f'{one["load"]:.1f}'),
        ])  # fmt: skip
    head = 'case', 'places', 'dimensions', 'precision / recall', 'processor ms', 'elapsed ms'
    return table([*head, 'threads', 'load'], rows)


def add_result(new: dict[str, Any]) -> list[dict[str, Any]]:
    """Add a result to the file, each case and size once, the newest last; return all."""
    before = json.loads(FILE.read_text(encoding='utf-8')) if FILE.exists() else []
    results = {(one['case'], one['places'], one['dimension']): one for one in (*before, new)}
    write_json(FILE, [*results.values()])
    return list(results.values())


def write_page(results: list[dict[str, Any]]) -> None:
    """Write the page."""
    cases = list(CASES)
    results = sorted(
        results, key=lambda one: (one['places'], cases.index(one['case']), one['dimension'])
    )
    write_lines(FILE.with_suffix('.md'), [TEXT, *lines(results)])


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    parser.add_argument('--places', type=int, nargs='+', default=[100_000], metavar='N')
    parser.add_argument('--cases', nargs='+', choices=CASES, default=list(CASES))
    parser.add_argument('--pca', type=int, default=0, metavar='D', help='as map compact --pca')
    parser.add_argument('--save-map', type=Path, help='of the last case, for soak.py --map')
    arguments = parser.parse_args()
    for n in arguments.places:
        for case in arguments.cases:
            one = measure(case, n, arguments.pca, arguments.save_map)
            rows = add_result(one)
            print('\n'.join(lines([one])[2:3]), flush=True)
    print('\n'.join(lines(rows)))
    write_page(rows)


if __name__ == '__main__':
    main()
