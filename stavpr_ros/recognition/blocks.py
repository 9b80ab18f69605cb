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

import numba as nb
import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.compilation import parallel_kernel
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
    see: Callable[[torch.Tensor], None] = lambda strips: None,
) -> LocalFeatures:
    """
    Return new features: those of one block after the other, converted.

    :param see: called with the strips of each converted block.
    """
    shape = (*features.weights.shape, features.dimension)
    strips = torch.empty(shape, device=features.weights.device)
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


class PlaceChanges:
    """
    Changes of places that come in blocks, in their order.

    The change of two images is 1 less the mean cosine similarity of their strips, each with the
    one in the same place.

    :param n: places; 0 = blocks are not looked at.
    :param apart: most places apart.

    ``changes`` holds those of each place from the ones 1, 2, ... places before, shape (apart, n),
    float32; 0 where there are no such.
    """

    def __init__(self, n: int, apart: int) -> None:
        self.changes: np.ndarray = np.zeros((apart, n), np.float32)
        self._count = 0
        self._latest: torch.Tensor | None = None

    def add(self, strips: torch.Tensor) -> None:
        """Add the next places, unit-norm strips (W, m, d), of any type."""
        m, n = strips.shape[1], self.changes.shape[1]
        if not n or not m:
            return
        strips = strips.float().cpu()
        block = strips if self._latest is None else torch.cat([self._latest, strips], dim=1)
        before = block.shape[1] - m
        out = np.empty(block.shape[1], np.float32)
        for apart in range(1, min(len(self.changes), block.shape[1] - 1) + 1):
            _changes(block.contiguous().numpy(), apart, out)
            first = max(before, apart)
            self.changes[apart - 1, self._count + first - before : self._count + m] = out[first:]
        self._count += m
        self._latest = block[:, -len(self.changes) :].clone()


@parallel_kernel
def _changes(strips, apart, out):  # type: ignore[no-untyped-def]
    """Write the change of each place of (W, n, d) from the one ``apart`` places before, (n,)."""
    for y in nb.prange(apart, strips.shape[1]):
        out[y] = change_between(strips[:, y], strips[:, y - apart])
