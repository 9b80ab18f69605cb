# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Block-wise iteration over the places of a map, which may be in its file and exceed the memory.

Blocks are small: threads that share one would wait for each other most of the time. Each block is
computed by one thread, several blocks at the same time.
"""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import numba as nb
import numpy as np
from stavpr_ros.alignment.cpu.dot import change_between
from stavpr_ros.alignment.cpu.int8 import Int8Strips
from stavpr_ros.compilation import parallel_kernel
from stavpr_ros.features import LocalFeatures
from stavpr_ros.memory import aligned_empty
from stavpr_ros.threads import thread_count

PIECE = 256  # places read or centered at a time
MAX_LAG = 5  # places apart up to which the changes of a map are learned
LARGE_CHANGE = 0.97  # quantile of changes from place to place
REST, SLOW = 0.02, 0.1  # shares of it: of a camera at rest at most, and of a slow one
Block = TypeVar('Block')


class Int8Features(LocalFeatures):
    """Features of a map in int8, one byte a value: ``strips`` are rounded."""

    strips: Int8Strips  # type: ignore[assignment]

    def __post_init__(self) -> None: ...


def convert_blocks(
    features: LocalFeatures, convert: Callable[[LocalFeatures], Block]
) -> Iterator[tuple[slice, Block]]:
    """Yield the converted blocks, in their order."""
    n, threads = len(features), thread_count()
    slices = [slice(low, min(low + PIECE, n)) for low in range(0, n, PIECE)]
    if threads == 1 or len(slices) <= 1:
        for places in slices:
            yield places, convert(features[places])
        return
    pending: deque[tuple[slice, Future[Block]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for places in slices:
            future = pool.submit(lambda places: convert(features[places]), places)
            pending.append((places, future))
            if len(pending) > threads:
                first, future = pending.popleft()
                yield first, future.result()
        for first, future in pending:
            yield first, future.result()


def convert_features(
    features: LocalFeatures,
    convert: Callable[[np.ndarray], np.ndarray] = lambda strips: strips,
    visit: Callable[[np.ndarray], None] = lambda strips: None,
    rounds: bool = False,
) -> LocalFeatures:
    """
    Return new features, converted block by block.

    :param visit: called with the strips of each converted block, before they are rounded.
    :param rounds: return :class:`Int8Features`.
    """
    shape = *features.weights.shape, features.dimension
    strips: Any = Int8Strips(*shape) if rounds else aligned_empty(shape)
    for places, block in convert_blocks(features, lambda block: convert(block.strips)):
        visit(block)
        strips[:, places] = block
    kind = Int8Features if rounds else LocalFeatures
    return kind(strips, features.weights, features.settings, features.cells)


class PlaceChanges:
    """
    Changes of places that come in blocks, in their order.

    The change of two images is 1 less the mean cosine similarity of their strips, each with the
    one in the same place.

    :param n: places; 0 = blocks are ignored.
    :param apart: most places apart.

    ``changes`` of each place from the places 1, 2, ... before it, shape (apart, n), float32; 0
    where there is no such place.
    """

    def __init__(self, n: int, apart: int) -> None:
        self.changes: np.ndarray = np.zeros((apart, n), np.float32)
        self._count = 0
        self._latest: np.ndarray | None = None

    def add(self, strips: np.ndarray) -> None:
        """Add the next places, unit-norm strips (W, m, d), float32."""
        m, n = strips.shape[1], self.changes.shape[1]
        if not n or not m:
            return
        block = np.ascontiguousarray(strips)
        if self._latest is not None:
            block = np.concatenate([self._latest, strips], axis=1)
        before = block.shape[1] - m
        out = np.empty(block.shape[1], np.float32)
        for apart in range(1, min(len(self.changes), block.shape[1] - 1) + 1):
            _changes(block, apart, out)
            first = max(before, apart)
            self.changes[apart - 1, self._count + first - before : self._count + m] = out[first:]
        self._count += m
        self._latest = block[:, -len(self.changes) :].copy()


def change_weights(changes: np.ndarray) -> np.ndarray:
    """
    Return how much each place counts, (n,): less where the camera was at rest or slow.

    Nothing below a change from the place before of ``REST``, fully above ``SLOW`` of the large
    changes, and in proportion between; the largest, from one drive to another, do not matter.

    :param changes: of each place from the one before, (n,); the first does not matter.
    """
    large = float(np.quantile(changes, LARGE_CHANGE, method='lower')) if len(changes) else 0.0
    if not large:
        return np.ones(len(changes))
    weights: np.ndarray = np.clip((changes / large - REST) / (SLOW - REST), 0, 1)
    weights[:1] = 1
    return weights


@parallel_kernel
def _changes(strips, apart, out):  # type: ignore[no-untyped-def]
    """Write the change of each place of (W, n, d) from the one ``apart`` places before, (n,)."""
    for y in nb.prange(apart, strips.shape[1]):
        out[y] = change_between(strips[:, y], strips[:, y - apart])
