# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the beliefs of a window to the place of an image, and the path through it."""

import numpy as np
from stavpr_ros.compilation import kernel
from stavpr_ros.method.model import CLOSE, LINE, MAX_STEP, ON_LINE


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
        best, most = at, -1.0
        for j in range(low, high):
            if i == position and columns[j] != at:
                continue
            total, k = 0.0, j
            while k > low and columns[k - 1] >= columns[j] - CLOSE:
                k -= 1
            while k < high and columns[k] <= columns[j] + CLOSE:
                total += probabilities[i, k]
                k += 1
            if total > most:
                best, most = columns[j], total
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
            path[i], most = before, 0.0
            for step in range(MAX_STEP + 1):
                y = before + direction * step
                at = np.searchsorted(columns, y)
                if at < len(columns) and columns[at] == y and probabilities[i, at] > most:
                    path[i], most = y, probabilities[i, at]
    return path
