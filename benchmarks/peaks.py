# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The machine's peaks: read bandwidth, and the large matrix product in float32."""

from collections.abc import Callable
from functools import partial

from lower_bounds import Peaks
import numpy as np
from timing import best_seconds

SIDE = 4096  # side of the large matrix product
PIECES = 256  # pieces of an array that threads read
READ_MB = 1024


def reader(threads: int) -> Callable[[np.ndarray], float]:
    """Compile the sum over an array, in pieces."""
    import numba as nb

    # any order of additions: otherwise the sum waits for additions instead of memory
    @nb.njit(parallel=threads > 1, nogil=True, fastmath={'reassoc', 'nsz'})
    def read(x: np.ndarray) -> float:
        piece = x.size // PIECES
        total = np.zeros(PIECES, x.dtype)
        for t in nb.prange(PIECES):
            # of a slice: with offsets, the loop is not vectorized on all processors
            values, part = x[t * piece : (t + 1) * piece], x.dtype.type(0)
            for i in range(piece):
                part += values[i]
            total[t] = part
        return total.sum()

    return read


def read_bandwidth(megabytes: int, threads: int, seconds: float) -> float:
    """Return the bytes per second that this number of cores reads from memory."""
    x = np.ones(megabytes * 2**20 // 4, np.float32)
    read = reader(threads)
    return x.nbytes / best_seconds(lambda: read(x), seconds)


def matrix_rate(side: int, seconds: float) -> float:
    """Return the operations per second of torch's product of two random square matrices."""
    import torch

    left, right = torch.randn(2, side, side)
    call = partial(torch.mm, left, right, out=torch.empty_like(left))
    return 2 * side**3 / best_seconds(call, seconds)


def measure_peaks(seconds: float) -> Peaks:
    """
    Measure all peaks; the best run counts: a bound must lie below every measurement.

    :param seconds: duration of each measurement.
    """
    # not every library is at its best with the larger matrix
    rate = max(matrix_rate(side, seconds) for side in (SIDE, SIDE // 2))
    import numba as nb

    threads = {1, nb.get_num_threads()}
    return Peaks(max(read_bandwidth(READ_MB, n, seconds) for n in threads), rate)
