# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The whole tables of one pair, and the way back through them: what a warping path needs."""

import math

import numpy as np
from stavpr_ros.compilation import kernel

VERTICAL, HORIZONTAL, DIAGONAL = 0, 1, 2


@kernel
def accumulate(d, weight, xi, S, C, step):
    """
    Fill the whole tables of one pair, for its warping path.

    :param d: distances, shape (rows, columns).
    :param weight: the adaptive weight a of a diagonal step.
    :param xi: half width of the band; at least rows + columns for none.
    :param S, C, step: shape of d, written: accumulated distance, path cost, the step into each cell.
    """
    rows, columns = d.shape
    S[:] = np.inf
    C[:] = 1
    for i in range(rows):
        for j in range(columns):
            if abs(i - j) >= xi:
                continue
            if i == 0 and j == 0:
                S[0, 0] = d[0, 0]
                continue
            vertical = d[i, j] + S[i - 1, j] if i > 0 else math.inf
            horizontal = d[i, j] + S[i, j - 1] if j > 0 else math.inf
            diagonal = weight * d[i, j] + S[i - 1, j - 1] if i > 0 and j > 0 else math.inf
            if diagonal < vertical and diagonal < horizontal:
                S[i, j], C[i, j], step[i, j] = diagonal, C[i - 1, j - 1] + weight, DIAGONAL
            elif i > 0 and (j == 0 or vertical <= horizontal):
                S[i, j], C[i, j], step[i, j] = vertical, C[i - 1, j] + 1, VERTICAL
            else:
                S[i, j], C[i, j], step[i, j] = horizontal, C[i, j - 1] + 1, HORIZONTAL


@kernel
def backtrack(step, row, column, path):
    """Follow the steps back from (row, column) to (0, 0) into path (rows + columns, 2); return its length."""
    count = 0
    while True:
        path[count, 0] = row
        path[count, 1] = column
        count += 1
        if row == 0 and column == 0:
            return count
        taken = step[row, column]
        if taken != HORIZONTAL:
            row -= 1
        if taken != VERTICAL:
            column -= 1
