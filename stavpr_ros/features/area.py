# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Gray area averages of images: the numbers of OpenCV's ``INTER_AREA``, in one pass.

A pixel of the result is the sum over the rows that it covers of the sums over their columns, in
float32, in the order of OpenCV, rounded to the nearest gray level.
"""

from functools import cache
import math

import numpy as np
from stavpr_ros.compilation import kernel

F = np.float32
RED, GREEN, BLUE, HALF, UNIT = F(9798), F(19235), F(3735), F(2**14), F(2**-15)  # as in OpenCV
UNROLLED = 4  # pixels of a cell that are added at a time
MIN_SHARE = 1e-3  # of a pixel at the end of a cell; smaller ones do not count


@cache
def cells(length: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the pixels of each of ``size`` cells along an axis.

    :param length: pixels of the axis, at least ``size``.
    :returns: the first pixel of each, (size,), int32, and the weights of it and the following
        ones, (size, K), float32, K a multiple of UNROLLED.
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
    count = max(map(len, rows))
    table = np.zeros((size, -(-count // UNROLLED) * UNROLLED), np.float32)
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

    :param image: RGB, shape (h, w, 3), uint8.
    :param firsts, weights, row_firsts, row_weights: of :func:`cells`, of the columns and the rows.
    :param table: new gray level of each, (256,), uint8.
    :param padded: shape (size + 2, size + 2), uint8, written.
    """
    size, width, count = len(firsts), image.shape[1], weights.shape[1]
    gray, line = np.zeros(width + count, F), np.empty(size, F)
    total, summed = np.empty(size, F), -1
    for y in range(size):
        total[:] = 0
        for t in range(row_weights.shape[1]):
            weight, row = row_weights[y, t], row_firsts[y] + t
            if weight == 0:
                continue
            if row != summed:  # else it is the last row of the cell before, too
                _to_gray(image[row].reshape(-1), width, gray)
                line[:] = 0
                for k in range(0, count, UNROLLED):
                    _add_pixels(gray[k:], firsts, weights[:, k : k + UNROLLED], line)
                summed = row
            for x in range(size):
                total[x] += line[x] * weight
        for x in range(size):
            padded[y + 1, x + 1] = table[np.uint8(min(np.rint(total[x]), F(255)))]
        padded[y + 1, 0], padded[y + 1, size + 1] = padded[y + 1, 1], padded[y + 1, size]
    padded[0], padded[size + 1] = padded[1], padded[size]


@kernel
def _to_gray(row: np.ndarray, width: int, gray: np.ndarray) -> None:
    """Write gray levels, rounded; the sums are whole numbers below 2^24, exact in float32."""
    for x in range(width):
        total = F(row[3 * x]) * RED + F(row[3 * x + 1]) * GREEN + F(row[3 * x + 2]) * BLUE + HALF
        gray[x] = np.floor(total * UNIT)


@kernel
def _add_pixels(
    gray: np.ndarray, firsts: np.ndarray, weights: np.ndarray, line: np.ndarray
) -> None:
    """Add ``UNROLLED`` pixels of each cell to its sum, in order."""
    for x in range(len(line)):
        at, total = firsts[x], line[x]
        for k in range(UNROLLED):
            total += gray[at + k] * weights[x, k]
        line[x] = total
