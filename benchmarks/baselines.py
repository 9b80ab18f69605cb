# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plain programs of the same mathematics: LM-DTW with prange, and DTW."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np


@lru_cache
def prange() -> Callable[[np.ndarray, int, np.ndarray, np.ndarray], None]:
    """
    Compile the textbook's loops of LM-DTW, parallel over the starts.

    The function takes D (l, n) float32, k, and writes distances (n,) float32 and lengths (n,)
    int32: the same arithmetic, tie rule and results as the package's kernel. Each start keeps one
    row.
    """
    import numba as nb

    @nb.njit(parallel=True, error_model='numpy')
    def lm_dtw(D: np.ndarray, k: int, distances: np.ndarray, lengths: np.ndarray) -> None:
        l, n = D.shape
        one = np.float32(1)
        for s in nb.prange(n):
            columns = min(k, n - s)
            S, C = np.empty(columns, np.float32), np.empty(columns, np.float32)
            S[0], C[0] = D[0, s], one
            for x in range(1, columns):
                S[x], C[x] = D[0, s + x] + S[x - 1], C[x - 1] + one
            for i in range(1, l):
                S_before, C_before = S[0], C[0]  # of cell (i-1, x-1)
                S[0], C[0] = D[i, s] + S[0], C[0] + one
                for x in range(1, columns):
                    cost = D[i, s + x]
                    diagonal, vertical, horizontal = cost + S_before, cost + S[x], cost + S[x - 1]
                    S_before, C_above = S[x], C[x]
                    if diagonal < vertical and diagonal < horizontal:
                        S[x], C[x] = diagonal, C_before + one
                    elif vertical <= horizontal:
                        S[x], C[x] = vertical, C_above + one
                    else:
                        S[x], C[x] = horizontal, C[x - 1] + one
                    C_before = C_above
            best, m = np.float32(np.inf), 0
            for x in range(columns):
                if S[x] / C[x] < best:
                    best, m = S[x] / C[x], x + 1
            distances[s], lengths[s] = best, m

    return lm_dtw


def accumulate_costs(costs: np.ndarray) -> float:
    """Return the accumulated cost of the last cell of dynamic time warping, in float64."""
    S = np.full((costs.shape[0] + 1, costs.shape[1] + 1), np.inf)
    S[0, 0] = 0
    for i, j in np.ndindex(costs.shape):
        S[i + 1, j + 1] = costs[i, j] + min(S[i, j], S[i, j + 1], S[i + 1, j])
    return float(S[-1, -1])


def sample(n: int, k: int, count: int) -> list[int]:
    """Return ``count`` starts, spread evenly over the starts with k columns, or all of these."""
    whole = max(1, n - k + 1)
    return sorted({int(start) for start in np.linspace(0, whole - 1, min(count, whole))})
