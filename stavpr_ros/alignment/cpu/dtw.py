# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The distances of one image to many map images from the distances of their strips (section 2)."""

import numba as nb
import numpy as np
from stavpr_ros.alignment.cpu.dtw_steps import open_edge, SLOT, sweep_row
from stavpr_ros.alignment.cpu.simd import LANES, load, select, splat, store
from stavpr_ros.compilation import kernel, parallel_kernel

BLOCKS = 16  # vectors of map images that a thread takes at a time


@kernel
def adaptive_weight(d, at, stride, weights, xi):
    """The weight a for |I_c - c| of each lane; the row of the central strip c starts at ``at``."""
    W = weights.shape[0]
    c = (W + 1) // 2 - 1  # ceil(W / 2), 0-based
    nearest = splat(d.dtype.type(np.inf))
    weight = splat(weights[0])
    for j in range(max(0, c - xi + 1), min(W, c + xi)):
        x = load(d, at + j * stride)
        nearer = x < nearest
        weight = select(nearer, splat(weights[abs(j - c)]), weight)
        nearest = select(nearer, x, nearest)
    return weight


@kernel
def align_lanes(d, at, row, column, weights, xi, edge):
    """
    S[W,W] / C[W,W] of LANES neighboring map images, as a vector.

    :param d, at, row, column: flat strip distances; cell (i, j) lies at + i * row + j * column.
    :param weights: a for each |I_c - c|, shape (W,); all 1 for vanilla DTW.
    :param xi: half width of the band, W for none.
    :param edge: shape ((W + 1) * SLOT,), scratch.
    """
    W = weights.shape[0]
    weight = adaptive_weight(d, at + ((W + 1) // 2 - 1) * row, column, weights, xi)
    open_edge(edge, W)
    sweep_row(d, at, column, 0, min(W, xi), edge, splat(d.dtype.type(1)))
    for i in range(1, W):
        sweep_row(d, at + i * row, column, max(0, i - xi + 1), min(W, i + xi), edge, weight)
    return load(edge, W * SLOT) / load(edge, W * SLOT + LANES)


@parallel_kernel
def spatial_dtw(d, weights, xi, out):
    """
    Image distances of one query image to n >= LANES map images.

    :param d: strip distances, shape (W, W, n), C-contiguous.
    :param weights, xi: as in :func:`align_lanes`.
    :param out: shape (n,), written.
    """
    W, _, n = d.shape
    flat = d.reshape(-1)
    blocks = (n + LANES - 1) // LANES
    for part in nb.prange((blocks + BLOCKS - 1) // BLOCKS):
        edge = np.empty((W + 1) * SLOT, d.dtype)
        for block in range(part * BLOCKS, min(blocks, (part + 1) * BLOCKS)):
            first = min(block * LANES, n - LANES)  # the last block overlaps the one before
            store(out, first, align_lanes(flat, first, W * n, n, weights, xi, edge))


@parallel_kernel
def sliding_window(d, width, xi, out):
    """
    Smallest mean of ``width`` diagonal cells d[p+t, q+t]; windows outside the band are left out.

    :param d: strip distances, shape (W, W, n).
    :param out: shape (n,), written.
    """
    W, _, n = d.shape
    for y in nb.prange(n):
        best = d.dtype.type(np.inf)
        for p in range(W - width + 1):
            for q in range(W - width + 1):
                if abs(p - q) < xi:
                    total = d[p, q, y]
                    for t in range(1, width):
                        total += d[p + t, q + t, y]
                    best = min(best, total / d.dtype.type(width))
        out[y] = best
