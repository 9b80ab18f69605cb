# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The distance of two images from the products of their strips, one thread for each pair (section 2).

The strip distances d = 1 - product are made here, so that the products are read once and never
rewritten. A thread goes through the W x W cells row by row with S and C of one row in registers: W
and the band are constants of the compiled kernel, every loop is unrolled. Neighboring threads read
neighboring places.
"""

import functools
import math
from typing import Any

from numba import cuda, float32
import numpy as np
from stavpr_ros.alignment.cuda.compilation import kernel, multiply

BLOCK = 128  # threads of one block

ONE, INF = np.float32(1), np.float32(np.inf)


@functools.cache
def spatial_dtw(W: int, xi: int) -> Any:
    """
    Compile the DTW of two images.

    The kernel's grid is (blocks over the places, queries).

    - ``products``: similarities, shape (queries W, W, places), float32, of any strides; [q W + i,
    j, y] is strip i of query q against strip j of place y. Cells outside the band are not read. -
    ``sigma``: float32, 0 for vanilla DTW. - ``first_query``, ``first_place``: where these are in
    ``out``. - ``out``: image distances, shape (all queries, all places), float32, written.

    :param W: number of strips.
    :param xi: half width of the band, W for none.
    """
    times = multiply()
    c = (W + 1) // 2 - 1  # the central strip, ceil(W / 2), 0-based
    low, high = max(0, c - xi + 1), min(W, c + xi)

    def spatial(products, sigma, first_query, first_place, out):
        y = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
        if y >= products.shape[2]:
            return
        query = cuda.blockIdx.y
        top = query * W
        nearest, apart = INF, 0
        for j in range(low, high):
            d = ONE - products[top + c, j, y]
            if d < nearest:
                nearest, apart = d, abs(j - c)
        a = float32(math.sqrt(ONE + times(sigma, float32(apart))))

        S = cuda.local.array(W, float32)
        C = cuda.local.array(W, float32)
        for j in range(W):
            S[j] = INF
            C[j] = ONE
        for i in range(W):
            # S and C of the cell to the left, and of the one above that
            S_left, C_left, S_corner, C_corner = INF, ONE, INF, ONE
            for j in range(W):
                S_above, C_above = S[j], C[j]
                if abs(i - j) >= xi:
                    S[j] = INF
                elif i == 0 and j == 0:
                    S[j] = ONE - products[top, 0, y]
                else:
                    d = ONE - products[top + i, j, y]
                    vertical, horizontal, diagonal = (
                        d + S_above,
                        d + S_left,
                        times(a, d) + S_corner,
                    )
                    straight = horizontal if horizontal < vertical else vertical
                    cost = (C_left if horizontal < vertical else C_above) + ONE
                    C[j] = C_corner + a if diagonal < straight else cost
                    S[j] = diagonal if diagonal < straight else straight
                S_left, C_left, S_corner, C_corner = S[j], C[j], S_above, C_above
        out[first_query + query, first_place + y] = S[W - 1] / C[W - 1]

    return kernel(spatial)


@functools.cache
def sliding_window(W: int, width: int, xi: int) -> Any:
    """
    Compile the smallest mean of ``width`` diagonal cells; windows outside the band are left out.

    The arguments of the kernel are those of :func:`spatial_dtw`, of which ``sigma`` is not used.
    """
    windows = W - width + 1

    def sliding(products, sigma, first_query, first_place, out):
        y = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
        if y >= products.shape[2]:
            return
        query = cuda.blockIdx.y
        top = query * W
        best = INF
        for p in range(windows):
            for q in range(windows):
                if abs(p - q) < xi:
                    total = ONE - products[top + p, q, y]
                    for t in range(1, width):
                        total += ONE - products[top + p + t, q + t, y]
                    mean = total / float32(width)
                    best = mean if mean < best else best
        out[first_query + query, first_place + y] = best

    return kernel(sliding)
