# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The window of a query: its latest images, and their distances to all places.

A recognizer has one window, which is all that is reset between two queries beside running means:
:class:`stavpr_ros.method.window.FilterWindow` in mode robust, a window of
:mod:`stavpr_ros.method.lm_dtw_window` where sequences are matched by LM-DTW.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from stavpr_ros.alignment.lm_dtw import padded_width
from stavpr_ros.checks import no_nan
from stavpr_ros.memory import aligned_empty
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import WindowMatch
from stavpr_ros.prepare.normalization import z_normalized

# An image of the window:
# stamp       ns; 0 = unknown
# change      from the image before; mode robust
# number      of the filter's last update; images of a camera at rest share one
# is_matched  it had a match as the middle image
WINDOW_IMAGE = np.dtype([('stamp', 'i8'), ('change', 'f8'), ('number', 'i8'), ('is_matched', '?')])


class SequenceBuffer:
    """
    A ring of the latest l rows of distances.

    Rows are checked when they are pushed; windows trust them.

    :param length: rows l.
    :param places: columns n.
    :param k: places that one start of LM-DTW covers.
    :param row_width: words from row to row for n places and k; the padding that a kernel needs
        behind the places is +inf.

    Each row is written twice, l rows apart: the latest l rows are always one slice of the memory,
    oldest row first, as LM-DTW takes them.
    """

    def __init__(
        self,
        length: int,
        places: int,
        k: int,
        row_width: Callable[[int, int], int] = padded_width,
    ) -> None:
        self.length, self.k = int(length), k
        self._row_width = row_width
        self.first = 0  # index of the first place that is not evicted
        self._order = np.tile(np.arange(self.length), 2)
        self.known = 0  # places with an entry in any row of the window; all others are +inf
        self._count = 0
        self._allocate(places)

    def _allocate(self, places: int) -> None:
        self.places = places
        shape = 2 * self.length, self._row_width(places, self.k)
        self.memory: Any = self._filled(shape)
        copies = self.memory.reshape(2, self.length, -1)
        self._slots = [copies[:, slot, :places] for slot in range(self.length)]

    def _filled(self, shape: tuple[int, int]) -> Any:
        """Return memory filled with +inf."""
        memory = aligned_empty(shape)
        memory[:] = np.inf
        return memory

    def __len__(self) -> int:
        return min(self._count, self.length)

    @property
    def full(self) -> bool:
        """As many rows as the window is long have been pushed."""
        return self._count >= self.length

    @property
    def oldest(self) -> int:
        """Row of ``memory`` where the window begins."""
        return self._count % self.length

    def push(self, row: np.ndarray) -> None:
        """
        Add the distances of the newest image and drop the oldest.

        :param row: shape (m,), float32, of the first m <= n places; the others become +inf.
        :raises InputError: NaN or -inf in the row; the buffer is unchanged.
        """
        if not row.sum() > -np.inf:
            no_nan(row, 'image distances')
        self._add(row)

    def _add(self, row: Any) -> None:
        slot, m = self._slots[self._count % self.length], len(row)
        slot[:, :m] = row
        if m < self.places:
            slot[:, m:] = np.inf
        self.known = max(self.known, m)
        self._count += 1

    def rows(self) -> np.ndarray:
        """Return the window, (l, n + padding), float32; padding is +inf. A view."""
        return self.memory[self.oldest : self.oldest + self.length]

    def newest(self) -> np.ndarray:
        """Return the row of the newest image, (n,)."""
        return self._slots[self.oldest - 1][0]

    def at(self, columns: np.ndarray, images: int | None = None) -> np.ndarray:
        """
        Return entries of the newest images, oldest first, by columns, (images, m).

        :param images: their number; None = all in the window.
        """
        return self.memory[self._ring(images)[:, None], columns]

    def _ring(self, images: int | None = None) -> np.ndarray:
        """Return the rows of one copy of the newest images, oldest first, (images,)."""
        end = self.oldest + self.length
        return self._order[end - (images or len(self)) : end]

    def clear(self) -> None:
        """Empty the window."""
        self.memory[:] = np.inf
        self.known = self._count = 0

    def grow(self, places: int) -> None:
        """Make room for more places; in the rows of the window they are +inf."""
        rows, before = self.memory, self.places
        self._allocate(places)
        self.memory[:, :before] = rows[:, :before]

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up, and new ones have room behind them."""
        remaining = self.places - count
        self.memory[:, :remaining] = self.memory[:, count : self.places].copy()
        self.memory[:, remaining : self.places] = np.inf
        self.known = max(0, self.known - count)
        self.first += count


class QueryWindow(ABC):
    """
    The latest l images of a query, and the sequence of places that they show.

    :param length: l.
    :param layout: of the places in columns.
    :param normalizes: z-normalize the distances of each image.
    :param around: see :func:`stavpr_ros.prepare.normalization.z_normalized`.

    ``images`` are those in the window, oldest first, (m,), ``WINDOW_IMAGE``.
    """

    def __init__(
        self,
        length: int,
        layout: ColumnLayout,
        normalizes: bool = False,
        around: int = 0,
    ) -> None:
        self.length, self.layout = length, layout
        self.first = self.known = 0
        # one behind the other; at the end, the window moves to the front
        self._images, self._end = np.empty(2 * length, WINDOW_IMAGE), 0
        self.images = self._images[:0]
        self._normalizes, self._around = normalizes, around

    @property
    def changes(self) -> tuple[float, ...]:
        """Change of each image from the one before, oldest first; empty without a filter."""
        return ()

    @property
    def is_standstill(self) -> bool:
        """Whether the newest image equals the one before, up to noise; False without a filter."""
        return False

    @property
    def full(self) -> bool:
        """As many images as the window is long have come."""
        return len(self.images) == self.length

    @abstractmethod
    def push(self, row: Any, strips: np.ndarray, stamp: int) -> None:
        """
        Add the newest image, and drop the oldest.

        :param row: its distances to the places, (n,), float32, as the matcher returns them.
        :param strips: its features, centered, (W, d).
        :param stamp: ns; 0 = unknown.
        """

    @abstractmethod
    def newest_row(self) -> np.ndarray:
        """Return the distances of the newest image to the columns, (width,)."""

    @abstractmethod
    def at(self, columns: np.ndarray) -> np.ndarray:
        """Return the distances of the images to columns, oldest first, (images, m), float32."""

    def _append(self, stamp: int, change: float = 0.0, number: int = 0) -> None:
        rows, before = self._images, min(len(self.images), self.length - 1)
        if self._end == len(rows):
            rows[:before], self._end = rows[self._end - before :], before
        rows[self._end] = stamp, change, number, False
        self._end += 1
        self.images = rows[self._end - before - 1 : self._end]

    def _as_columns(self, row: Any) -> Any:
        """Return distances to the places, normalized, as a row of the buffer."""
        if self._normalizes:
            counted = self._counted(len(row))
            row = z_normalized(row, self._around, counted, self.layout.starts)
        return self.layout.to_columns(row)

    def _counted(self, n: int) -> np.ndarray:
        """Return which of n places count for mean and deviation of a row, (n,), bool."""
        return np.ones(n, bool)

    @abstractmethod
    def match(self, nms_radius: int) -> WindowMatch:
        """
        Return the match of the images in the window, in mode paper of a full one.

        :param nms_radius: of the non-maximum suppression, places.
        """

    def match_newest(self, nms_radius: int) -> WindowMatch:
        """
        Return the match of the newest images, since the camera has come to the map.

        :returns: without a sequence where the full window shows the same, or in loop closure and
            mode paper.
        """
        return WindowMatch()

    def match_oldest(self, nms_radius: int, is_matched: bool) -> WindowMatch:
        """
        Return the match of the oldest image by the whole window, where it had none as the middle.

        :param is_matched: whether the window itself is matched.
        :returns: without a sequence where the oldest image had a match, or the window has none,
            and in mode paper.
        """
        return WindowMatch()

    def reset(self) -> None:
        """Drop all images."""
        self.images, self._end = self._images[:0], 0

    @abstractmethod
    def grow(self, places: int) -> None:
        """Make room for more places."""

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self.first += count


class BufferWindow(QueryWindow):
    """
    A window whose distances are in a buffer.

    :param buffer: empty; others: see :class:`QueryWindow`.
    """

    def __init__(
        self,
        buffer: SequenceBuffer,
        layout: ColumnLayout,
        normalizes: bool = False,
        around: int = 0,
    ) -> None:
        super().__init__(buffer.length, layout, normalizes, around)
        self.buffer = buffer

    def push(self, row: Any, strips: np.ndarray, stamp: int) -> None:
        """See :meth:`QueryWindow.push`."""
        self.buffer.push(self._as_columns(row))
        self._append(stamp)

    def newest_row(self) -> np.ndarray:
        """See :meth:`QueryWindow.newest_row`."""
        return self.buffer.newest()

    def at(self, columns: np.ndarray) -> np.ndarray:
        """See :meth:`QueryWindow.at`."""
        return self.buffer.at(columns[None])

    def reset(self) -> None:
        """Drop all images."""
        super().reset()
        self.buffer.clear()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self.buffer.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        super().evict(count)
        self.buffer.evict(count)
