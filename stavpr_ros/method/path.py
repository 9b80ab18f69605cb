# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Paths of a window on the CPU: by its beliefs, and the nearest straight one by its z."""

import numba as nb
import numpy as np
from stavpr_ros.compilation import kernel, parallel_kernel
from stavpr_ros.method.model import CLOSE, LINE, MAX_STEP, ON_LINE
from stavpr_ros.simd import LANES, load, select, splat, store

PART = 1024  # columns of a thread at a time
CHUNK = 128  # columns whose sums of z are computed together
FAR = 1.0  # z beside the map, and of columns that are not compared
F, INF = np.float32, np.float32(np.inf)


@kernel
def close_sums(columns: np.ndarray, probabilities: np.ndarray, path: np.ndarray) -> np.ndarray:
    """
    Return the probability of the columns within ``CLOSE`` of a path, for each image, (l,).

    :param columns: ascending, (m,); probabilities: for each image, (l, m); path: (l,).
    """
    sums = np.zeros(len(path))
    for i in range(len(path)):
        at = np.searchsorted(columns, path[i] - CLOSE)
        while at < len(columns) and columns[at] <= path[i] + CLOSE:
            sums[i] += probabilities[i, at]
            at += 1
    return sums


@kernel
def centered_place(
    columns: np.ndarray, probabilities: np.ndarray, position: int, at: int
) -> float:
    """
    Return the place of an image, between columns.

    On the straight line through the images around it, if their places are near it; else the mean
    of the probable columns. The place of an image around it is the mean within ``CLOSE`` of its
    most probable column.

    :param columns, probabilities: of the images, (m,) and (l, m).
    :param position: of the image, whose most probable column is ``at``.
    """
    first, end = max(position - LINE, 0), min(position + LINE + 1, len(probabilities))
    places = np.empty(end - first)
    low = np.searchsorted(columns, at - LINE * MAX_STEP)
    high = np.searchsorted(columns, at + LINE * MAX_STEP, 'right')
    for i in range(first, end):
        best, highest = at, -1.0
        for j in range(low, high):
            if i == position and columns[j] != at:
                continue
            total, k = 0.0, j
            while k > low and columns[k - 1] >= columns[j] - CLOSE:
                k -= 1
            while k < high and columns[k] <= columns[j] + CLOSE:
                total += probabilities[i, k]
                k += 1
            if total > highest:
                best, highest = columns[j], total
        total, weighed = 0.0, 0.0
        for j in range(low, high):
            if abs(columns[j] - best) <= CLOSE:
                total += probabilities[i, j]
                weighed += probabilities[i, j] * columns[j]
        places[i - first] = weighed / total if total > 0 else best
    count = len(places)
    offsets = np.arange(first, end) - position
    middle, mean = offsets.mean(), places.mean()
    spread = ((offsets - middle) ** 2).sum()
    slope = ((offsets - middle) * (places - mean)).sum() / spread if count > 1 else 0.0
    on_line = mean - slope * middle
    if np.abs(places - on_line - slope * offsets).max() < ON_LINE:
        return min(max(on_line, columns[low]), columns[high - 1])
    return places[position - first]


@kernel
def follow(
    columns: np.ndarray, probabilities: np.ndarray, position: int, place: int
) -> np.ndarray:
    """
    Return the most probable columns that a path through a column can have, (l,), int64.

    It never goes back, as the camera does not.

    :param columns, probabilities: of the images, (m,) and (l, m).
    :param position: of the image at ``place``.
    """
    l = len(probabilities)
    path = np.full(l, place)
    for direction in (1, -1):
        for i in range(position + direction, l if direction > 0 else -1, direction):
            before = path[i - direction]
            path[i], highest = before, 0.0
            for step in range(MAX_STEP + 1):
                y = before + direction * step
                at = np.searchsorted(columns, y)
                if at < len(columns) and columns[at] == y and probabilities[i, at] > highest:
                    path[i], highest = y, probabilities[i, at]
    return path


# ------------------------------------------------ straight paths


@parallel_kernel
def best_straight(memory, rows, low, end, steps, excluded):  # type: ignore[no-untyped-def]
    """
    Return what :meth:`Filter.best_straight` does.

    :param memory: distances z, (L, n), float32; rows: of the images in it, (images,).
    :param low, end: columns of the paths that count, but for those in ``excluded``.
    """
    images, n = len(rows), memory.shape[1]
    parts = max((end - low + PART - 1) // PART, 0)
    sums, places, speeds = np.empty(parts, F), np.empty(parts, np.int64), np.empty(parts, np.int64)
    for part in nb.prange(parts):
        start = low + part * PART
        sums[part], places[part], speeds[part] = _best_of_part(
            memory, rows, start, min(start + PART, end), start == low, steps, excluded
        )
    best, place, speed = INF, -1, 0
    for part in range(parts):
        if sums[part] < best:
            best, place, speed = sums[part], places[part], speeds[part]
    path = np.empty(images if place >= 0 else 0, np.int64)
    for i in range(len(path)):
        path[i] = min(max(place + steps[speed, i], 0), n - 1)
    return -float(best) / images, path


@kernel
def _lowest_of_three(row, first, out):  # type: ignore[no-untyped-def]
    """Write the lowest z of three columns around each from ``first`` on, ``FAR`` without any."""
    stop = first + len(out)
    out[:] = row[first:stop]
    for side, other in ((out[1:], row[first : stop - 1]), (out[:-1], row[first + 1 : stop])):
        for y in range(len(side)):
            side[y] = min(side[y], other[y])
    if first:
        out[0] = min(out[0], row[first - 1])
    if stop < len(row):
        out[-1] = min(out[-1], row[stop])
    for y in range(len(out)):
        out[y] = out[y] if out[y] < INF else F(FAR)


@kernel
def _best_of_part(  # type: ignore[no-untyped-def]
    memory, rows, low, end, is_first, steps, excluded
):
    """Return the lowest sum of z of the paths of columns, its column and its speed."""
    images, n, far = len(rows), memory.shape[1], F(FAR)
    before, behind = max(-steps[-1, 0], 0), max(steps[-1, -1], 0)  # of the largest speed
    width = before + (end - low + CHUNK - 1) // CHUNK * CHUNK + behind
    near = np.empty((images, width), F)  # z of the images around the part, finite
    flat, sums, lanes = near.reshape(-1), np.empty(CHUNK, F), np.empty(LANES, F)
    first, stop = max(low - before, 0), min(low - before + width, n)
    for i in range(images):
        row, own = memory[rows[i]], near[i]
        own[: first - low + before] = own[stop - low + before :] = far
        _lowest_of_three(row, first, own[first - low + before : stop - low + before])
    best, place, speed = INF, -1, 0
    for start in range(low, end, CHUNK):
        first, stop = max(start - before, 0), min(start + CHUNK + behind, n)
        is_compared = is_first and start == low
        for y in range(max(first - 1, 0), min(stop + 1, n)):
            is_compared |= memory[rows[-1], y] < INF
        for v in range(len(steps) if is_compared else 0):
            for x in range(0, CHUNK, 4 * LANES):  # four sums at a time: each waits for itself
                a, b, c, d = splat(F(0)), splat(F(0)), splat(F(0)), splat(F(0))
                for i in range(images):
                    at = i * width + before + steps[v, i] + start - low + x
                    a, b = a + load(flat, at), b + load(flat, at + LANES)
                    c, d = c + load(flat, at + 2 * LANES), d + load(flat, at + 3 * LANES)
                store(sums, x, a)
                store(sums, x + LANES, b)
                store(sums, x + 2 * LANES, c)
                store(sums, x + 3 * LANES, d)
            sums[end - start :] = INF
            for i in range(len(excluded)):
                sums[max(excluded[i, 0] - start, 0) : max(excluded[i, 1] - start, 0)] = INF
            lowest = splat(INF)
            for x in range(0, CHUNK, LANES):
                lowest = select(load(sums, x) < lowest, load(sums, x), lowest)
            store(lanes, 0, lowest)
            if lanes.min() < best:
                place, speed = start + int(sums.argmin()), v
                best = sums[place - start]
    return best, place, speed
