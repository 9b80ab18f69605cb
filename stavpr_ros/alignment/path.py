# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Warping paths of sequences."""

import numpy as np
from stavpr_ros.errors import InputError

NO_PATH = np.empty((0, 2), np.int32)


def trace_sequence(window: np.ndarray, start: int, k: int) -> np.ndarray:
    """
    Trace the path of one start in a checked window: to the first end with the smallest S / C.

    :param window: image distances D, shape (l, n).
    :param k: map images a start searches.
    :returns: the cells from the first to the last, shape (m, 2), int32: (query index, map index),
        both 0-based, the map index counted from the map's start.
    """
    from stavpr_ros.alignment.cpu import dtw

    d = np.ascontiguousarray(window[:, start : start + k])
    S, C, step = np.empty_like(d), np.empty_like(d), np.empty(d.shape, np.int8)
    dtw.accumulate(d, S, C, step)
    path = np.empty((sum(d.shape), 2), np.int32)
    count = dtw.backtrack(step, len(d) - 1, int(np.argmin(S[-1] / C[-1])), path)
    path[:, 1] += start
    return path[:count][::-1].copy()


def aligned_index(path: np.ndarray, query_index: int) -> int:
    """
    Return the map index aligned with one query image: the middle one (floor) of several.

    :param path: a warping path, shape (m, 2).
    :param query_index: 0-based row of the path.
    :raises InputError: the path has no such row.
    """
    columns = path[path[:, 0] == query_index, 1]
    if not columns.size:
        raise InputError(
            f'query index {query_index} is not on the path, which has rows 0 to {path[:, 0].max()}'
        )
    return int(columns[0] + columns[-1]) // 2
