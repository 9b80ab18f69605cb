# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The stages of matching, measured on windows of distances and on maps of features."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
import gc
from itertools import count, cycle
from typing import Any

from data import along, free_bytes, make_features, make_window
import lower_bounds as bounds
from lower_bounds import ITEM_BYTES, Sizes
import numba as nb
import numpy as np
from peaks import reader
from results import READING
from run import Peer, Run
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.alignment.lm_dtw import (
    best_match,
    match_padded,
    padded_width,
    SequenceDistances,
    trace_sequence,
)
from stavpr_ros.alignment.settings import SequenceSettings, SpatialSettings
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.features.registry import evidence_of
from stavpr_ros.mapping import descriptor_map, Map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.method.cells import CellAgreement
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.filter import PlaceFilter
from stavpr_ros.method.lm_dtw_window import LmDtwWindow
from stavpr_ros.method.model import APART, MODEL, STRAIGHT
from stavpr_ros.pipeline import LoadedMap, Pipeline, PipelineSettings
from stavpr_ros.prepare.blocks import Int8Features
from stavpr_ros.prepare.centering import MeanCentering, normalize, z_normalized
from stavpr_ros.prepare.matcher import make_matcher, PRECISIONS
from stavpr_ros.sources.frame import ImageRecord
from timing import best_seconds, timed_job
import torch

MODES = ('robust', 'paper')  # the default first
SEQUENCE, SPATIAL = SequenceSettings(), SpatialSettings()
NMS_RADIUS = RecognizerSettings.nms_radius
STRIPS = 7
FRAMES = 20  # images of the distance matrix
MATRIX_PLACES = 20_000  # most places of the distance matrix
MAX_MEMORY = 12e9  # bytes that a map and its peers may take
LIBROSA_STARTS, ENDS_CHECKED = 500, 3
PROJECTED, DRIVE_IMAGES = 64, 1000  # dimensions of `process`, images of the drives
SEARCHES = {'faiss': 'faiss', 'usearch': 'bench'}  # package: its requirements
Call = Callable[[], Any]


def memory_problem(n: int, d: int) -> str:
    """Return why a map does not fit into memory; empty if it fits."""
    # features, the recognizer's copy, a peer's copy, blocks of strip distances
    size = 4 * n * d * STRIPS * 3.5 + 2 * 4 * FRAMES * STRIPS**2 * min(n, MATRIX_PLACES)
    limit = min(MAX_MEMORY, 0.9 * free_bytes())
    return '' if size <= limit else f'needs {size / 1e9:.1f} GB, {limit / 1e9:.1f} GB may be used'


# ------------------------------------------------ on windows of distances, mode robust


def robust_stages(run: Run, n: int) -> None:
    """Measure the stages of mode robust that follow the image distances."""
    add = partial(run.measure, size=(n, 0), mode='robust')
    rows, images = make_window(SEQUENCE.length, n), np.arange(SEQUENCE.length)
    path = np.minimum(n // 2 + images, n - 1)
    rows[images, path] = 0.1  # of right places
    sizes, z = Sizes(n, l=SEQUENCE.length), [z_normalized(row) for row in rows]
    add('query_znorm', call=lambda: z_normalized(rows[-1]), works=[bounds.query_znorm(sizes)])
    place_filter = PlaceFilter(n, SEQUENCE.length)
    for row in z:
        place_filter.update(row)
    smooth = partial(place_filter.beliefs, SEQUENCE.length)
    add('smoothing', call=smooth, works=[bounds.smoothing(sizes, len(smooth().columns))])
    middle = (SEQUENCE.length - 1) // 2
    steps = np.rint(np.outer(STRAIGHT, images - middle)).astype(np.int64)
    near = np.array([[path[middle] - APART, path[middle] + APART + 1]])
    straight = partial(place_filter.best_straight, steps, slice(0, n), near)
    add('straight_paths', call=straight, works=[bounds.straight_paths(sizes, len(STRAIGHT))])
    update, states = partial(place_filter.update, z[-1]), n * len(MODEL.speeds)
    add('filter_update', call=update, works=[bounds.filter_update(sizes)], cells=states)


def cell_stage(run: Run, places: LocalFeatures) -> None:
    """Measure cells of an image that moves along the map, and whose competitor is another one."""
    _, cells = evidence_of(places.settings.kind, STRIPS, places.dimension)
    if cells is None:
        return
    n, length = len(places), SEQUENCE.length
    agreement = CellAgreement(cells, lambda columns: places.strips[:, columns], length)
    numbers, rng = count(), np.random.default_rng(0)

    def compare() -> None:
        path = (next(numbers) + np.arange(length)) % n
        agreement.push(places.strips[:, path[-1]])
        agreement.lead(path, (rng.integers(n) + np.arange(length)) % n)

    for place in range(length - 1):
        agreement.push(places.strips[:, place % n])
    works = [bounds.cells(Sizes(n, places.dimension), cells)]
    run.measure('cells', (n, places.dimension), compare, works, mode='robust')


# ------------------------------------------------ on windows of distances, mode paper


def paper_stages(run: Run, n: int) -> None:
    """Measure the stages of mode paper that follow the image distances."""
    add = partial(run.measure, size=(n, 0), mode='paper')
    window = make_window(SEQUENCE.length, n)
    padded = np.full((SEQUENCE.length, padded_width(n, SEQUENCE.k)), np.inf, np.float32)
    padded[:, :n] = window
    sizes = Sizes(n, 0, l=SEQUENCE.length, k=SEQUENCE.k)
    push = partial(LmDtwWindow(SEQUENCE, n, ColumnLayout()).push, window[-1], window, 0)
    add('window_push', call=push, works=[bounds.window_push(sizes)])
    kernel = partial(match_padded, padded, n, SEQUENCE.k)
    matches = kernel()
    add(
        'lm_dtw',
        call=kernel,
        works=[bounds.lm_dtw(sizes)],
        peers=sequence_peers(run, window, matches),
        cells=n * SEQUENCE.length * SEQUENCE.k,
    )
    select = partial(best_match, matches, NMS_RADIUS)
    add('selection', call=select, works=[bounds.selection(sizes)])
    nearest = select()
    assert nearest is not None
    trace = partial(trace_sequence, padded[:, :n], nearest.first, SEQUENCE.k)
    width = min(n - nearest.first, SEQUENCE.k)
    add('path_trace', call=trace, works=[bounds.path_trace(SEQUENCE.length, width)])


def sequence_peers(run: Run, window: np.ndarray, ours: SequenceDistances) -> list[Peer]:
    """Return the peers of LM-DTW on the same window; their results must be ours."""
    peers = [_prange_peer(window, ours)]
    try:
        from librosa.sequence import dtw
    except ImportError:
        run.skip('librosa', 0, 0, 'not installed (requirements/bench.txt)')
        return peers
    return [*peers, librosa_peer(window, dtw)]


@nb.njit(parallel=True, error_model='numpy')
def plain_lm_dtw(D: np.ndarray, k: int, distances: np.ndarray, lengths: np.ndarray) -> None:
    """
    Compute the textbook's loops of LM-DTW, parallel over the starts, each of which keeps one row.

    Arithmetic, tie rule and results are as in the package's kernel.

    :param D: distances of images, shape (l, n), float32.
    :param k: map images within reach of a start.
    :param distances, lengths: results, shape (n,), float32 and int32.
    """
    l, n = D.shape
    one = np.float32(1)
    for s in nb.prange(n):
        columns = min(k, n - s)
        S, C = np.empty(columns, np.float32), np.empty(columns, np.float32)
        S[0], C[0] = D[0, s], one
        for x in range(1, columns):
            S[x], C[x] = D[0, s + x] + S[x - 1], C[x - 1] + one
        for i in range(1, l):
            S_before, C_before = S[0], C[0]  # of cell (i-1, x-1)
            S[0], C[0] = D[i, s] + S[0], C[0] + one
            for x in range(1, columns):
                cost = D[i, s + x]
                diagonal, vertical, horizontal = cost + S_before, cost + S[x], cost + S[x - 1]
                S_before, C_above = S[x], C[x]
                if diagonal < vertical and diagonal < horizontal:
                    S[x], C[x] = diagonal, C_before + one
                elif vertical <= horizontal:
                    S[x], C[x] = vertical, C_above + one
                else:
                    S[x], C[x] = horizontal, C[x - 1] + one
                C_before = C_above
        best, m = np.float32(np.inf), 0
        for x in range(columns):
            if S[x] / C[x] < best:
                best, m = S[x] / C[x], x + 1
        distances[s], lengths[s] = best, m


def _prange_peer(window: np.ndarray, ours: SequenceDistances) -> Peer:
    n = window.shape[1]
    distances, lengths = np.empty(n, np.float32), np.empty(n, np.int32)
    call = partial(plain_lm_dtw, window, SEQUENCE.k, distances, lengths)
    call()
    np.testing.assert_array_equal(distances, ours.distances)
    np.testing.assert_array_equal(lengths, ours.lengths)
    return Peer('prange', timed_job(call), 'plain numba, all cores; the same results bit for bit')


def accumulate_costs(costs: np.ndarray) -> float:
    """Return the accumulated cost of the last cell of dynamic time warping, in float64."""
    S = np.full((costs.shape[0] + 1, costs.shape[1] + 1), np.inf)
    S[0, 0] = 0
    for i, j in np.ndindex(costs.shape):
        S[i + 1, j + 1] = costs[i, j] + min(S[i, j], S[i, j + 1], S[i + 1, j])
    return float(S[-1, -1])


def sample(n: int, k: int, count: int) -> list[int]:
    """Return ``count`` starts, spread evenly over the starts with k columns, or all of these."""
    whole = max(1, n - k + 1)
    return sorted({int(start) for start in np.linspace(0, whole - 1, min(count, whole))})


def librosa_peer(window: np.ndarray, dtw: Callable[..., np.ndarray]) -> Peer:
    """
    Return librosa as a peer; the sums that it accumulates must equal the sums of plain loops.

    :param dtw: ``librosa.sequence.dtw``.
    """
    n, k = window.shape[1], SEQUENCE.k
    starts = sample(n, k, LIBROSA_STARTS)
    costs = [window[:, start : start + k].copy() for start in starts]  # not timed
    for start, matrix in zip(starts[:ENDS_CHECKED], costs, strict=False):
        end = dtw(C=matrix, backtrack=False)[-1, -1]
        np.testing.assert_allclose(end, accumulate_costs(matrix), 1e-6, err_msg=f'start {start}')
    job = timed_job(lambda: [dtw(C=matrix, backtrack=False) for matrix in costs])
    note = 'one core; S of every cell in float64, no path length C, so neither q_m nor m; '
    return Peer('librosa', lambda: job() * n / len(starts), f'{note}{len(starts)} starts, scaled')


# ------------------------------------------------ on maps of features


def feature_stages(run: Run, n: int, d: int) -> None:
    """Measure the stages that read features, and whole frames in both modes."""
    places = make_features(n, d, STRIPS, 0)
    queries = make_features(FRAMES, d, STRIPS, 1)
    sizes, size = Sizes(n, d, STRIPS, SEQUENCE.length, SEQUENCE.k), (n, d)
    centered = partial(MeanCentering(places).next_query, queries.strips[:, 0])
    run.measure('mean_centering', size, centered, [bounds.mean_centering(sizes)], mode='robust')
    cell_stage(run, places)
    for precision in PRECISIONS:
        peers = references(run, places, queries[:1], precision)
        matcher = make_matcher(places, SPATIAL, 'cpu', precision)
        first = np.ascontiguousarray(queries.strips[:, 0])
        call: Call = partial(matcher.distances, first, queries.weights[:, 0])
        works = [bounds.product(sizes, precision), bounds.spatial_alignment(sizes)]
        run.measure('image_distances', size, call, works, peers, precision)
        if n <= MATRIX_PLACES:
            call = partial(matcher.distance_matrix, queries.strips, queries.weights)
            works = [bounds.product(sizes, precision, FRAMES)]
            works += [bounds.spatial_alignment(sizes, FRAMES)]
            many = [product(places, queries)]
            run.measure('distance_matrix', size, call, works, many, precision)
        del matcher, call
        for mode in MODES:
            call = frame(places, mode, precision)
            works = frame_works(sizes, mode, precision)
            # of mode paper, the product is the larger part of the work
            beside = peers if mode == 'paper' else map_reading(sizes, precision)
            run.measure('frame', size, call, works, beside, precision, mode)
            del call
            gc.collect()


def map_reading(sizes: Sizes, precision: str) -> list[Peer]:
    """Return the reading of as many bytes as the map has, as a peer."""
    content = np.ones(sizes.W * sizes.n * sizes.d * ITEM_BYTES[precision] // 4, np.float32)
    call = partial(reader(nb.get_num_threads()), content)
    return [Peer(READING, timed_job(call), 'as many bytes read once, on all cores', partial=True)]


def frame_works(sizes: Sizes, mode: str, precision: str) -> list[bounds.Work]:
    """Return the work of a whole frame; what is done near one path is too short to matter."""
    works = [bounds.product(sizes, precision), bounds.spatial_alignment(sizes)]
    if mode == 'paper':
        return [*works, bounds.window_push(sizes), bounds.lm_dtw(sizes), bounds.selection(sizes)]
    works += [bounds.mean_centering(sizes), bounds.query_znorm(sizes), bounds.filter_update(sizes)]
    return [*works, bounds.straight_paths(sizes, len(STRAIGHT))]


def city_stages(run: Run, n: int, d: int) -> None:
    """Measure the image distances of a map in int8."""
    from stavpr_ros.prepare.matcher import CpuMatcher

    rounded: Any = Int8Strips(STRIPS, n, d)
    for low in range(0, n, MATRIX_PLACES):
        block = make_features(min(MATRIX_PLACES, n - low), d, STRIPS, low)
        rounded[:, low:] = block.strips
    query = make_features(1, d, STRIPS, 0)
    weights = np.full((STRIPS, n), STRIPS**-0.5, np.float32)
    places = Int8Features(rounded, weights, query.settings)
    matcher = CpuMatcher(places, SPATIAL)
    arguments = np.ascontiguousarray(query.strips[:, 0]), query.weights[:, 0]
    sizes = Sizes(n, d, STRIPS, SEQUENCE.length, SEQUENCE.k)
    works = [bounds.product(sizes, 'int8'), bounds.spatial_alignment(sizes)]
    call = partial(matcher.distances, *arguments)
    run.measure('image_distances', (n, d), call, works, precision='int8')


def process_stages(run: Run, n: int, precision: str) -> None:
    """
    Measure ``Operation.process`` of images that match, with the inputs of their edges.

    The peer processes images of the same drive that do not match, as no probability is enough.
    """
    if n < 2 * DRIVE_IMAGES:
        return run.skip('process', n, PROJECTED, f'fewer than {2 * DRIVE_IMAGES:,} places')
    extractor, d = FeatureExtractor('gradient', projection=PROJECTED), PROJECTED
    images = np.random.default_rng(0).integers(0, 256, (DRIVE_IMAGES, 48, 64, 3), np.uint8)
    driven = extractor.extract(list(images))
    strips = make_features(n, d, STRIPS, 0).strips
    strips *= d**0.5 * driven.strips.std(axis=1, keepdims=True)
    strips += driven.strips.mean(axis=1, keepdims=True)
    normalize(strips)
    strips[:, (n - DRIVE_IMAGES) // 2 :][:, :DRIVE_IMAGES] = driven.strips
    features = LocalFeatures(
        strips, np.full((STRIPS, n), STRIPS**-0.5, np.float32), extractor.settings
    )
    poses = np.zeros((n, 7))
    poses[:, 0], poses[:, 6] = np.arange(n), 1
    names = ('',) * n
    place_map = Map(features, extractor.projection, np.zeros(n, np.int64), names, poses)
    pipeline = Pipeline(PipelineSettings(backend='cpu', precision=precision))
    pipeline.change(loaded=LoadedMap('', place_map, extractor))
    following, accepted = cycle(range(DRIVE_IMAGES)), {0.5: 0, 1.0: 0}

    def process(min_probability: float) -> None:
        limit = min(min_probability, 1 - 1e-9)
        pipeline.change(replace(pipeline.settings, min_probability=limit))
        i = next(following)
        result = pipeline.operation.process(ImageRecord.of_image(images[i], 0), i, poses[i])
        pipeline.operation.matched_pair(result.match)
        accepted[min_probability] += result.match.accepted

    for _ in range(2 * SEQUENCE.length):
        process(0.5)
    job = timed_job(partial(process, 1.0))
    peer = Peer('without matches', job, 'the same, but no image matches', partial=True)
    works = frame_works(Sizes(n, d, STRIPS, SEQUENCE.length, SEQUENCE.k), 'robust', precision)
    run.measure('process', (n, d), partial(process, 0.5), works, [peer], precision, 'robust')
    assert accepted[0.5] > 0 == accepted[1.0]


def references(
    run: Run, places: LocalFeatures, query: LocalFeatures, precision: str
) -> list[Peer]:
    """Return the peers of one image's distances: torch's product, a search for the nearest."""
    peers = [product(places, query)]
    images, image = (
        features.strips.transpose(1, 0, 2).reshape(len(features), -1)
        for features in (places, query)
    )
    search = faiss_peer if precision == 'float32' else usearch_peer
    try:
        peers.append(search(images, image))
    except ImportError as error:
        name = str(error.name).split('.', maxsplit=1)[0]
        run.skip(name, 0, 0, f'not installed (requirements/{SEARCHES[name]}.txt)')
    return peers


def faiss_peer(images: np.ndarray, image: np.ndarray) -> Peer:
    """Return FAISS as a peer of the product: whole images as vectors, the nearest one of all."""
    import faiss

    index = faiss.IndexFlatIP(images.shape[1])
    index.add(images)
    note = 'IndexFlatIP, one product of whole images instead of 49 of strips'
    return Peer('faiss flat', timed_job(partial(index.search, image, 1)), note, partial=True)


def usearch_peer(images: np.ndarray, image: np.ndarray) -> Peer:
    """Return usearch as a peer of the product in int8: whole images as vectors, the nearest."""
    from usearch.index import MetricKind, search

    vectors, query = (
        np.rint(rows / np.abs(rows).max(axis=1, keepdims=True) * 127).astype(np.int8)
        for rows in (images, image)
    )
    call = partial(search, vectors, query, 1, MetricKind.Cos, exact=True, threads=0)
    note = 'exact search in int8, one product of whole images instead of 49 of strips'
    return Peer('usearch int8', timed_job(call), note, partial=True)


def product(places: LocalFeatures, queries: LocalFeatures) -> Peer:
    """
    Return torch's product of queries with the map in float32, in its faster orientation.

    The faster orientation of a skinny product depends on the machine. The memory of the result is
    allocated beforehand.
    """
    d = places.dimension
    strips, rows = (
        torch.from_numpy(np.ascontiguousarray(array.reshape(-1, d)))
        for array in (places.strips, queries.strips.transpose(1, 0, 2))
    )
    out = torch.empty(len(rows) * len(strips))
    wide, tall = out.view(len(rows), -1), out.view(len(strips), -1)
    forms: dict[str, Call] = {
        'queries @ map.T': lambda: torch.mm(rows, strips.T, out=wide),
        'map @ queries.T': lambda: torch.mm(strips, rows.T, out=tall),
    }
    form = min(forms, key=lambda name: best_seconds(forms[name], 0))
    note = f'{form}, all pairs of strips, no alignment'
    return Peer('torch float32', timed_job(forms[form]), note, partial=True)


def frame(places: LocalFeatures, mode: str, precision: str) -> Call:
    """Return a call that updates a recognizer, on the map, its window full, with an image."""
    settings = RecognizerSettings(1.0 if mode == 'paper' else None, mode=mode)
    recognizer = PlaceRecognizer(descriptor_map(places), settings, precision=precision)
    queries = along(places, min(len(places), DRIVE_IMAGES))
    following = cycle([queries[i : i + 1] for i in range(len(queries))])
    for _ in range(SEQUENCE.length):
        recognizer.update(next(following))
    return lambda: recognizer.update(next(following))
