# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A window against every place of the map at several speeds (beyond the paper).

LM-DTW may let one place absorb a whole window. Here a path holds exactly one place for each query
image, so that no run of cheap pairs can dilute its mean, and keeps close to one of a few speeds
(places an image): a step of one place more or less than the speed's costs a penalty.

    S[i, y] = d[i, y] + min(S[i-1, y-r], S[i-1, y-r+1] + p, S[i-1, y-r-1] + p),   never back
    r = round(v i) - round(v (i-1)),   distance = min over the speeds v of S[l, y] / l

Start and end are free; linear in the number of places, l x V cells for each.
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
from stavpr_ros.alignment.cpu.simd import LANES, load, select, splat, store
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.alignment.settings import VelocitySettings
from stavpr_ros.checks import float_array, no_nan
from stavpr_ros.compilation import kernel, parallel_kernel
from stavpr_ros.errors import InputError

ENDS = 1024  # ends that a thread takes at a time; a multiple of LANES


@dataclass(frozen=True)
class VelocityMatches:
    """
    The best path to each of n places.

    :param distances: mean cost of an image, penalties included, shape (n,); +inf where there is no
        path.
    :param firsts: place of the window's first image, shape (n,), int32.
    :param middles: place of its middle image, (l - 1) // 2, shape (n,), int32.
    :param speeds: index into the settings' speeds, shape (n,), int32.
    """

    distances: np.ndarray
    firsts: np.ndarray
    middles: np.ndarray
    speeds: np.ndarray


def match_velocities(
    window: np.ndarray,
    settings: VelocitySettings,
    shift: np.ndarray | None = None,
    scale: np.ndarray | None = None,
) -> VelocityMatches:
    """
    Find the best path to every place.

    :param window: image distances, shape (l, n), float32 or float64; row = query image, oldest
        first. +inf bans a pair.
    :param shift, scale: the costs are (window - shift) * scale, shape (n,) each; None for 0 and 1.
    :raises InputError: wrong shape or type, NaN.
    """
    D = no_nan(float_array(window, 'image distances', 2), 'image distances')
    l, n = D.shape
    shift = np.zeros(n, D.dtype) if shift is None else np.asarray(shift, D.dtype)
    scale = np.ones(n, D.dtype) if scale is None else np.asarray(scale, D.dtype)
    if l < 1 or shift.shape != (n,) or scale.shape != (n,):
        raise InputError(
            f'window {D.shape}, shift {shift.shape}, scale {scale.shape}: '
            'expected (l, n), (n,), (n,), l >= 1'
        )
    return match_scaled(D, shift, scale, settings.steps(l), settings.penalty)


def match_scaled(
    window: np.ndarray, shift: np.ndarray, scale: np.ndarray, steps: np.ndarray, penalty: float
) -> VelocityMatches:
    """
    Match a window that is known to be good (see :func:`match_velocities`).

    Nothing is checked or copied.

    :param window: shape (l, n or more), C-contiguous.
    :param shift, scale: shape (n,), of the window's type.
    :param steps, penalty: of the :class:`stavpr_ros.alignment.settings.VelocitySettings`.
    """
    n, dtype = len(shift), window.dtype
    matches = VelocityMatches(np.empty(n, dtype), *(np.zeros(n, np.int32) for _ in range(3)))
    match_at_velocities(
        window,
        shift,
        scale,
        steps,
        dtype.type(penalty),
        matches.distances,
        matches.firsts,
        matches.middles,
        matches.speeds,
    )
    return matches


def trace_velocity(costs: np.ndarray, end: int, steps: np.ndarray, penalty: float) -> np.ndarray:
    """
    Return the path to one end at one speed.

    :param costs: shape (l, n), float32 or float64.
    :param end: place of the last image, 0-based.
    :param steps: places that the speed moves on before each image, shape (l,), int32.
    :param penalty: cost of one place more or less.
    :returns: shape (l, 2), int32: query index, place.
    """
    l = len(costs)
    low = max(0, end - int(steps.sum()) - (l - 1))
    path = np.empty((l, 2), np.int32)
    reachable = np.ascontiguousarray(costs[:, low : end + 1])
    trace_at_velocity(reachable, steps, costs.dtype.type(penalty), path)
    path[:, 1] += low
    return path


def best_velocity_match(matches: VelocityMatches, nms_radius: int) -> SequenceMatch | None:
    """
    Return the nearest path (the lowest end on a tie) and the second best; None if there is none.

    :param nms_radius: the second best's middle is more than so many places from the nearest one's.
    """
    if matches.distances.size == 0:
        return None
    end = int(np.argmin(matches.distances))
    if not np.isfinite(matches.distances[end]):
        return None
    middle = int(matches.middles[end])
    second = nearest_end_elsewhere(matches.distances, matches.middles, middle, nms_radius)
    return SequenceMatch(
        first=int(matches.firsts[end]),
        last=end,
        middle=middle,
        distance=float(matches.distances[end]),
        second_best_index=int(matches.middles[second]) if second >= 0 else -1,
        second_best_distance=float(matches.distances[second]) if second >= 0 else float('nan'),
    )


@kernel
def _copy_costs(D, shift, scale, low, costs):
    """Fill costs (l, width): (D - shift) * scale from place ``low`` on, +inf outside the map."""
    n, width = shift.shape[0], costs.shape[1]
    costs[:] = np.inf
    first, last = max(low, 0), min(low + width, n)
    for i in range(costs.shape[0]):
        row, source = costs[i], D[i]
        for y in range(first, last):
            row[y - low] = (source[y] - shift[y]) * scale[y]


@kernel
def _nearer(S, first, middle, S_old, first_old, middle_old, at, extra):
    """Return the better of a path so far and one that comes from ``at`` at an extra cost."""
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
    Find the best path to every end.

    :param D: window, shape (l, n or more), row = query image, oldest first; +inf bans a pair.
    :param shift, scale: the costs are (D - shift) * scale, shape (n,).
    :param steps: places that each speed moves on before each row, shape (V, l), int32, first 0.
    :param penalty: cost of one place more or less, of D's type.
    :param distances: mean cost of a row, penalties included, shape (n,), written; +inf where there
        is no path.
    :param firsts: the place of the first row, shape (n,), int32, written.
    :param middles: the place of the middle row, likewise.
    :param speeds: the speed, likewise.
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
