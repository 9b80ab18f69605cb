# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Gray area averages of images: the numbers of OpenCV's ``INTER_AREA``, in one pass.

A pixel of the result is the sum over the rows that it covers of the sums over their columns, in
float32, in the order of OpenCV, rounded to the nearest gray level. LANES rows are summed at once,
from gray levels in columns, so that neighboring pixels of a cell need no gathers.
"""

from functools import cache
import math

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.simd import (
    bits,
    from_bits,
    LANES,
    load,
    load_splat,
    load_thirds,
    splat,
    store,
    store_bytes,
    transpose,
)

F = np.float32
INT = np.int32
RED, GREEN, BLUE, HALF, UNIT = INT(9798), INT(19235), INT(3735), INT(2**14), F(2**-15)  # as OpenCV
LEVELS = INT(-(2**15))  # bits of a gray level over UNIT
MAGIC, TWO_23 = INT(0x4B000000), F(2**23)  # bits of 2^23, whose last one counts 1
MIN_SHARE = 1e-3  # smallest part of a pixel that counts at the end of a cell


@cache
def cells(length: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the pixels of each of ``size`` cells along an axis.

    :param length: pixels of the axis, at least ``size``.
    :returns: the first pixel of each, (size,), int32, and the weights of it and the following
        ones, (size, K), float32.
    """
    scale = length / size
    firsts, rows = np.empty(size, np.int32), []
    for i in range(size):
        begin = i * scale
        end, width = begin + scale, min(scale, length - begin)
        last = min(math.floor(end), length - 1)
        firsts[i] = first = min(math.ceil(begin), last)
        weights = [1 / width] * (last - first)
        if first - begin > MIN_SHARE:
            firsts[i] -= 1
            weights.insert(0, (first - begin) / width)
        if end - last > MIN_SHARE:
            weights.append(min(end - last, 1.0, width) / width)
        rows.append(weights)
    table = np.zeros((size, max(map(len, rows))), np.float32)
    for i, weights in enumerate(rows):
        table[i, : len(weights)] = weights
    return firsts, table


@kernel
def shrink(
    image: np.ndarray, firsts: np.ndarray, weights: np.ndarray, row_firsts: np.ndarray,
    row_weights: np.ndarray, table: np.ndarray, padded: np.ndarray,
) -> None:  # fmt: skip
    """
    Write an image in gray, averaged over cells, with a border equal to its neighbors.

    :param image: RGB, shape (h, w, 3), uint8, of at least LANES columns.
    :param firsts, weights, row_firsts, row_weights: :func:`cells` of the columns and the rows.
    :param table: new gray level of each, (256,), uint8.
    :param padded: shape (size + 2, size + 2), uint8, written.
    """
    size, height, width, count = len(firsts), *image.shape[:2], weights.shape[1]
    columns, square = np.zeros((width + count) * LANES, F), np.empty(LANES * LANES, F)
    sums, lines = np.zeros((size + LANES) * LANES, F), np.empty((LANES, size + LANES), F)
    total, levels = np.empty(size + LANES, F), np.empty(size + LANES, np.uint8)
    first = -LANES  # number of the first row in lines
    for y in range(size):
        total[:] = 0
        for t in range(row_weights.shape[1]):
            weight, row = row_weights[y, t], row_firsts[y] + t
            if weight == 0:
                continue
            while row >= first + LANES:
                first += LANES
                _to_gray(image.reshape(-1), first, height, width, square, columns)
                _add_pixels(columns, firsts, weights, sums, lines)
            line = lines[row - first]
            for x in range(size):
                total[x] += line[x] * weight
        for x in range(0, size, LANES):
            store_bytes(levels, x, bits(load(total, x) + splat(TWO_23)))
        for x in range(size):
            padded[y + 1, x + 1] = table[levels[x]]
        padded[y + 1, 0], padded[y + 1, size + 1] = padded[y + 1, 1], padded[y + 1, size]
    for x in range(size + 2):
        padded[0, x], padded[size + 1, x] = padded[1, x], padded[size, x]


@kernel
def _to_gray(
    image: np.ndarray, first: int, height: int, width: int, square: np.ndarray, columns: np.ndarray
) -> None:
    """Write gray levels, rounded, of LANES rows from ``first`` on, column by column."""
    for x in range(0, width, LANES):
        at = min(x, width - LANES)
        for row in range(LANES):
            pixel = min(first + row, height - 1) * width + at
            r, g, b = load_thirds(image, 3 * pixel)
            total = r * splat(RED) + g * splat(GREEN) + b * splat(BLUE) + splat(HALF)
            whole = from_bits((total & splat(LEVELS)) | splat(MAGIC)) - splat(TWO_23)
            store(square, row * LANES, whole * splat(UNIT))
        transpose(square, 0, LANES, columns, at * LANES, LANES)


@kernel
def _add_pixels(
    columns: np.ndarray, firsts: np.ndarray, weights: np.ndarray, sums: np.ndarray,
    lines: np.ndarray,
) -> None:  # fmt: skip
    """Write the sums of the pixels of each cell, in order, of LANES rows."""
    flat, count = weights.reshape(-1), weights.shape[1]
    for x in range(len(firsts)):
        total = splat(F(0))
        for k in range(count):
            total = total + load(columns, (firsts[x] + k) * LANES) * load_splat(
                flat, x * count + k
            )
        store(sums, x * LANES, total)
    for x in range(0, len(firsts), LANES):
        transpose(sums, x * LANES, LANES, lines.reshape(-1), x, lines.shape[1])
