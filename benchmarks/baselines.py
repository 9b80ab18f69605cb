# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plain programs of the same mathematics: LM-DTW and the place filter with prange, DTW."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from stavpr_ros.recognition.place_filter import FilterSettings


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


@lru_cache
def prange_filter() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """
    Compile the equations of the place filter as they stand, parallel over the places.

    The function takes the probabilities a (K, V, n) float32, the likelihoods (K, n), the
    probability of a level by the one before (K, K), of a speed by the one before (V, V), the steps
    of the speeds (V,), the probability of a place more or less, that of staying on the map, and
    the births (K,). It returns the new probabilities, not normalized, and each level's sums
    before moving and after it. It does not keep where the states came from.
    """
    import numba as nb

    @nb.njit(parallel=True, error_model='numpy')
    def advance(
        a: np.ndarray, likelihood: np.ndarray, levels: np.ndarray, speeds: np.ndarray,
        steps: np.ndarray, spread: float, stay_on: float, births: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        K, V, n = a.shape
        m, x = np.zeros_like(a), np.empty_like(a)
        before, after = np.zeros((K, n)), np.zeros((K, n))
        for y in nb.prange(n):
            for k in range(K):
                for w in range(V):
                    b = np.float32(0)
                    for j in range(K):
                        b += levels[j, k] * a[j, w, y]
                    before[k, y] += b
                    for v in range(V):
                        m[k, v, y] += speeds[w, v] * b
        for y in nb.prange(n):
            for k in range(K):
                for v in range(V):
                    s = np.float32(0)
                    for more, p in ((0, 1 - 2 * spread), (1, spread), (-1, spread)):
                        origin = y - max(steps[v] + more, 0)
                        if origin >= 0:
                            s += np.float32(p) * m[k, v, origin]
                    after[k, y] += s
                    x[k, v, y] = (np.float32(stay_on) * s + births[k]) * likelihood[k, y]
        return x, before.sum(axis=1), after.sum(axis=1)

    return advance


class PlainFilter:
    """
    The place filter in plain programs; one update after the other, from the start.

    :param settings: model, of which all values are used as the package's filter uses them.
    """

    def __init__(self, places: int, settings: FilterSettings) -> None:
        self._s, self._count = settings, 0
        self._speeds, self._levels = np.array(settings.speeds), np.array(settings.levels)
        K, V = len(self._levels), len(self._speeds)
        self.a = np.full((K, V, places), settings.start / (K * V * places), np.float32)
        self.off = np.full(K, (1 - settings.start) / K)

    def _speed_changes(self, weights: np.ndarray) -> np.ndarray:
        """Return the probability of each speed by the one before, (V, V)."""
        V, s = len(self._speeds), self._s
        matrix = np.full((V, V), (1 - s.keep_speed) * 0.2 / V)
        matrix += s.keep_speed * np.eye(V)
        matrix += (1 - s.keep_speed) * 0.4 * (np.eye(V, k=1) + np.eye(V, k=-1))
        matrix *= weights
        return (matrix / matrix.sum(axis=1, keepdims=True)).astype(np.float32)

    def update(self, z: np.ndarray, weight: float, speed_weights: np.ndarray) -> None:
        """Advance by an image; see the package's filter."""
        s, n, count = self._s, len(z), self._count
        steps = (np.rint(self._speeds * (count + 1)) - np.rint(self._speeds * count)).astype(int)
        mu, changes = self._levels[:, None], s.level_changes()
        likelihood = np.exp(weight * (mu * z - mu * mu / 2)).astype(np.float32)
        off = self.off @ changes
        births = (off * s.enter / (len(self._speeds) * n)).astype(np.float32)
        x, before, after = prange_filter()(
            self.a, likelihood, changes, self._speed_changes(speed_weights), steps, s.spread,
            1 - s.leave, births,
        )  # fmt: skip
        off = off * (1 - s.enter) + after * s.leave + np.maximum(before - after, 0)
        total = off.sum() + x.sum(dtype=np.float64)
        self.a, self.off, self._count = x / np.float32(total), off / total, count + 1


def accumulated(costs: np.ndarray) -> float:
    """Return the accumulated cost of the last cell of dynamic time warping, in float64."""
    S = np.full((costs.shape[0] + 1, costs.shape[1] + 1), np.inf)
    S[0, 0] = 0
    for i, j in np.ndindex(costs.shape):
        S[i + 1, j + 1] = costs[i, j] + min(S[i, j], S[i, j + 1], S[i + 1, j])
    return float(S[-1, -1])


def sample(n: int, k: int, count: int) -> list[int]:
    """Return ``count`` starts, spread evenly over those that see k columns, or all of these."""
    whole = max(1, n - k + 1)
    return sorted({int(start) for start in np.linspace(0, whole - 1, min(count, whole))})
