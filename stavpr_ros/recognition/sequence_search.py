# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window of the query, and the nearest sequence of the map to it."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from stavpr_ros.alignment.lm_dtw import (
    best_match,
    match_padded,
    padded_width,
    SequenceMatch,
    trace_sequence,
)
from stavpr_ros.alignment.path import NO_PATH
from stavpr_ros.checks import no_nan
from stavpr_ros.recognition.robust import ZNormalization
import torch

Sequences = tuple[np.ndarray, np.ndarray]


class SequenceBuffer:
    """
    A ring of the last l rows that always lies contiguous in memory, oldest row first.

    Every row is written twice, l rows apart, so that the last l rows are one slice of the memory.
    Rows are checked when they are pushed; the searches over the buffer trust them.

    :param length: rows l.
    :param places: places n of the map.
    :param k: places that one start of LM-DTW sees.
    :param row_width: words from row to row for n places and k; the padding that a kernel needs
        behind the places is +inf.
    :param device: of the memory.
    """

    def __init__(
        self,
        length: int,
        places: int,
        k: int,
        row_width: Callable[[int, int], int] = padded_width,
        device: torch.device | str = 'cpu',
    ) -> None:
        self.length, self.k = int(length), k
        self._row_width = row_width
        self._first = self._known = self._count = 0
        self._stamps: deque[int] = deque(maxlen=self.length)
        self._allocate(places, torch.device(device))

    def _allocate(self, places: int, device: torch.device) -> None:
        self.places = places
        self.memory = torch.full(
            (2 * self.length, self._row_width(places, self.k)), torch.inf, device=device
        )
        twice = self.memory.view(2, self.length, -1)
        self._slots = [twice[:, slot, :places] for slot in range(self.length)]

    def __len__(self) -> int:
        return min(self._count, self.length)

    @property
    def full(self) -> bool:
        """As many rows as the window is long have been pushed."""
        return self._count >= self.length

    @property
    def stamps(self) -> tuple[int, ...]:
        """Stamps of the images in the window, ns, oldest first."""
        return tuple(self._stamps)

    @property
    def first(self) -> int:
        """Index of the first place that is not evicted: the number of evicted places."""
        return self._first

    @property
    def known(self) -> int:
        """Places with an entry in any row of the window; all others are +inf."""
        return self._known

    @property
    def oldest(self) -> int:
        """Row of ``memory`` where the window begins."""
        return self._count % self.length

    def push(self, row: torch.Tensor, stamp: int = 0) -> None:
        """
        Add the distances of the newest image and drop the oldest.

        :param row: shape (m,), float32, of the first m <= n places; the others become +inf. On the
            buffer's device.
        :param stamp: of the image, ns; 0 = unknown.
        :raises InputError: NaN or -inf in the row; the buffer is unchanged. Not checked on a CUDA
            device, which would have to be waited for.
        """
        if not row.is_cuda and not float(row.sum()) > -torch.inf:
            no_nan(row.numpy(), 'image distances')
        slot, m = self._slots[self._count % self.length], len(row)
        if m == self.places:
            slot.copy_(row)
        else:
            slot[:, :m], slot[:, m:] = row, torch.inf
        self._known = max(self._known, m)
        self._stamps.append(stamp)
        self._count += 1

    def rows(self) -> torch.Tensor:
        """Return the window, (l, n + padding), float32, a contiguous view; padding is +inf."""
        return self.memory[self.oldest : self.oldest + self.length]

    def clear(self) -> None:
        """Empty the window."""
        self.memory.fill_(torch.inf)
        self._stamps.clear()
        self._known = self._count = 0

    def grow(self, places: int) -> None:
        """Make room for more places; in the rows of the window they are +inf."""
        rows, before = self.memory, self.places
        self._allocate(places, rows.device)
        self.memory[:, :before] = rows[:, :before]

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up, and new ones have room behind them."""
        kept = self.places - count
        self.memory[:, :kept] = self.memory[:, count : self.places].clone()
        self.memory[:, kept : self.places] = torch.inf
        self._known = max(0, self._known - count)
        self._first += count


def _no_sequences() -> Sequences:
    return np.empty(0, np.float32), np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class WindowMatch:
    """
    The nearest sequence of a window, and all others.

    :param nearest: with the second best; None where no sequence is possible.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param sequences: returns the costs of all sequences, shape (n,), float32, +inf where there is
        none, and their middle places, shape (n,); valid until the next search.
    """

    nearest: SequenceMatch | None = None
    path: np.ndarray = field(default_factory=lambda: NO_PATH)
    sequences: Callable[[], Sequences] = _no_sequences


Search = Callable[[int], WindowMatch]
"""Matches a full window; the argument is the radius in places of the non-maximum suppression."""


class LmDtwSearch:
    """
    LM-DTW on the CPU (section 4 of the paper).

    :param buffer: the window.
    :param znorm: applied to the distances.
    """

    def __init__(self, buffer: SequenceBuffer, znorm: ZNormalization) -> None:
        self.buffer, self._znorm = buffer, znorm

    def __call__(self, nms_radius: int) -> WindowMatch:
        buffer = self.buffer
        n, k, first = buffer.known, buffer.k, buffer.first
        window = buffer.rows().numpy()
        if self._znorm.reference or n < buffer.places:
            costs = np.full((buffer.length, padded_width(n, k)), np.inf, np.float32)
            costs[:, :n] = self._znorm.scaled(window[:, :n])
            window = costs
        matches = match_padded(window, n, k)
        nearest = best_match(matches, nms_radius)
        path = NO_PATH
        if nearest is not None:
            path = trace_sequence(window[:, :n], nearest.first, k).path
        return _renumbered(
            nearest, path, lambda: (matches.distances, matches.middles + first), first
        )


def _renumbered(
    nearest: SequenceMatch | None, path: np.ndarray, sequences: Callable[[], Sequences], first: int
) -> WindowMatch:
    """Return a match whose places are counted from the first place ever, evicted ones included."""
    if nearest is None or not first:
        return WindowMatch(nearest, path, sequences)
    path[:, 1] += first
    second_best = nearest.second_best_index
    moved = replace(
        nearest,
        first=nearest.first + first,
        last=nearest.last + first,
        middle=nearest.middle + first,
        second_best_index=second_best + first if second_best >= 0 else -1,
    )
    return WindowMatch(moved, path, sequences)
