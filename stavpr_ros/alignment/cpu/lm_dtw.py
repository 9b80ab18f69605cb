# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""LM-DTW: the best sequence from every start (section 4), and the best of them."""

import numba as nb
import numpy as np
from stavpr_ros.alignment.cpu.dtw import open_edge, SLOT, sweep_four_rows, sweep_row
from stavpr_ros.compilation import kernel, parallel_kernel
from stavpr_ros.simd import LANES, load, select, splat, store

BLOCKS = 8  # vectors of starts that a thread takes at a time


@kernel
def _match_lanes(D, first, l, pitch, k, edge, distances, lengths):
    """Align the window, rows ``pitch`` apart in the flat D, with LANES starts from ``first``."""
    open_edge(edge, k)
    one = splat(D.dtype.type(1))
    fours = l // 4 * 4
    for i in range(0, fours, 4):
        sweep_four_rows(D, i * pitch + first, pitch, k, edge)
    for i in range(fours, l):
        sweep_row(D, i * pitch + first, 1, 0, k, edge, one)
    best = splat(D.dtype.type(np.inf))
    length = splat(np.int32(0))
    x, one_more = splat(np.int32(0)), splat(np.int32(1))
    for column in range(k):
        slot = (column + 1) * SLOT
        q = load(edge, slot) / load(edge, slot + LANES)
        x = x + one_more
        better = q < best
        best = select(better, q, best)
        length = select(better, x, length)
    store(distances, first, best)
    store(lengths, first, length)


@parallel_kernel
def lm_dtw(D, k, distances, lengths):
    """
    Distance q_m and length m of every start.

    :param D: image distances, shape (l, N + k - 1), C-contiguous, with N = n rounded up to whole
        vectors of LANES; whatever lies past the map's end is +inf.
    :param k: map images a start searches.
    :param distances: shape (N,), written; +inf where no path is finite.
    :param lengths: shape (N,) int32, written; 0 there.
    """
    l, pitch = D.shape
    flat = D.reshape(-1)
    vectors = distances.shape[0] // LANES
    for part in nb.prange((vectors + BLOCKS - 1) // BLOCKS):
        edge = np.empty((k + 1) * SLOT, D.dtype)
        for block in range(part * BLOCKS, min(vectors, (part + 1) * BLOCKS)):
            _match_lanes(flat, block * LANES, l, pitch, k, edge, distances, lengths)


@kernel
def nearest_elsewhere(distances, lengths, middle, nms_radius):
    """Return the nearest start whose midpoint is not near ``middle``; -1 if there is none."""
    best, start = np.inf, -1
    for s in range(distances.shape[0]):
        if distances[s] < best and abs((2 * s + lengths[s] - 1) // 2 - middle) > nms_radius:
            best, start = distances[s], s
    return start
