# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A window against the map at several speeds: one pass over the map for each, all places at once.

The recursion runs along the rows of the window, place beside place on the lanes; every place is the end of
a path, which carries where it came from. A thread takes a block of ends and what lies within reach of it.
"""

import numba as nb
import numpy as np
from stavpr_ros.alignment.cpu.simd import LANES, load, select, splat, store
from stavpr_ros.compilation import kernel, parallel_kernel

ENDS = 1024  # ends that a thread takes at a time; a multiple of LANES


@kernel
def _copy_costs(D, shift, scale, low, costs):
    """Copy (D - shift) * scale of the places from ``low`` into costs (l, width); +inf outside the map."""
    n, width = shift.shape[0], costs.shape[1]
    costs[:] = np.inf
    first, last = max(low, 0), min(low + width, n)
    for i in range(costs.shape[0]):
        row, source = costs[i], D[i]
        for y in range(first, last):
            row[y - low] = (source[y] - shift[y]) * scale[y]


@kernel
def _nearer(S, first, middle, S_old, first_old, middle_old, at, extra):
    """The better of a path so far and one that comes from ``at`` at an extra cost."""
    other = load(S_old, at) + extra
    better = other < S
    return (
        select(better, other, S),
        select(better, load(first_old, at), first),
        select(better, load(middle_old, at), middle),
    )


@kernel
def _advance(row, step, penalty, guard, here, there, marks):
    """
    Advance all paths by one row of costs.

    A path moves on by ``step`` places, or at a cost by one more or one less, never back.

    :param row: costs (width,).
    :param guard: places before the first one, unreachable; at least step + 1.
    :param here, there: paths before and after: S, first and middle, each (guard + width,).
    :param marks: this is the middle row.
    """
    S_old, first_old, middle_old = here
    S_new, first_new, middle_new = there
    extra = splat(penalty)
    for y in range(0, row.shape[0], LANES):
        at = guard + y - step
        S, first, middle = load(S_old, at), load(first_old, at), load(middle_old, at)
        if step > 0:
            S, first, middle = _nearer(
                S, first, middle, S_old, first_old, middle_old, at + 1, extra
            )
        S, first, middle = _nearer(S, first, middle, S_old, first_old, middle_old, at - 1, extra)
        store(S_new, guard + y, load(row, y) + S)
        store(first_new, guard + y, first)
        store(middle_new, guard + y, middle)
    if marks:
        for y in range(row.shape[0]):
            middle_new[guard + y] = y


@kernel
def _new_paths(width, guard, dtype):
    S = np.full(guard + width, dtype.type(np.inf), dtype)
    return S, np.zeros(guard + width, np.int32), np.zeros(guard + width, np.int32)


@parallel_kernel
def match_at_velocities(D, shift, scale, steps, penalty, distances, firsts, middles, speeds):
    """
    The best path to every end.

    :param D: window, shape (l, n or more), row = query image, oldest first; +inf bans a pair.
    :param shift, scale: the costs are (D - shift) * scale, shape (n,).
    :param steps: places that each speed moves on before each row, shape (V, l), int32; steps[:, 0] = 0.
    :param penalty: cost of one place more or less, of D's type.
    :param distances, firsts, middles, speeds: shape (n,), written: mean cost of a row, penalties included,
        the place of the first and of the middle row, the speed; int32. +inf where there is no path.
    """
    n, (V, l) = shift.shape[0], steps.shape
    reach, longest = 0, 0
    for v in range(V):
        reach = max(reach, steps[v].sum() + l - 1)
        longest = max(longest, steps[v].max())
    reach = (reach + LANES - 1) // LANES * LANES
    guard = longest + 1
    for block in nb.prange((n + ENDS - 1) // ENDS):
        low = block * ENDS - reach
        count = min(ENDS, n - block * ENDS)
        width = reach + (count + LANES - 1) // LANES * LANES
        costs = np.empty((l, width), D.dtype)
        _copy_costs(D, shift, scale, low, costs)
        here, there = _new_paths(width, guard, D.dtype), _new_paths(width, guard, D.dtype)
        ends = slice(block * ENDS, block * ENDS + count)
        distances[ends] = np.inf
        for v in range(V):
            here[0][guard:] = costs[0]
            for y in range(width):
                here[1][guard + y] = y
                here[2][guard + y] = y
            for i in range(1, l):
                _advance(costs[i], steps[v, i], penalty, guard, here, there, i == (l - 1) // 2)
                here, there = there, here
            for y in range(count):
                distance = here[0][guard + reach + y] / D.dtype.type(l)
                if distance < distances[block * ENDS + y]:
                    distances[block * ENDS + y] = distance
                    firsts[block * ENDS + y] = low + here[1][guard + reach + y]
                    middles[block * ENDS + y] = low + here[2][guard + reach + y]
                    speeds[block * ENDS + y] = v


@kernel
def trace_at_velocity(costs, steps, penalty, path):
    """
    Follow the best path back from the last column of the last row.

    :param costs: shape (l, m); steps: shape (l,).
    :param path: shape (l, 2), written: row, column.
    :returns: the sum of its costs, penalties included; +inf if there is none.
    """
    l, m = costs.shape
    S = np.full((l, m), np.inf, costs.dtype)
    origin = np.zeros((l, m), np.int32)
    S[0] = costs[0]
    for i in range(1, l):
        for y in range(m):
            best = costs.dtype.type(np.inf)
            for change in (0, -1, 1):
                moved = steps[i] + change
                if moved < 0 or moved > y:
                    continue
                S_other = S[i - 1, y - moved] + (penalty if change != 0 else costs.dtype.type(0))
                if S_other < best:
                    best = S_other
                    origin[i, y] = y - moved
            S[i, y] = costs[i, y] + best
    y = m - 1
    for i in range(l - 1, -1, -1):
        path[i, 0], path[i, 1] = i, y
        y = origin[i, y]
    return S[l - 1, m - 1]


@kernel
def nearest_end_elsewhere(distances, middles, middle, nms_radius):
    """Return the nearest end whose path's middle is not near ``middle``; -1 if there is none."""
    best, end = np.inf, -1
    for y in range(distances.shape[0]):
        if distances[y] < best and abs(middles[y] - middle) > nms_radius:
            best, end = distances[y], y
    return end
