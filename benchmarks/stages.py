"""The stages of one size: with a map of features, and on windows of distances alone."""

import gc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from baselines import oracle, prange, sample
from ceilings import is_slow
from data import feature_bytes, free_bytes, make_features, make_window
from floors import FRAMES, Sizes, product
from peer_process import Peers
from run import Peer, Run
from subjects import (
    NEIGHBORHOOD,
    Call,
    bare_product,
    largest_error,
    online_frames,
    selection,
    sequence_kernel,
)
from timing import Job, synchronizer, timed

from stavpr_ros.alignment import SequenceDistances, SequenceSettings, SpatialSettings
from stavpr_ros.features import LocalFeatures
from stavpr_ros.recognition.matcher import make_matcher

ORACLE_STARTS, LIBROSA_STARTS, TSLEARN_STARTS = 3, 500, 20
ENDS_CHECKED = 3
FEW_DIMENSIONS = 8  # of the features where only distances count
PEER_NOTES = {
    'librosa': 'one core; S of every cell in float64, no path length C, so neither q_m nor m',
    'tslearn': 'one core; S of every cell in float64 and the path to (l, k); no free end on the last row',
    'prange': 'all cores; the same answers, bit for bit',
    'oracle': 'test/oracle.py, Python loops, one core; the same answers, bit for bit',
}


@dataclass(frozen=True)
class Plan:
    """
    What is measured of every size.

    :param precisions: of the matcher's map.
    :param W: strips of an image.
    :param sequence: l and beta.
    :param memory: bytes that may be used at most.
    :param seed: of all data.
    :param most_operations: distance matrices with more are left out.
    """

    precisions: tuple[str, ...]
    W: int
    sequence: SequenceSettings
    memory: float
    seed: int
    most_operations: float = math.inf

    def sizes(self, n: int, d: int, xi: int | None = None) -> Sizes:
        """Return the sizes of a problem."""
        return Sizes(n, d, self.W, self.sequence.length, self.sequence.k, xi or self.W)

    def has_matrix(self, sizes: Sizes) -> bool:
        """Whether the distance matrix of these sizes is measured."""
        return product(sizes, 'float32', FRAMES, whole=True).operations <= self.most_operations

    def needed(self, n: int, d: int) -> float:
        """Return the bytes that the stages with features need at least."""
        half = 0.5 if set(self.precisions) != {'float32'} else 0
        blocks = 2 * 4 * FRAMES * self.W**2 * n  # twenty frames' distances of all strips: torch's and ours
        return feature_bytes(n, d, self.W) * (1 + half) + blocks


def memory_problem(plan: Plan, run: Run, n: int, d: int) -> str:
    """Return why the stages with features do not fit, in words; empty if they do."""
    limit = min(plan.memory, 0.9 * free_bytes(run.device))
    needed = plan.needed(n, d)
    return '' if needed <= limit else f'needs {needed / 1e9:.1f} GB, {limit / 1e9:.1f} GB may be used'


def release(device: str) -> None:
    """Give back the memory of what is no longer used."""
    gc.collect()
    if device == 'cuda':
        torch.cuda.empty_cache()


def _products(
    run: Run,
    plan: Plan,
    sizes: Sizes,
    features: LocalFeatures,
    queries: LocalFeatures,
    half: bool,
) -> dict[tuple[str, int], Peer]:
    """
    Measure torch's product of one frame with the map, in the matcher's precisions and in bfloat16.

    :param half: there is memory for a second map, in half width.
    :returns: the product of one frame, and of twenty, as peers, by precision and frames.
    """
    peers = {}
    rows = queries.strips.transpose(0, 1).reshape(-1, sizes.d)  # the strips of a frame side by side
    for dtype in dict.fromkeys((*plan.precisions, 'bfloat16')):
        if dtype != 'float32' and not half:
            run.skip('product', sizes.n, sizes.d, dtype, 'no memory for a second map in this precision')
            continue
        kind = getattr(torch, dtype)
        references = features.strips.to(kind)
        for frames in (1, FRAMES) if plan.has_matrix(sizes) else (1,):
            wait = synchronizer(run.device)
            queries_rows = rows[: frames * sizes.W].to(references.device, kind)
            call, form = bare_product(queries_rows, references, wait)
            if frames == 1:
                run.measure('product', sizes, dtype, call, what=form)
                if is_slow(dtype, run.device):
                    break  # nobody would take it: no peer
            note = f'{dtype} product of all pairs of strips, no alignment'
            said = {'peer_note': note, 'peer_part': True, 'peer_what': form}
            peers[dtype, frames] = Peer(f'torch_{dtype}', timed(call, wait), said)
    return peers


def feature_stages(run: Run, plan: Plan, n: int, d: int, bands: Sequence[int | None]) -> None:
    """Measure the stages that see features: product, image distances, distance matrix, a whole frame."""
    spare = min(plan.memory, 0.9 * free_bytes(run.device)) - plan.needed(n, d)
    half = spare > 0.5 * feature_bytes(n, d, plan.W)  # torch's own half-width map beside the matcher's
    features = make_features(n, d, plan.W, run.device, plan.seed)
    queries = make_features(FRAMES, d, plan.W, 'cpu', plan.seed + 1)
    peers = _products(run, plan, plan.sizes(n, d), features, queries, half)
    for precision in plan.precisions:
        compared = dict.fromkeys((precision, 'float32', *(('bfloat16',) if precision != 'float32' else ())))
        of_frame, of_batch = (
            [peers[dtype, count] for dtype in compared if (dtype, count) in peers] for count in (1, FRAMES)
        )
        for xi in bands:
            sizes = plan.sizes(n, d, xi)
            measure = partial(run.measure, sizes=sizes, dtype=precision, xi=sizes.xi)
            spatial = SpatialSettings(xi=xi)
            _matcher_stages(run, measure, plan, features, queries, spatial, precision, (of_frame, of_batch))
            release(run.device)
            frame, what = online_frames(features, queries, spatial, plan.sequence, precision, run.device)
            measure('online_frame', call=frame, peers=of_frame, what=what)
            del frame
            release(run.device)


def _matcher_stages(
    run: Run,
    measure: Callable[..., Any],
    plan: Plan,
    features: LocalFeatures,
    queries: LocalFeatures,
    spatial: SpatialSettings,
    precision: str,
    peers: tuple[Sequence[Peer], Sequence[Peer]],
) -> None:
    """Measure one frame, and twenty at once, with the queries on the map's device."""
    device = features.strips.device
    matcher = make_matcher(features, spatial, plan.sequence, device.type, precision)
    batch = queries.to(device)
    strips, weights = batch.strips[:, 0].contiguous(), batch.weights[:, 0].contiguous()
    call = partial(matcher.distances, strips, weights)
    error = largest_error(call(), features, strips, spatial)
    measure('image_distances', call=call, peers=peers[0], largest_error=error)
    call = partial(matcher.distance_matrix, batch.strips, batch.weights)
    _, n, d = features.strips.shape
    if not plan.has_matrix(plan.sizes(n, d)):
        run.skip('distance_matrix', n, d, precision, 'too many operations for --quick')
        return
    error = largest_error(call()[0], features, strips, spatial)
    measure('distance_matrix', call=call, peers=peers[1], frames=FRAMES, largest_error=error)


def _prange_job(window: np.ndarray, k: int, ours: SequenceDistances) -> Job:
    """Return the plain prange over starts as a job; its answers must be ours."""
    kernel, n = prange(), window.shape[1]
    distances, lengths = np.empty(n, np.float32), np.empty(n, np.int32)
    kernel(window, k, distances, lengths)
    np.testing.assert_array_equal(distances, ours.distances)
    np.testing.assert_array_equal(lengths, ours.lengths)
    return timed(lambda: kernel(window, k, distances, lengths))


def _oracle_job(window: np.ndarray, plan: Plan, ours: SequenceDistances) -> tuple[Job, int]:
    """Return the oracle on a few starts, scaled to all, and how many; its answers must be ours."""
    n, k, beta = window.shape[1], plan.sequence.k, plan.sequence.beta
    align = oracle().align_sequence
    starts = sample(n, k, ORACLE_STARTS)
    for start in starts:
        aligned = align(window, start, beta, np.float32)
        np.testing.assert_equal(ours.distances[start], aligned.distance)
        np.testing.assert_equal(ours.lengths[start], aligned.path[-1][1] - start + 1)
    job = timed(lambda: [align(window, start, beta, np.float32) for start in starts])
    return (lambda: job() * n / len(starts)), len(starts)


def _process_job(peers: Peers, name: str, window: np.ndarray, starts: list[int], k: int) -> Job:
    """Return a peer of the other environment on a sample, scaled to all; it must accumulate what we do."""
    path, n = peers.put(window), window.shape[1]
    few = starts[:ENDS_CHECKED]
    for start, end in zip(few, peers.run(name, path, few, k)['ends'], strict=True):
        costs = window[:, start : start + k]
        expected = float(oracle().accumulate(costs, 1, np.float64).S[-1][-1])
        np.testing.assert_allclose(end, expected, rtol=1e-6, err_msg=f'{name}, start {start}')
    return lambda: peers.run(name, path, starts, k)['seconds'] * n / len(starts)


def sequence_peers(
    plan: Plan, window: np.ndarray, ours: SequenceDistances, processes: Peers | None
) -> list[Peer]:
    """Return everyone who does LM-DTW's cells on the same window."""
    n, k = window.shape[1], plan.sequence.k
    loops, count = _oracle_job(window, plan, ours)
    found = [
        Peer('prange', _prange_job(window, k, ours), {'peer_note': PEER_NOTES['prange']}),
        Peer('oracle', loops, {'peer_note': PEER_NOTES['oracle'], 'peer_sample': count}),
    ]
    for name, starts in (('librosa', LIBROSA_STARTS), ('tslearn', TSLEARN_STARTS)):
        if processes:
            chosen = sample(n, k, starts)
            job = _process_job(processes, name, window, chosen, k)
            said = {'peer_note': PEER_NOTES[name], 'peer_sample': len(chosen)}
            found.append(Peer(name, job, said | {'peer_version': processes.versions[name]}))
    return found


def _retrieval(plan: Plan, window: np.ndarray, device: str, ours: SequenceDistances) -> Call:
    """Return the matcher's answer to a window that it holds already; it must be that of the kernel."""
    features = make_features(window.shape[1], FEW_DIMENSIONS, plan.W, device, plan.seed)
    matcher = make_matcher(features, SpatialSettings(), plan.sequence, device, 'float32')
    for row in window:
        matcher.push(torch.from_numpy(row).to(device))
    call = partial(matcher.match, NEIGHBORHOOD)
    # as text: a second best that is not there has a distance of NaN, which equals nothing
    np.testing.assert_equal(str(call()[0]), str(selection(ours)()))
    return call


def sequence_stages(run: Run, plan: Plan, n: int, processes: Peers | None, no_peers: str) -> None:
    """
    Measure LM-DTW, the selection, and the matcher's answer, on windows of distances.

    :param no_peers: why there are no peers of the other environment.
    """
    sizes = plan.sizes(n, 0)
    measure = partial(run.measure, sizes=sizes, dtype='float32', dim=0)

    def rate(median_s: float) -> float:
        return sizes.cells / median_s

    window = make_window('random', sizes.l, n, plan.seed)
    kernel = sequence_kernel(window, sizes.k)
    matches = kernel()
    peers = sequence_peers(plan, window, matches, processes)
    if run.device == 'cpu':
        measure('lm_dtw', call=kernel, peers=peers, data='random', cells_per_s=rate)
        walk = sequence_kernel(make_window('walk', sizes.l, n, plan.seed), sizes.k)
        # what the data do to our own time is seen without peers
        measure('lm_dtw', call=walk, data='walk', cells_per_s=rate)
        measure('select', call=selection(matches), data='random')
        peers = []
    answer = _retrieval(plan, window, run.device, matches)
    measure('retrieval', call=answer, peers=peers, data='random', cells_per_s=rate)
    for name in () if processes else ('librosa', 'tslearn'):
        run.skip('lm_dtw' if run.device == 'cpu' else 'retrieval', n, 0, 'float32', no_peers, peer=name)
