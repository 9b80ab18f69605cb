# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The recursion of both alignments, row by row, on all lanes at once.

Between rows the *edge* has S and C of the row above: flat, slot x + 1 is column x, slot 0 the
corner (-1, -1), whose S = C = 0 makes the first cell an ordinary diagonal step of weight 1.
Infinite S mark what may not be used. The diagonal is taken only when strictly smallest; vertical
wins a tie over horizontal. No ``fastmath``: the answers are the oracle's bit for bit.
"""

import math

import numba as nb
import numpy as np
from stavpr_ros.compilation import kernel, parallel_kernel
from stavpr_ros.simd import LANES, load, select, splat, store

SLOT = 2 * LANES  # S, then C
VERTICAL, HORIZONTAL, DIAGONAL = 0, 1, 2
SHIFT_COST = 1 / 32  # distance a strip: a camera that looks to the side shifts from place to place
BLOCKS = 16  # vectors of map images that a thread takes at a time


@kernel
def open_edge(edge, columns):
    """Make the edge above the first row."""
    zero = splat(edge.dtype.type(0))
    infinity = splat(edge.dtype.type(np.inf))
    for slot in range(columns + 1):
        store(edge, slot * SLOT, infinity)
        store(edge, slot * SLOT + LANES, zero)
    store(edge, 0, zero)


@kernel
def step(
    x, x_diagonal, S_vertical, C_vertical, S_horizontal, C_horizontal, S, C, one, diagonal_cost
):
    """S and C of one cell from its three predecessors; the last S and C are the diagonal one's."""
    vertical = x + S_vertical
    horizontal = x + S_horizontal
    diagonal = x_diagonal + S
    sideways = horizontal < vertical
    straight = select(sideways, horizontal, vertical)
    cost = select(sideways, C_horizontal, C_vertical) + one
    is_diagonal = diagonal < straight
    return select(is_diagonal, diagonal, straight), select(is_diagonal, C + diagonal_cost, cost)


@kernel
def sweep_row(d, at, stride, first, last, edge, weight):
    """
    Advance the edge by one row, columns first..last-1.

    :param d, at, stride: flat distances; column x of the row lies at + x * stride.
    :param weight: vector, what a diagonal step multiplies x with and costs.
    """
    one = splat(edge.dtype.type(1))
    S, C = splat(edge.dtype.type(np.inf)), one
    S_corner, C_corner = load(edge, first * SLOT), load(edge, first * SLOT + LANES)
    store(edge, 0, S)  # the corner serves the first row only
    for x in range(first, last):
        slot = (x + 1) * SLOT
        S_above, C_above = load(edge, slot), load(edge, slot + LANES)
        cell = load(d, at + x * stride)
        S, C = step(cell, weight * cell, S_above, C_above, S, C, S_corner, C_corner, one, weight)
        S_corner, C_corner = S_above, C_above
        store(edge, slot, S)
        store(edge, slot + LANES, C)


@kernel
def sweep_four_rows(d, at, pitch, columns, edge):
    """Advance the edge, in registers, by four rows, ``pitch`` apart, with a = 1."""
    one = splat(edge.dtype.type(1))
    S0 = S1 = S2 = S3 = splat(edge.dtype.type(np.inf))
    C0 = C1 = C2 = C3 = one
    S, C = load(edge, 0), load(edge, LANES)
    store(edge, 0, S0)  # the corner serves the first row only
    for x in range(columns):
        slot = (x + 1) * SLOT
        S_above, C_above = load(edge, slot), load(edge, slot + LANES)
        cell = load(d, at + x)
        Sa, Ca = step(cell, cell, S_above, C_above, S0, C0, S, C, one, one)
        cell = load(d, at + pitch + x)
        Sb, Cb = step(cell, cell, Sa, Ca, S1, C1, S0, C0, one, one)
        cell = load(d, at + 2 * pitch + x)
        Sc, Cc = step(cell, cell, Sb, Cb, S2, C2, S1, C1, one, one)
        cell = load(d, at + 3 * pitch + x)
        Sd, Cd = step(cell, cell, Sc, Cc, S3, C3, S2, C2, one, one)
        S, C, S0, C0, S1, C1, S2, C2, S3, C3 = S_above, C_above, Sa, Ca, Sb, Cb, Sc, Cc, Sd, Cd
        store(edge, slot, S3)
        store(edge, slot + LANES, C3)


@kernel
def adaptive_weight(d, at, stride, weights, xi):
    """Return the weight a of each lane; the row of the central strip c starts at ``at``."""
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
    :param weights: a for each ``|I_c - c|``, shape (W,); all 1 for vanilla DTW.
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


@kernel
def shift_lanes(d, at, row, column, W, xi):
    """
    Smallest mean distance of strips i and i + s, |s| < xi, and its cost, of LANES map images.

    :param d, at, row, column: as in :func:`align_lanes`.
    """
    best = splat(d.dtype.type(np.inf))
    for s in range(1 - xi, xi):
        total = splat(d.dtype.type(0))
        for i in range(max(0, -s), W - max(0, s)):
            total = total + load(d, at + i * row + (i + s) * column)
        cost = splat(d.dtype.type(SHIFT_COST * abs(s)))
        mean = total / splat(d.dtype.type(W - abs(s))) + cost
        best = select(mean < best, mean, best)
    return best


@parallel_kernel
def spatial_dtw(d, weights, xi, is_rigid, out):
    """
    Image distances of one query image to n >= LANES map images.

    :param d: strip distances, shape (W, W, n), C-contiguous.
    :param weights, xi: as in :func:`align_lanes`.
    :param is_rigid: whether the image is shifted (:func:`shift_lanes`) instead of aligned.
    :param out: shape (n,), written.
    """
    W, _, n = d.shape
    flat = d.reshape(-1)
    blocks = (n + LANES - 1) // LANES
    for part in nb.prange((blocks + BLOCKS - 1) // BLOCKS):
        edge = np.empty((W + 1) * SLOT, d.dtype)
        for block in range(part * BLOCKS, min(blocks, (part + 1) * BLOCKS)):
            first = min(block * LANES, n - LANES)  # the last block overlaps the one before
            if is_rigid:
                store(out, first, shift_lanes(flat, first, W * n, n, W, xi))
            else:
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


@kernel
def accumulate(d, S, C, step):
    """
    Fill the whole tables of one sequence, for its warping path; diagonal steps have a = 1.

    :param d: distances, shape (rows, columns).
    :param S, C, step: shape of d, written: accumulated distance, path cost, the step into each
        cell but the first.
    """
    rows, columns = d.shape
    for i in range(rows):
        for j in range(columns):
            if i == 0 and j == 0:
                S[0, 0], C[0, 0] = d[0, 0], 1
                continue
            vertical = d[i, j] + S[i - 1, j] if i > 0 else math.inf
            horizontal = d[i, j] + S[i, j - 1] if j > 0 else math.inf
            diagonal = d[i, j] + S[i - 1, j - 1] if i > 0 and j > 0 else math.inf
            if diagonal < vertical and diagonal < horizontal:
                S[i, j], C[i, j], step[i, j] = diagonal, C[i - 1, j - 1] + 1, DIAGONAL
            elif i > 0 and (j == 0 or vertical <= horizontal):
                S[i, j], C[i, j], step[i, j] = vertical, C[i - 1, j] + 1, VERTICAL
            else:
                S[i, j], C[i, j], step[i, j] = horizontal, C[i, j - 1] + 1, HORIZONTAL


@kernel
def backtrack(step, row, column, path):
    """
    Follow the steps back from (row, column) to (0, 0).

    :param path: shape (rows + columns, 2), written.
    :returns: its length.
    """
    count = 0
    while True:
        path[count, 0] = row
        path[count, 1] = column
        count += 1
        if row == 0 and column == 0:
            return count
        move = step[row, column]
        if move != HORIZONTAL:
            row -= 1
        if move != VERTICAL:
            column -= 1
