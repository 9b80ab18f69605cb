"""What the machine can do at most: read bandwidth, and the large matrix product in each precision."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from floors import ITEM_BYTES, Ceilings
from timing import synchronizer, timed

SIDE = 4096  # of the large matrix product
READ_MB = {'cpu': 1024, 'cuda': 8192}


def best_seconds(call: Callable[[], Any], device: str, seconds: float) -> float:
    """Return the least time of a call, of as many runs as fit, but at least three after one to warm up."""
    job = timed(call, synchronizer(device))
    job()
    end = time.perf_counter() + seconds
    taken = [job() for _ in range(3)]
    while time.perf_counter() < end:
        taken.append(job())
    return min(taken)


def _reader(threads: int) -> Callable[[np.ndarray], float]:
    """Compile a sum over an array in as many pieces as threads."""
    import numba as nb

    # in any order of addition, or the sum would wait for the additions instead of the memory
    @nb.njit(parallel=threads > 1, nogil=True, fastmath={'reassoc', 'nsz'})
    def read(x: np.ndarray) -> float:
        piece = x.size // threads
        total = np.zeros(threads * 16, x.dtype)  # a cache line each
        for t in nb.prange(threads):
            part = x.dtype.type(0)
            for i in range(t * piece, (t + 1) * piece):
                part += x[i]
            total[t * 16] = part
        return total.sum()

    return read


def read_bandwidth(megabytes: int, threads: int, seconds: float) -> float:
    """Return the bytes a second that so many cores read from memory."""
    x = np.ones(megabytes * 2**20 // 4, np.float32)
    read = _reader(threads)
    return x.nbytes / best_seconds(lambda: read(x), 'cpu', seconds)


def device_read_bandwidth(megabytes: int, seconds: float) -> float:
    """Return the bytes a second that a GPU reads: the faster of torch's sum and its largest element."""
    import torch

    free = torch.cuda.mem_get_info()[0]
    x = torch.ones(min(megabytes * 2**20, free // 4) // 4, device='cuda')
    best = min(best_seconds(call, 'cuda', seconds / 2) for call in (x.sum, x.amax))
    return x.numel() * 4 / best


def is_slow(dtype: str, device: str) -> bool:
    """Whether torch's large products in this precision take minutes: those in float16 on CPUs."""
    return dtype == 'float16' and device == 'cpu'


def matrix_peak(device: str, dtype: str, side: int, seconds: float) -> float:
    """Return the operations a second of torch's product of two random matrices, of side ``side`` or less."""
    import torch

    peak = 0.0
    # not every library is at its best with the larger one
    for size in (side // 8,) if is_slow(dtype, device) else (side, side // 2):
        left, right = (torch.randn(size, size, device=device).to(getattr(torch, dtype)) for _ in range(2))
        call = partial(torch.mm, left, right, out=torch.empty_like(left))
        peak = max(peak, 2 * size**3 / best_seconds(call, device, seconds / 2))
    return peak


def measure_ceilings(device: str, seconds: float = 1.0, side: int = SIDE, megabytes: int = 0) -> Ceilings:
    """
    Measure all ceilings of a device; the best of many runs, since a floor must lie below every figure.

    :param seconds: how long to try each.
    """
    megabytes = megabytes or READ_MB[device]
    peaks = {dtype: matrix_peak(device, dtype, side, seconds) for dtype in ITEM_BYTES}
    if device == 'cuda':
        return Ceilings(device_read_bandwidth(megabytes, seconds), peaks).widened()
    import numba as nb

    one = read_bandwidth(megabytes, 1, seconds)
    every = read_bandwidth(megabytes, nb.get_num_threads(), seconds) if nb.get_num_threads() > 1 else one
    return Ceilings(max(one, every), peaks, one).widened()
