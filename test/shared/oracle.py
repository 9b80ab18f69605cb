# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The method in plain loops, written from its description alone: the reference of every kernel.

Nothing here is fast and nothing is shared with the package. Each function takes a dtype: numpy
scalars round every single operation to it, so a kernel with the same arithmetic in float32 must
return the same bits. Indices are 0-based; comments quote the 1-based formulae of the method.
"""

from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Cells = list[tuple[int, int]]

# The figure published with the method, two decimals; rows are query strips. I_4 = 2, a = sqrt(3).
GOLDEN: Array = np.array(
    [
        [0.51, 0.55, 0.65, 0.63, 0.69, 0.66, 0.57],
        [0.44, 0.49, 0.65, 0.64, 0.68, 0.65, 0.62],
        [0.32, 0.38, 0.58, 0.60, 0.64, 0.62, 0.63],
        [0.39, 0.23, 0.43, 0.44, 0.56, 0.59, 0.60],
        [0.59, 0.41, 0.14, 0.31, 0.42, 0.51, 0.55],
        [0.60, 0.45, 0.31, 0.17, 0.36, 0.41, 0.46],
        [0.60, 0.57, 0.45, 0.33, 0.22, 0.37, 0.47],
    ]
)


@dataclass
class Grid:
    """Accumulated distances S, path costs C, the step into each cell ('d', 'v', 'h'; '' first)."""

    S: list[list[Any]]
    C: list[list[Any]]
    step: list[list[str]]


class Aligned(NamedTuple):
    """One warping path from (1, 1) to its end cell, and its S / C."""

    distance: Any
    path: Cells


class Answer(NamedTuple):
    """Where a window of the query was found; last inclusive."""

    start: int
    length: int
    last: int
    middle: int
    distance: Any
    second_best_index: int
    second_best_distance: float


# ------------------------------------------------ place description and distances (sections 1, 2)


def cut_strips(feature_map: Array, W: int) -> Array:
    """Cut (n, C, H, Wf) into W vertical strips, each flattened: (W, n, C * H * columns)."""
    n, C, H, Wf = feature_map.shape
    if Wf < W:
        raise ValueError(f'{Wf} columns cannot make {W} strips')
    columns = Wf // W
    left = (Wf % W) // 2  # the rest of the superfluous columns falls off on the right
    strips = np.empty((W, n, C * H * columns), feature_map.dtype)
    for i in range(W):
        first = left + i * columns
        for image in range(n):
            cells = [
                (c, h, w)
                for c in range(C)
                for h in range(H)
                for w in range(first, first + columns)
            ]
            for at, (c, h, w) in enumerate(cells):
                strips[i, image, at] = feature_map[image, c, h, w]
    return strips


def norm(x: Array, dtype: type = np.float64) -> Any:
    """Length of a vector."""
    total = dtype(0)
    for value in x:
        total = total + dtype(value) * dtype(value)
    return np.sqrt(total)


def cosine_distance(x: Array, y: Array, dtype: type = np.float64) -> Any:
    """1 - <x, y> / (|x| |y|); exactly 1 where either is zero; not clipped."""
    length_x, length_y = norm(x, dtype), norm(y, dtype)
    if length_x == 0 or length_y == 0:
        return dtype(1)
    product = dtype(0)
    for left, right in zip(x, y, strict=True):
        product = product + dtype(left) * dtype(right)
    return dtype(1) - product / (length_x * length_y)


def distances(query: Array, reference: Array, dtype: type = np.float64) -> Array:
    """d[i, j, y] of query strips (W, d) against those of n map images (W, n, d)."""
    W, n, _ = reference.shape
    d: Array = np.empty((W, W, n), dtype)
    for i in range(W):
        for j in range(W):
            for y in range(n):
                d[i, j, y] = cosine_distance(query[i], reference[j, y], dtype)
    return d


def whole_number_distances(
    query: Array, reference: Array, query_lengths: Array, lengths: Array
) -> Array:
    """d[i, j, y] of rounded strips, (W, d) and (W, n, d) of whole numbers: exact sums."""
    W, n, _ = reference.shape
    d: Array = np.empty((W, W, n), np.float32)
    for i in range(W):
        for j in range(W):
            for y in range(n):
                total = 0
                for left, right in zip(query[i].tolist(), reference[j, y].tolist(), strict=True):
                    total += left * right
                cosine = np.float32(total) * lengths[j, y] * query_lengths[i]
                d[i, j, y] = np.float32(1) - cosine
    return d


# ------------------------------------------------ the recursion (section 2)


def accumulate(d: Any, weight: Any, dtype: type) -> Grid:
    """S, C and the steps; `weight` is a of the diagonal, 1 for vanilla DTW and for sequences."""
    rows, columns = d.shape
    a, one = dtype(weight), dtype(1)
    cells = [[dtype(value) for value in row] for row in d]
    S = [[dtype(0)] * columns for _ in range(rows)]
    C = [[dtype(0)] * columns for _ in range(rows)]
    step = [[''] * columns for _ in range(rows)]
    S[0][0], C[0][0] = cells[0][0], one
    for j in range(1, columns):  # first row: cumulative sum
        S[0][j], C[0][j], step[0][j] = cells[0][j] + S[0][j - 1], C[0][j - 1] + one, 'h'
    for i in range(1, rows):
        S[i][0], C[i][0], step[i][0] = cells[i][0] + S[i - 1][0], C[i - 1][0] + one, 'v'
        for j in range(1, columns):
            diagonal = a * cells[i][j] + S[i - 1][j - 1]
            vertical = cells[i][j] + S[i - 1][j]
            horizontal = cells[i][j] + S[i][j - 1]
            if diagonal < vertical and diagonal < horizontal:  # strictly smaller than both others
                S[i][j], C[i][j], step[i][j] = diagonal, C[i - 1][j - 1] + a, 'd'
            elif vertical <= horizontal:  # vertical wins a tie
                S[i][j], C[i][j], step[i][j] = vertical, C[i - 1][j] + one, 'v'
            else:
                S[i][j], C[i][j], step[i][j] = horizontal, C[i][j - 1] + one, 'h'
    return Grid(S, C, step)


def trace(grid: Grid, i: int, j: int) -> Cells:
    """Walk the steps back from (i, j) to the start."""
    path = [(i, j)]
    while grid.step[i][j]:
        step = grid.step[i][j]
        i, j = i - (step in 'dv'), j - (step in 'dh')
        path.append((i, j))
    return path[::-1]


# ------------------------------------------------ distance of two images (sections 2, 3)


def restrict(d: Array, xi: int | None) -> Array:
    """RA: +inf where |i - j| >= xi."""
    banned = d.copy()
    if xi is not None:
        for i in range(d.shape[0]):
            for j in range(d.shape[1]):
                if abs(i - j) >= xi:
                    banned[i, j] = np.inf
    return banned


def adaptive_weight(d: Array, sigma: float, dtype: type) -> Any:
    """Return a = sqrt(1 + sigma |I_c - c|) of a restricted d."""
    W = d.shape[0]
    c = math.ceil(W / 2) - 1  # c = ceil(W / 2), 1-based
    nearest = 0
    for j in range(W):
        if d[c, j] < d[c, nearest]:  # the first minimum stays
            nearest = j
    return np.sqrt(dtype(1) + dtype(sigma) * dtype(abs(nearest - c)))


def align_images(
    d: Array,
    strategy: str = 'adaptive',
    sigma: float = 1.0,
    xi: int | None = None,
    dtype: type = np.float64,
) -> Any:
    """Return S / C of one pair d (W, W) by 'adaptive' or 'vanilla' DTW; the end is (W, W)."""
    d = restrict(d.astype(dtype), xi)
    a = adaptive_weight(d, sigma, dtype) if strategy == 'adaptive' else dtype(1)
    grid = accumulate(d, a, dtype)
    return grid.S[-1][-1] / grid.C[-1][-1]


def sliding_window(d: Array, xi: int | None = None, dtype: type = np.float64) -> Any:
    """Min over p, q in 1..W-3 of the mean of d[p+t, q+t], t = 0..3."""
    d = restrict(d.astype(dtype), xi)
    best = dtype(np.inf)
    for p in range(d.shape[0] - 3):
        for q in range(d.shape[0] - 3):
            total = d[p, q]
            for t in range(1, 4):
                total = total + d[p + t, q + t]
            best = min(best, total / dtype(4))
    return best


def rigid(d: Array, xi: int | None = None, dtype: type = np.float64) -> Any:
    """Min over |s| < xi of the mean of d[i, i+s] + |s| / 32; without xi, over |s| <= 2."""
    d, W = d.astype(dtype), len(d)
    best = dtype(np.inf)
    for s in range(1 - W, W):
        if abs(s) < (3 if xi is None else xi):
            total, count = dtype(0), 0
            for i in range(W):
                if 0 <= i + s < W:
                    total, count = total + d[i, i + s], count + 1
            best = min(best, total / dtype(count) + dtype(abs(s) / 32))
    return best


def image_distances(
    d: Array,
    strategy: str = 'adaptive',
    sigma: float = 1.0,
    xi: int | None = None,
    dtype: type = np.float64,
) -> Array:
    """Distance of one query image to n map images: d (W, W, n) -> (n,)."""
    result: Array = np.empty(d.shape[2], dtype)
    for y in range(d.shape[2]):
        if strategy == 'sliding_window':
            result[y] = sliding_window(d[:, :, y], xi, dtype)
        elif strategy == 'rigid':
            result[y] = rigid(d[:, :, y], xi, dtype)
        else:
            result[y] = align_images(d[:, :, y], strategy, sigma, xi, dtype)
    return result


# ------------------------------------------------ LM-DTW (section 4)


def frames_searched(length: int, beta: float) -> int:
    """K = ceil(beta * l - 1e-9), the map frames that one start may reach."""
    return math.ceil(beta * length - 1e-9)


def align_sequence(D: Array, start: int, beta: float, dtype: type = np.float64) -> Aligned:
    """Align D (l, n) from one start, its end free on the last row; map indices are absolute."""
    length = D.shape[0]
    window = D[:, start : start + frames_searched(length, beta)]  # fewer at the end of the map
    grid = accumulate(window, 1, dtype)
    best, m = grid.S[-1][0] / grid.C[-1][0], 0
    for x in range(window.shape[1]):
        q = grid.S[-1][x] / grid.C[-1][x]
        if q < best:  # the first minimum stays
            best, m = q, x
    path = [(i, start + j) for i, j in trace(grid, length - 1, m)]
    return Aligned(best, path)


def match_sequence(D: Array, beta: float, dtype: type = np.float64) -> tuple[Array, Array]:
    """Every start's distance and its number of map frames m."""
    n = D.shape[1]
    q: Array = np.empty(n, dtype)
    m: Array = np.empty(n, np.int32)
    for start in range(n):
        aligned = align_sequence(D, start, beta, dtype)
        q[start], m[start] = aligned.distance, aligned.path[-1][1] - start + 1
    return q, m


def best_match(q: Array, m: Array, nms_radius: int) -> Answer | None:
    """Return the nearest start (lowest on a tie) and the best one outside its nms_radius."""
    best = _first_minimum(q, range(len(q)))
    if best is None:
        return None
    middles = [(2 * s + int(m[s]) - 1) // 2 for s in range(len(q))]
    others = [s for s in range(len(q)) if abs(middles[s] - middles[best]) > nms_radius]
    second = _first_minimum(q, others)
    return Answer(
        start=best,
        length=int(m[best]),
        last=best + int(m[best]) - 1,
        middle=middles[best],
        distance=q[best],
        second_best_index=-1 if second is None else middles[second],
        second_best_distance=math.nan if second is None else float(q[second]),
    )


def _first_minimum(q: Array, starts: Any) -> int | None:
    best = None
    for s in starts:
        if np.isfinite(q[s]) and (best is None or q[s] < q[best]):
            best = s
    return best


def aligned_index(path: Cells, query_index: int) -> int:
    """Map frame aligned with one query frame; of several the middle one."""
    frames = [j for i, j in path if i == query_index]
    return (min(frames) + max(frames)) // 2


# ------------------------------------------------ evaluation (section 6)


def best_f1(places: list[tuple[int, Any]], truth: list[list[int]], tolerance: int) -> float:
    """
    Return the best F1 over all thresholds.

    Accepted (distance < threshold) and within the tolerance: TP; accepted and outside: FP;
    rejected: FN. `truth[i]` are the accepted map frames of query frame i, never empty.
    """
    scores = sorted({float(score) for place, score in places if place >= 0 and np.isfinite(score)})
    best = 0.0
    for threshold in [math.nextafter(score, math.inf) for score in scores]:
        tp = fp = fn = 0
        for (place, score), accepted in zip(places, truth, strict=True):
            if place < 0 or not score < threshold:
                fn += 1
            elif min(abs(place - frame) for frame in accepted) <= tolerance:
                tp += 1
            else:
                fp += 1
        best = max(best, 2 * tp / (2 * tp + fp + fn))
    return best
