# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The place filter on a CUDA device, one thread for each place: see recognition.place_filter.

An image takes two kernels: ``mix`` changes level and speed of the states, ``move`` moves them on
and weighs them by the image. Where a state came from in speed is kept beside it, in ``codes``.
"""

import functools
import math
from typing import Any

from numba import cuda, float32, int32, uint8
import numpy as np
from stavpr_ros.alignment.cuda.compilation import kernel

BLOCK = 128  # threads of one block
ENTERED = 9  # as in recognition.filter_paths

ZERO, ONE, TWO, HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
LEAST, MOST, GAP = np.float32(-87), np.float32(80), np.float32(-1e30)


@functools.cache
def mix(K: int, V: int) -> Any:
    """
    Compile the change of level and speed, for K levels and V speeds.

    - ``n``: places; of the tables below, columns from it on are neither read nor written.
    - ``states``: (K V, room), float32.
    - ``levels``: factors by the level before and after, (K, K).
    - ``speeds``: factors of the speed to stay, of the one below, of the one above, after any, and
      of any before, (5, V).
    - ``mixed``: (K V, room), written.
    - ``codes``: (K V, room), uint8, written: 0 the speed was the same, 1 the one below, 2 the one
      above.
    """

    def mix_states(n, states, levels, speeds, mixed, codes):
        y = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
        if y >= n:
            return
        b = cuda.local.array(V, float32)
        for k in range(K):
            anywhere = ZERO
            for v in range(V):
                state = ZERO
                for j in range(K):
                    if abs(j - k) < 2:
                        state += levels[j, k] * states[j * V + v, y]
                b[v] = state
                anywhere += state * speeds[4, v]
            for v in range(V):
                same = b[v] * speeds[0, v]
                lower = b[v - 1] * speeds[1, v] if v > 0 else ZERO
                upper = b[v + 1] * speeds[2, v] if v < V - 1 else ZERO
                most, code = same, uint8(0)
                if same < lower:
                    most, code = lower, uint8(1)
                if most < upper:
                    code = uint8(2)
                mixed[k * V + v, y] = (same + lower) + (upper + anywhere * speeds[3, v])
                codes[k * V + v, y] = code

    return kernel(mix_states)


@functools.cache
def move(K: int, V: int) -> Any:
    """
    Compile the motion and the evidence; the grid covers the places and ``reach`` more.

    - ``n``, ``mixed``, ``codes``: of :func:`mix`.
    - ``z``: (room,), float32; -inf in a gap.
    - ``steps``: places that each speed moves on, (V,), int32.
    - ``levels``: mean z of right places, (K,).
    - ``weight``, ``spread``, ``stay``: alpha, probability of one place more or less, of staying on
      the map.
    - ``entering``: (K,).
    - ``states``: (K V, room), written.
    - ``origins``: of this image, (K (V + 1) // 2, room), uint8, written.
    - ``sums``: (2 K, room + reach), written: of a place's states of each level, and of what
      arrives in gaps and beyond the map's end.
    """
    halves = (V + 1) // 2

    def move_states(
        n, mixed, codes, z, steps, levels, weight, spread, stay, entering, states, origins, sums
    ):
        y = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
        if y >= sums.shape[1]:
            return
        outside = y >= n or z[min(y, n - 1)] < GAP
        center = ONE - TWO * spread
        for k in range(K):
            likelihood = ONE
            if not outside and weight > ZERO:
                off = weight * (levels[k] * z[y] - levels[k] * levels[k] * HALF)
                likelihood = ZERO if off < LEAST else float32(math.exp(min(off, MOST)))
            total, lost, packed = ZERO, ZERO, int32(0)
            for v in range(V):
                row, at = k * V + v, y - steps[v]
                slow = at + 1 if steps[v] > 0 else at
                straight = center * mixed[row, at] if 0 <= at < n else ZERO
                faster = spread * mixed[row, at - 1] if 1 <= at < n + 1 else ZERO
                slower = spread * mixed[row, slow] if 0 <= slow < n else ZERO
                arrived = straight + faster + slower
                if outside:
                    lost += arrived
                    if y < n:
                        states[row, y] = ZERO
                        origins[k * halves + v // 2, y] = uint8(ENTERED | ENTERED << 4)
                    continue
                arrived *= stay
                state = (arrived + entering[k]) * likelihood
                states[row, y] = state
                total += state
                code, origin = int32(0), at
                most = straight
                if straight < faster:
                    most, code, origin = faster, int32(3), at - 1
                if most < slower:
                    code, origin = int32(6), slow
                if not entering[k] < arrived:
                    code = int32(ENTERED)
                else:
                    code += int32(codes[row, origin])
                packed = packed | code << 4 if v % 2 else code
                origins[k * halves + v // 2, y] = uint8(packed)
            sums[k, y] = total
            sums[K + k, y] = lost

    return kernel(move_states)


@functools.cache
def trace(K: int, V: int) -> Any:
    """
    Compile the backtracking of the states of places, one thread a state.

    - ``tops``: places, (m,), int64.
    - ``states``: (K V, room).
    - ``origins``: ring of the latest images', (L, K (V + 1) // 2, room), uint8.
    - ``steps``: ring of their steps, (L, V), int32.
    - ``newest``: slot of the newest.
    - ``probabilities``: (m K V,), written: the states.
    - ``paths``: (L + 1, m K V), int32, written: 16 times the place of each image, newest first,
      plus the speed; -1 before the path entered the map.
    """
    halves = (V + 1) // 2

    def trace_states(tops, states, origins, steps, newest, probabilities, paths):
        i = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
        if i >= paths.shape[1]:
            return
        y, row = tops[i // (K * V)], i % (K * V)
        k, v, length = row // V, row % V, origins.shape[0]
        probabilities[i] = states[row, y]
        paths[0, i] = 16 * y + v
        on = True
        for image in range(length):
            slot = (newest - image + length) % length
            origin = ENTERED
            if on:
                origin = (origins[slot, k * halves + v // 2, y] >> (v % 2 * 4)) & 15
            if origin == ENTERED:
                on = False
                paths[image + 1, i] = -1
                continue
            step = origin // 3
            r = steps[slot, v]
            if step == 0:
                y -= r
            elif step == 1:
                y -= r + 1
            elif r > 0:
                y -= r - 1
            if origin % 3 == 1:
                v -= 1
            elif origin % 3 == 2:
                v += 1
            paths[image + 1, i] = 16 * y + v

    return kernel(trace_states)
