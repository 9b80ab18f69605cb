# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The alignment of one pair, with its warping path."""

from dataclasses import dataclass

import numpy as np
from stavpr_ros.errors import InputError

NO_PATH = np.empty((0, 2), np.int32)


@dataclass(frozen=True)
class Alignment:
    """
    One warping path and what it costs.

    :param distance: accumulated / cost.
    :param path: the cells from the start to the end, shape (m, 2), int32, 0-based (row, column).
    :param accumulated: S of the last cell.
    :param cost: C of the last cell: 1 a cell, a for each diagonal step.
    :param weight: the adaptive weight a; 1 for vanilla DTW and LM-DTW.
    """

    distance: float
    path: np.ndarray
    accumulated: float
    cost: float
    weight: float


def trace(d: np.ndarray, weight: float, xi: int, free_end: bool = False) -> Alignment:
    """
    Align one pair by dynamic time warping.

    :param d: distances, shape (rows, columns), float32 or float64.
    :param weight: a of the diagonal steps.
    :param xi: half width of the band, rows + columns for none.
    :param free_end: end in the cell of the last row with the smallest S / C (the first one on a
        tie) instead of in the last column.
    """
    from stavpr_ros.alignment.cpu import dtw

    rows, columns = d.shape
    S, C = np.empty_like(d), np.empty_like(d)
    step = np.zeros(d.shape, np.int8)
    a = d.dtype.type(weight)
    dtw.accumulate(d, a, xi, S, C, step)
    end = int(np.argmin(S[-1] / C[-1])) if free_end else columns - 1
    path = np.empty((rows + columns, 2), np.int32)
    count = dtw.backtrack(step, rows - 1, end, path)
    accumulated, cost = S[-1, end], C[-1, end]
    return Alignment(
        distance=float(accumulated / cost),
        path=path[:count][::-1].copy(),
        accumulated=float(accumulated),
        cost=float(cost),
        weight=float(a),
    )


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
