# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The cosine distances of one image's strips to all strips of the map.

A map's features are read once, a block of images at a time, and stay in the cache until the
block's images are aligned: one frame costs little more than reading the map. In int8 that is a
quarter (:mod:`stavpr_ros.alignment.cpu.int8`).
"""

import numba as nb
from numba.core import types
from numba.extending import overload
import numpy as np
from stavpr_ros.alignment.cpu import int8
from stavpr_ros.alignment.cpu.dtw import align_lanes, shift_lanes, SLOT
from stavpr_ros.alignment.cpu.int8 import NEAR, TILE
from stavpr_ros.compilation import kernel, parallel_kernel, reassociating_kernel
from stavpr_ros.memory import aligned_zeros
from stavpr_ros.simd import (
    add_products,
    LANES,
    LINE,
    load,
    prefetch,
    splat,
    store,
    store_sums,
)

IMAGES = 256  # map images a thread takes at a time; a multiple of LANES
AHEAD = 2048  # numbers of the map that are on their way to the cache
FEW_IMAGES = 64  # map images likewise, where the distances of all cells are kept


def tile(queries: np.ndarray) -> np.ndarray:
    """
    Lay out the local features of Q images as the kernels of the CPU want them.

    :param queries: shape (W, Q, d), float32.
    :returns: shape (Q, R, d), R is W rounded up to whole tiles; zeros from row W on.
    """
    W, Q, d = queries.shape
    rows = aligned_zeros((Q, -(-W // TILE) * TILE, d))  # products are a third faster
    rows[:, :W] = queries.transpose(1, 0, 2)
    return rows


@reassociating_kernel
def _dots(y, q, sums):
    """Multiply one map strip (d,) by TILE query strips (TILE, d)."""
    q0, q1, q2, q3, q4, q5, q6 = q[0], q[1], q[2], q[3], q[4], q[5], q[6]
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = np.float32(0)
    for t in range(y.shape[0]):
        value = y[t]
        s0 += q0[t] * value
        s1 += q1[t] * value
        s2 += q2[t] * value
        s3 += q3[t] * value
        s4 += q4[t] * value
        s5 += q5[t] * value
        s6 += q6[t] * value
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6] = s0, s1, s2, s3, s4, s5, s6


@kernel
def _dots_of_two(y, z, query, base, zeros, sums):
    """
    Multiply two map strips (d,) by as many query strips, from ``base``, as there are zeros.

    With TILE they take 31 of 32 registers. The order of the sums is LLVM's in :func:`_dots`: even
    and odd vectors apart.

    :param sums: (2 LANES,), written: of y, and from LANES on, of z; d is a multiple of LANES.
    """
    even_y = even_z = odd_y = odd_z = zeros
    d = y.shape[0]
    for t in range(0, d, 2 * LANES):
        u = t + LANES
        for strip in (y, z):  # processors stop at a page's end
            prefetch(strip, t + AHEAD)
            prefetch(strip, u + AHEAD)
        even_y = add_products(even_y, query, base + t, d, load(y, t))
        even_z = add_products(even_z, query, base + t, d, load(z, t))
        if u < d:
            odd_y = add_products(odd_y, query, base + u, d, load(y, u))
            odd_z = add_products(odd_z, query, base + u, d, load(z, u))
    store_sums(sums, 0, even_y, odd_y)
    store_sums(sums, LANES, even_z, odd_z)


@reassociating_kernel
def dot_product(y: np.ndarray, q: np.ndarray) -> np.float32:
    """Multiply a vector (d,) by another."""
    total = np.float32(0)
    for t in range(y.shape[0]):
        total += q[t] * y[t]
    return total


@parallel_kernel
def cosine_distances(features, queries, out):
    """
    Distances 1 - <x, y> of images that are one vector each (W = 1).

    :param features: the map's unit-norm vectors, shape (n, d), float32.
    :param queries: unit-norm vectors of Q images, shape (Q, d), float32.
    :param out: shape (Q, m), written; m <= n: only so many map images are looked at.
    """
    n = out.shape[1]
    for block in nb.prange((n + FEW_IMAGES - 1) // FEW_IMAGES):
        first = block * FEW_IMAGES
        for x in range(queries.shape[0]):
            for y in range(first, min(n, first + FEW_IMAGES)):
                out[x, y] = np.float32(1) - dot_product(features[y], queries[x])


def _block_distances(features, queries, x, first, count, xi, d):
    """
    Fill d (rows, W, .): strips of query x against ``count`` map images from ``first``.

    :param xi: only distances of strips i and j with ``|i - j| < xi`` are needed.
    """


@overload(_block_distances)
def _overload_block_distances(features, queries, x, first, count, xi, d):
    if isinstance(features, types.Array):
        return _float_block_distances.py_func
    return int8.block_distances.py_func


@kernel
def _float_block_distances(features, queries, x, first, count, xi, d):
    query, sums, step = queries[x], np.empty(2 * LANES + TILE, np.float32), 1
    flat, D = query.reshape(-1), query.shape[1]
    if LANES == 16 and features.shape[2] % LANES == 0:  # with 32 registers
        step = 2
    zero = splat(np.float32(0))
    few = zero, zero, zero, zero, zero
    for j in range(features.shape[0]):
        low = int8.first_near(j, xi, query.shape[0]) if step == 2 else -1
        for y in range(0, count, step):
            place, other = features[j, first + y], features[j, first + min(y + 1, count - 1)]
            for i in range(max(low, 0), query.shape[0], TILE):
                rows = TILE
                if low >= 0:
                    rows = NEAR
                    _dots_of_two(place, other, flat, i * D, few, sums)
                elif step == 2:
                    _dots_of_two(place, other, flat, i * D, (*few, zero, zero), sums)
                else:
                    for t in range(0, D, LINE):
                        prefetch(place, t + AHEAD)
                    _dots(place, query[i : i + TILE], sums)
                for t in range(rows):
                    d[i + t, j, y] = np.float32(1) - sums[t]
                    if step == 2 and y + 1 < count:
                        d[i + t, j, y + 1] = np.float32(1) - sums[LANES + t]


@parallel_kernel
def strip_distances(features, queries, x, d):
    """
    Distances d[i, j, y] = 1 - <x_i, y_j> of query x.

    :param features: the map's unit-norm local features, shape (W, n, d), float32; or in int8, of
        :meth:`stavpr_ros.alignment.cpu.int8.Int8Strips.kernel_arguments`.
    :param queries: features of Q images, shape (Q, R, d), of :func:`tile`; or in int8, of
        :func:`stavpr_ros.alignment.cpu.int8.tile`.
    :param d: shape (R, W, n), written.
    """
    n = d.shape[2]
    for block in nb.prange((n + IMAGES - 1) // IMAGES):
        first = block * IMAGES
        count = min(IMAGES, n - first)
        part = np.empty((d.shape[0], d.shape[1], IMAGES), np.float32)
        _block_distances(features, queries, x, first, count, d.shape[0], part)
        d[:, :, first : first + count] = part[:, :, :count]


@kernel
def _align_block(features, queries, x, first, count, weights, xi, is_rigid, d, edge, lanes):
    """Write the image distances of query x to ``count`` map images from ``first`` into lanes."""
    W, stride = d.shape[1], d.shape[2]
    _block_distances(features, queries, x, first, count, xi, d)
    for at in range(0, count, LANES):
        if is_rigid:
            distances = shift_lanes(d.reshape(-1), at, W * stride, stride, W, xi)
        else:
            distances = align_lanes(d.reshape(-1), at, W * stride, stride, weights, xi, edge)
        store(lanes, at, distances)


@parallel_kernel
def image_distances(features, queries, weights, xi, is_rigid, out):
    """
    Image distances of Q images to all map images, aligned or shifted, from the features in one go.

    :param features, queries: as in :func:`strip_distances`.
    :param weights, xi, is_rigid: as in :func:`stavpr_ros.alignment.cpu.dtw.spatial_dtw`.
    :param out: shape (Q, m), written; m <= n: only so many map images are looked at.
    """
    W, n = weights.shape[0], out.shape[1]
    for block in nb.prange((n + IMAGES - 1) // IMAGES):
        first = block * IMAGES
        count = min(IMAGES, n - first)
        d = np.empty(((W + TILE - 1) // TILE * TILE, W, IMAGES), np.float32)
        edge = np.empty((W + 1) * SLOT, np.float32)
        lanes = np.empty(IMAGES, np.float32)
        for x in range(out.shape[0]):
            _align_block(features, queries, x, first, count, weights, xi, is_rigid, d, edge, lanes)
            for y in range(count):
                out[x, first + y] = lanes[y]


@parallel_kernel
def vertical_image_distances(features, queries, cell_weights, weights, xi, out):
    """
    Image distances from strip distances that are themselves aligned.

    The distance of two strips is the distance of their cells, aligned from top to bottom.

    :param features: unit-norm cells of the map, shape (W H, n, c), strip by strip, each from the
        top; float32.
    :param queries: cells of Q images, shape (Q, R, c), float32; R is W H rounded up to whole
        TILEs.
    :param cell_weights: a for each ``|I_c - c|`` of the H cells, shape (H,).
    :param weights, xi: of the W strips, as in :func:`image_distances`.
    :param out: shape (Q, n), written.
    """
    rows, n, _ = features.shape
    H, W = cell_weights.shape[0], weights.shape[0]
    for block in nb.prange((n + FEW_IMAGES - 1) // FEW_IMAGES):
        first = block * FEW_IMAGES
        count = min(FEW_IMAGES, n - first)
        d = np.empty((queries.shape[1], rows, FEW_IMAGES), np.float32)
        strips = np.empty((W, W, FEW_IMAGES), np.float32)
        edge = np.empty((max(W, H) + 1) * SLOT, np.float32)
        lanes = np.empty(FEW_IMAGES, np.float32)
        cells, flat = d.reshape(-1), strips.reshape(-1)
        for x in range(queries.shape[0]):
            _block_distances(features, queries, x, first, count, rows, d)
            for at in range(0, count, LANES):
                for i in range(W):
                    for j in range(max(0, i - xi + 1), min(W, i + xi)):
                        corner = (i * H * rows + j * H) * FEW_IMAGES + at
                        distance = align_lanes(
                            cells, corner, rows * FEW_IMAGES, FEW_IMAGES, cell_weights, H, edge
                        )
                        store(flat, (i * W + j) * FEW_IMAGES + at, distance)
                distances = align_lanes(flat, at, W * FEW_IMAGES, FEW_IMAGES, weights, xi, edge)
                store(lanes, at, distances)
            out[x, first : first + count] = lanes[:count]


@reassociating_kernel
def change_between(a: np.ndarray, b: np.ndarray) -> float:
    """Return the change of two images, unit-norm strips (W, d) each; equal where both are zero."""
    total = np.float32(0)
    for j in range(len(a)):
        x, y = a[j], b[j]
        dot, norm = np.float32(0), np.float32(0)
        for t in range(len(x)):
            dot += x[t] * y[t]
            norm += x[t] * x[t] + y[t] * y[t]
        total += dot if norm > 0 else np.float32(1)
    return 1 - total / len(a)  # type: ignore[return-value]
