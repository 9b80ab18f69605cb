# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All places of a map, some at a time: they may be in its file, and need not fit into memory.

Blocks are small, so that threads which share the work of one block would wait for each other most
of the time. Each is computed by one thread, several of them at the same time.
"""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

from stavpr_ros.features import LocalFeatures
import torch

PIECE = 256  # places read or centered at a time


def blocks(features: LocalFeatures) -> Iterator[tuple[slice, LocalFeatures]]:
    """Yield features some places at a time."""
    for places in _slices(features):
        yield places, features[places]


def converted_blocks(
    features: LocalFeatures, convert: Callable[[LocalFeatures], torch.Tensor]
) -> Iterator[tuple[slice, torch.Tensor]]:
    """
    Yield what a function makes of the blocks, in their order.

    Meanwhile torch has one thread, on the calling thread too.
    """
    slices = _slices(features)
    with one_thread() as threads:
        if threads == 1 or len(slices) <= 1:
            for places in slices:
                yield places, convert(features[places])
            return
        pending: deque[tuple[slice, Future[torch.Tensor]]] = deque()
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            for places in slices:
                of_block = pool.submit(lambda places: convert(features[places]), places)
                pending.append((places, of_block))
                if len(pending) > threads:
                    first, future = pending.popleft()
                    yield first, future.result()
            for first, future in pending:
                yield first, future.result()


def converted(
    features: LocalFeatures,
    convert: Callable[[torch.Tensor], torch.Tensor],
    dtype: torch.dtype,
    see: Callable[[torch.Tensor], None] = lambda strips: None,
) -> LocalFeatures:
    """
    Return new features of another type: those of one block after the other, converted.

    :param see: called with the strips of each block, before they become another type.
    """
    shape = (*features.weights.shape, features.dimension)
    strips = torch.empty(shape, dtype=dtype, device=features.weights.device)
    for places, some in converted_blocks(features, lambda some: convert(some.strips)):
        see(some)
        strips[:, places] = some
    return LocalFeatures(strips, features.weights, features.settings, features.cells)


@contextmanager
def one_thread() -> Iterator[int]:
    """Let torch have one thread on this one; yields how many it had."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield before
    finally:
        torch.set_num_threads(before)


def _slices(features: LocalFeatures) -> list[slice]:
    n = len(features)
    return [slice(low, min(low + PIECE, n)) for low in range(0, n, PIECE)]
