# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The machine's peaks: read bandwidth, and the large matrix product in each precision."""

from collections.abc import Callable
from functools import cache, partial

from lower_bounds import ITEM_BYTES, Peaks
import numpy as np
from timing import best_seconds

SIDE = 4096  # of the large matrix product
PROBE_SIDE = 256  # of the product that decides whether a precision is worth a reference
PIECES = 256  # of an array that threads read
READ_MB = {'cpu': 1024, 'cuda': 8192}


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
    return x.nbytes / best_seconds(lambda: read(x), 'cpu', seconds)


def device_read_bandwidth(megabytes: int, seconds: float) -> float:
    """Return the bytes per second that a GPU reads: the faster of torch's sum and maximum."""
    import torch

    free = torch.cuda.mem_get_info()[0]
    x = torch.ones(min(megabytes * 2**20, free // 4) // 4, device='cuda')
    best = min(best_seconds(call, 'cuda', seconds / 2) for call in (x.sum, x.amax))
    return x.numel() * 4 / best


def matrix_rate(device: str, dtype: str, side: int, seconds: float) -> float:
    """Return the operations per second of torch's product of two random square matrices."""
    import torch

    left, right = (
        torch.randn(side, side, device=device).to(getattr(torch, dtype)) for _ in range(2)
    )
    call = partial(torch.mm, left, right, out=torch.empty_like(left))
    return 2 * side**3 / best_seconds(call, device, seconds)


@cache
def slower_than_float32(device: str, dtype: str) -> str:
    """Return why torch's product in a precision is no reference here; empty if it is one."""
    if dtype == 'float32':
        return ''
    rate, wide = (matrix_rate(device, name, PROBE_SIDE, 0.02) for name in (dtype, 'float32'))
    if rate >= wide:
        return ''
    from results import instruction_sets

    native = [
        name
        for name in instruction_sets()
        if name.startswith(('avx512_bf16', 'avx512_fp16', 'amx'))
    ]
    return (
        f'torch product in {dtype}: {rate / 1e9:.1f} G operations/s, slower than float32 '
        f'({wide / 1e9:.1f}); half-precision instructions here: {", ".join(native) or "none"}'
    )


def measure_peaks(device: str, seconds: float) -> Peaks:
    """
    Measure all peaks of a device; the best run counts: a bound must lie below every measurement.

    :param seconds: duration of each measurement.
    """
    megabytes = READ_MB[device]
    rates = dict.fromkeys(ITEM_BYTES, 0.0)
    for dtype in ITEM_BYTES:
        if not slower_than_float32(device, dtype):
            # not every library is at its best with the larger matrix
            rates[dtype] = max(
                matrix_rate(device, dtype, size, seconds) for size in (SIDE, SIDE // 2)
            )
    if device == 'cuda':
        return Peaks(device_read_bandwidth(megabytes, seconds), rates).widened()
    import numba as nb

    read = max(read_bandwidth(megabytes, n, seconds) for n in {1, nb.get_num_threads()})
    return Peaks(read, rates).widened()
