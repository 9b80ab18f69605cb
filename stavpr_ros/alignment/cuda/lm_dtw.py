# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
LM-DTW with one thread for each start, and the choice of the best start, in one launch (section 4).

A thread sweeps the k columns of its start, each from the window's first row to its last,
with S and C of the column before in registers: l is a constant of the compiled kernel and the loop
over the rows is unrolled. All starts of a block share the window's columns through shared memory,
read once, and neighboring threads read neighboring words. A cell has the three sums of the CPU
twin, compared in another order: first the diagonal against the horizontal one, neither of which
waits for the cell above, then the better of them against the vertical one. Only one addition and
one comparison are left down a column.

Windows of more than ``REGISTER_ROWS`` rows do not fit into the registers: there S and C are arrays
in local memory, and the window is read through the caches. The same kernel, slower.
"""

import functools
from typing import Any

from numba import cuda, float32, int32
import numpy as np
from stavpr_ros.alignment.cuda.compilation import device_function, kernel

BLOCK = 128  # starts of one block; a power of 2
REGISTER_ROWS = (
    76  # longest window whose state the compiler keeps in registers: 2 l of them and more
)
SHARED_BYTES = 46 * 1024  # for the window's columns, of the 48 KiB that every device has

ZERO, ONE, INF = np.float32(0), np.float32(1), np.float32(np.inf)
NONE = np.int32(2**31 - 1)  # no start, behind every other


def row_pitch(n: int, k: int, block: int) -> int:
    """Words from row to row of the window: blocks of starts, and the columns of the last."""
    return -(-(-(-n // block) * block + k - 1) // 32) * 32


@device_function
def _smallest(distance, start, distances, starts):
    """Reduce the block to its smallest distance and lowest start, first in shared memory."""
    t = cuda.threadIdx.x
    cuda.syncthreads()
    distances[t] = distance
    starts[t] = start
    half = cuda.blockDim.x >> 1
    while half > 0:
        cuda.syncthreads()
        if t < half:
            other = distances[t + half]
            if other < distances[t] or (other == distances[t] and starts[t + half] < starts[t]):
                distances[t] = other
                starts[t] = starts[t + half]
        half >>= 1
    cuda.syncthreads()


@device_function
def _nearest(block_best, block_start, distances, starts):
    """Find the nearest start of all blocks, by the threads of one."""
    best, start = INF, NONE
    for b in range(cuda.threadIdx.x, cuda.gridDim.x, cuda.blockDim.x):
        if block_best[b] < best:  # blocks come in rising order: the lowest start wins a tie
            best, start = block_best[b], block_start[b]
    _smallest(best, start, distances, starts)


@device_function
def _runner_up(
    middle, apart, k, best_of_start, length_of_start, block_best, block_start, distances, starts
):
    """
    Find the nearest start whose midpoint is more than ``apart`` places from ``middle``.

    A midpoint lies in s .. s + k - 1. Blocks of which every start is far enough answer with their
    best one; only in the others, a narrow range, each start is looked at.
    """
    t, threads = cuda.threadIdx.x, cuda.blockDim.x
    n = length_of_start.shape[0]
    low = max(0, middle - apart - k) // threads
    high = min(n - 1, middle + apart) // threads + 1
    best, start = INF, NONE
    for b in range(t, cuda.gridDim.x, threads):
        if (b < low or b >= high) and block_best[b] < best:
            best, start = block_best[b], block_start[b]
    for s in range(low * threads + t, min(n, high * threads), threads):
        far = abs(((2 * s + length_of_start[s] - 1) >> 1) - middle) > apart
        q = best_of_start[s]
        if far and (q < best or (q == best and s < start)):
            best, start = q, int32(s)
    _smallest(best, start, distances, starts)


@device_function
def _last_block(best, start, block_best, block_start, finished, distances, starts):
    """
    Reduce the block; return in all its threads whether it is the last one to arrive.

    What the other blocks wrote is visible to the last one: their fences come before their tickets,
    and its own comes after its ticket.
    """
    t = cuda.threadIdx.x
    _smallest(best, start, distances, starts)
    if t == 0:
        block_best[cuda.blockIdx.x] = distances[0]
        block_start[cuda.blockIdx.x] = starts[0]
    cuda.threadfence()
    cuda.syncthreads()
    if t == 0:
        starts[0] = cuda.atomic.add(finished, 0, 1)
    cuda.syncthreads()
    last = starts[0] == cuda.gridDim.x - 1
    cuda.threadfence()
    return last


def _select(l: int, k: int) -> Any:
    """Compile what the last block does: the choice, and the window's cells for the path."""

    def select(
        rows,
        first,
        apart,
        best_of_start,
        length_of_start,
        block_best,
        block_start,
        places,
        answer,
        distances,
        starts,
    ):
        t = cuda.threadIdx.x
        _nearest(block_best, block_start, distances, starts)
        nearest = starts[0]
        if t == 0:
            places[0], places[2] = int32(-1), int32(-1)
            answer[0], answer[1] = distances[0], INF
        if nearest != NONE:
            m = length_of_start[nearest]
            middle = (2 * nearest + m - 1) >> 1
            _runner_up(
                middle,
                apart,
                k,
                best_of_start,
                length_of_start,
                block_best,
                block_start,
                distances,
                starts,
            )
            if t == 0:
                places[0], places[1] = nearest, m
                if distances[0] < INF:
                    places[2], places[3] = starts[0], length_of_start[starts[0]]
                    answer[1] = distances[0]
            for i in range(l):
                for x in range(t, k, cuda.blockDim.x):
                    answer[2 + i * k + x] = rows[first + i, nearest + x]

    return device_function(select)


def _stage(l: int, block: int, pitch: int) -> Any:
    """Compile the load of ``pitch`` columns at most into shared memory, by a whole block."""

    def stage(rows, first, left, words, tile):
        cuda.syncthreads()
        for i in range(l):
            for c in range(0, pitch, block):
                column = c + cuda.threadIdx.x
                if column < words:
                    tile[i, column] = rows[first + i, left + column]
        cuda.syncthreads()

    return device_function(stage)


def _sweep(l: int) -> Any:
    """Compile one column, from the first row to the last: S and C come in of the column before."""

    def sweep(cells, row, column, x, S, C):
        S_corner, C_corner = S[0], C[0]
        S[0] = cells[row, column] + (S[0] if x > 0 else ZERO)
        C[0] = C[0] + ONE
        for i in range(1, l):
            d = cells[row + i, column]
            vertical, horizontal, diagonal = d + S[i - 1], d + S[i], d + S_corner
            # the diagonal only if strictly smallest; vertical wins a tie over horizontal
            aside = diagonal if diagonal < horizontal else horizontal
            cost = C_corner if diagonal < horizontal else C[i]
            S_corner, C_corner = S[i], C[i]
            S[i] = aside if aside < vertical else vertical
            C[i] = (cost if aside < vertical else C[i - 1]) + ONE

    return device_function(sweep)


def staged_columns(l: int, k: int, block: int) -> int:
    """Return the columns between two loads of shared memory; 0: the window is not staged."""
    return min(k, SHARED_BYTES // (4 * l) - block + 1) if l <= REGISTER_ROWS else 0


@functools.cache
def lm_dtw(l: int, k: int, block: int, columns: int | None = None) -> Any:
    """
    Compile LM-DTW with the choice of the nearest start and its second best.

    The grid is (blocks of starts, 1); every block has ``block`` threads. The kernel's arguments:

    - ``rows``: image distances, shape (at least first + l, row_pitch(n, k, block)), float32, +inf
    from column n on; the window is the l rows from ``first``, oldest first. - ``apart``: the
    second best's midpoint is more than so many places from the nearest one's. - ``best_of_start``,
    ``length_of_start``: q_m and m of each start, shape (n,), float32 and int32, written; +inf and
    0 where no path is finite. - ``block_best``, ``block_start``: for the kernel's own use, shape
    (blocks,), float32 and int32. - ``finished``: shape (1,), int32, 0 before the first launch;
    every launch leaves 0. - ``places``: shape (4,), int32, written: the nearest start and its m,
    the second best's start and its m; start -1 for none. - ``answer``: shape (2 + l k,), float32,
    written: the distances of both (+inf for none), and the l x k cells of the window that the
    nearest start searches.

    :param l: rows of the window.
    :param k: columns that one start searches.
    :param block: threads of one block, a power of 2.
    :param columns: columns staged at once, 0 for none; None for :func:`staged_columns`.
    """
    columns = staged_columns(l, k, block) if columns is None else columns
    staged = columns > 0
    columns = columns if staged else k
    pitch = block + columns - 1
    tile_shape = (l, pitch) if staged else (1, 1)
    stage, sweep, select = _stage(l, block, pitch), _sweep(l), _select(l, k)

    def sequences(
        rows,
        first,
        apart,
        best_of_start,
        length_of_start,
        block_best,
        block_start,
        finished,
        places,
        answer,
    ):
        t, left = cuda.threadIdx.x, cuda.blockIdx.x * block
        start, n = left + t, length_of_start.shape[0]
        tile = cuda.shared.array(tile_shape, float32)
        distances = cuda.shared.array(block, float32)
        starts = cuda.shared.array(block, int32)
        S = cuda.local.array(l, float32)
        C = cuda.local.array(l, float32)
        for i in range(l):
            S[i] = INF
            C[i] = ZERO
        best, length = INF, 0
        for x0 in range(0, k, columns):
            width = min(columns, k - x0)
            if staged:
                stage(rows, first, left + x0, block + width - 1, tile)
            for x in range(x0, x0 + width):
                if staged:
                    sweep(tile, 0, t + x - x0, x, S, C)
                else:
                    sweep(rows, first, start + x, x, S, C)
                q = S[l - 1] / C[l - 1]
                if q < best:
                    best, length = q, x + 1
        if start < n:
            best_of_start[start] = best
            length_of_start[start] = length
        if _last_block(best, int32(start), block_best, block_start, finished, distances, starts):
            select(
                rows, first, apart, best_of_start, length_of_start, block_best, block_start,
                places, answer, distances, starts,
            )  # fmt: skip
            if t == 0:
                finished[0] = 0

    return kernel(sequences)
