# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Arrays whose memory begins with a cache line: vectors across two are read at half the speed."""

import ctypes
import math

import numpy as np
from numpy.typing import DTypeLike

CACHE_LINE = 64  # bytes


def aligned_empty(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> np.ndarray:
    """Return an array whose content is undefined."""
    return _allocate(np.empty, shape, dtype)


def aligned_zeros(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> np.ndarray:
    """Return an array of zeros; pages that are not written take no memory."""
    return _allocate(np.zeros, shape, dtype)


def is_aligned(array: np.ndarray) -> bool:
    """Return whether an array's memory begins with a cache line."""
    return array.ctypes.data % CACHE_LINE == 0


def _allocate(allocate, shape, dtype):  # type: ignore[no-untyped-def]
    size = math.prod(shape) * np.dtype(dtype).itemsize
    block = allocate(size + CACHE_LINE, np.uint8)
    first = -block.__array_interface__['data'][0] % CACHE_LINE  # faster than block.ctypes
    return block[first : first + size].view(dtype).reshape(shape)


def give_back() -> None:
    """Give freed memory inside the heap back to the system; glibc keeps it otherwise."""
    if trim := getattr(ctypes.CDLL(None), 'malloc_trim', None):
        trim(0)
