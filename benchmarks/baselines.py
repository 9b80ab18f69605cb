"""LM-DTW written without a thought of the machine: a plain prange over starts, the oracle's loops."""

import importlib.util
import sys
from collections.abc import Callable
from functools import lru_cache
from types import ModuleType

import numpy as np
from records import ROOT


@lru_cache
def prange() -> Callable[[np.ndarray, int, np.ndarray, np.ndarray], None]:
    """
    Compile the obvious parallel program: one start after the other on every core, the textbook's loops.

    It takes D (l, n) float32, k, and writes distances (n,) float32 and lengths (n,) int32. The same
    arithmetic, tie rule and answers as ours; two rows of S and C are kept for a start, not the tables.
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
def oracle() -> ModuleType:
    """Load test/oracle.py, the method in plain loops."""
    path = ROOT / 'test' / 'oracle.py'
    spec = importlib.util.spec_from_file_location('stavpr_oracle', path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


def sample(n: int, k: int, count: int) -> list[int]:
    """Return ``count`` starts spread evenly over those that see k whole columns, or all of these."""
    whole = max(1, n - k + 1)
    return sorted({int(start) for start in np.linspace(0, whole - 1, min(count, whole))})
