# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The window of a query: its latest images, and their distances to all places.

A recognizer has one window, which is all that is reset between two queries beside running means:
:class:`stavpr_ros.recognition.filter_window.FilterWindow` in mode robust, a window of
:mod:`stavpr_ros.recognition.lm_dtw_window` where sequences are matched by LM-DTW.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
import sys
from typing import Any

import numpy as np
from stavpr_ros.alignment.lm_dtw import padded_width
from stavpr_ros.checks import no_nan
from stavpr_ros.compilation import kernel
from stavpr_ros.filter.paths import Belief, NO_PLACES
from stavpr_ros.memory import aligned_empty
from stavpr_ros.prepare.normalization import z_normalized
from stavpr_ros.recognition.match import WindowMatch

LONGEST = 4.0  # intervals between images: beyond, the camera stopped, or its speed is unknown


class ColumnLayout:
    """
    Places of one session, or of a route: each is the column of its number.

    :attr:`runs` are the places of each session, ``firsts`` their first ones, ``gaps`` the columns
    between them.
    """

    firsts: np.ndarray = np.zeros(1, np.int64)
    runs: Sequence[slice] = (slice(None),)
    gaps: np.ndarray = NO_PLACES

    def width(self, places: int) -> int:
        """Return the number of columns of so many places."""
        return places

    def spread(self, row: np.ndarray) -> np.ndarray:
        """Return distances to places (n,) as those to columns, +inf in gaps."""
        return row

    def gathered(self, values: np.ndarray) -> np.ndarray:
        """Return the values of the columns that are places, (n,)."""
        return values

    def columns_of(self, places: np.ndarray) -> np.ndarray:
        """Return the columns of places."""
        return places

    def positions_of(self, columns: np.ndarray) -> np.ndarray:
        """Return the numbers of columns among the places; in a gap, of the place before it."""
        return columns

    def positions_from(self, columns: np.ndarray) -> np.ndarray:
        """Return the numbers of columns among the places; in a gap, of the place after it."""
        return columns

    def first_column(self, column: int) -> int:
        """Return the first column of a column's session."""
        return 0

    def session_of(self, place: int) -> tuple[int, int]:
        """Return the first place of a place's session, and the first one behind it."""
        return 0, sys.maxsize

    def shared(self, belief: Belief, n: int, close: int) -> tuple[np.ndarray, np.ndarray, int]:
        """
        Let places of one position share their probability.

        :param n: columns that are known.
        :param close: columns to either side that count for a column, too.
        :returns: columns whose probability is not 0, ascending, and their probabilities; among
            them the most probable one: of the session that is most probable at the most probable
            position.
        """
        columns, probabilities = belief.probabilities(n)
        return columns, probabilities, int(np.argmax(probabilities))

    def positions(self, places: np.ndarray | int) -> np.ndarray:
        """Return positions: those at most nms_radius apart are neighbors in one session."""
        return np.asarray(places)

    def in_places(self, found: WindowMatch) -> WindowMatch:
        """Return a match whose columns have become places, with its second best."""
        return found


class SequenceBuffer:
    """
    A ring of the latest l rows of distances.

    Rows are checked when they are pushed; windows trust them.

    :param length: rows l.
    :param places: columns n.
    :param k: places that one start of LM-DTW covers.
    :param row_width: words from row to row for n places and k; the padding that a kernel needs
        behind the places is +inf.
    :param copies: times that each row is written, l rows apart. 2 = the latest l rows are always
        one slice of the memory, oldest row first, as LM-DTW takes them; 1 = half the memory.
    """

    def __init__(
        self,
        length: int,
        places: int,
        k: int,
        row_width: Callable[[int, int], int] = padded_width,
        copies: int = 2,
    ) -> None:
        self.length, self.k, self._copies = int(length), k, copies
        self._row_width = row_width
        self.first = 0  # index of the first place that is not evicted
        self.known = 0  # places with an entry in any row of the window; all others are +inf
        self._count = 0
        self._stamps: deque[int] = deque(maxlen=self.length)
        self._allocate(places)

    def _allocate(self, places: int) -> None:
        self.places = places
        shape = self._copies * self.length, self._row_width(places, self.k)
        self.memory: Any = self._filled(shape)
        copies = self.memory.reshape(self._copies, self.length, -1)
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
    def stamps(self) -> tuple[int, ...]:
        """Stamps of the images in the window, ns, oldest first."""
        return tuple(self._stamps)

    @property
    def oldest(self) -> int:
        """Row of ``memory`` where the window begins."""
        return self._count % self.length

    def push(self, row: np.ndarray, stamp: int = 0) -> None:
        """
        Add the distances of the newest image and drop the oldest.

        :param row: shape (m,), float32, of the first m <= n places; the others become +inf.
        :param stamp: of the image, ns; 0 = unknown.
        :raises InputError: NaN or -inf in the row; the buffer is unchanged.
        """
        if not row.sum() > -np.inf:
            no_nan(row, 'image distances')
        self._add(row, stamp)

    def _add(self, row: Any, stamp: int) -> None:
        slot, m = self._slots[self._count % self.length], len(row)
        slot[:, :m], slot[:, m:] = row, np.inf
        self.known = max(self.known, m)
        self._stamps.append(stamp)
        self._count += 1

    def rows(self) -> np.ndarray:
        """Return the window, (l, n + padding), float32; padding is +inf. A view of two copies."""
        if self._copies == 1:
            return np.roll(self.memory, -self.oldest, axis=0)
        rows: np.ndarray = self.memory[self.oldest : self.oldest + self.length]
        return rows

    def newest(self) -> np.ndarray:
        """Return the row of the newest image, (n,)."""
        row: np.ndarray = self._slots[self.oldest - 1][0]
        return row

    def at(self, columns: np.ndarray, images: int | None = None) -> np.ndarray:
        """
        Return entries of the newest images, oldest first, by columns, (images, m).

        :param images: their number; None = all in the window.
        """
        entries: np.ndarray = self.memory[self._ring(images), columns]
        return entries

    def _ring(self, images: int | None = None) -> np.ndarray:
        """Return the rows of one copy of the newest images, oldest first, (images, 1)."""
        newest = self._count + np.arange(-(images or len(self)), 0)[:, None]
        rows: np.ndarray = newest % self.length
        return rows

    def clear(self) -> None:
        """Empty the window."""
        self.memory[:] = np.inf
        self._stamps.clear()
        self.known = self._count = 0

    def grow(self, places: int) -> None:
        """Make room for more places; in the rows of the window they are +inf."""
        rows, before = self.memory, self.places
        self._allocate(places)
        self.memory[:, :before] = rows[:, :before]

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up, and new ones have room behind them."""
        kept = self.places - count
        self.memory[:, :kept] = self.memory[:, count : self.places].copy()
        self.memory[:, kept : self.places] = np.inf
        self.known = max(0, self.known - count)
        self.first += count


class QueryWindow(ABC):
    """
    The latest l images of a query, and the sequence of places that they show.

    :param buffer: of their distances, empty.
    :param layout: of the places in the columns of the buffer.
    :param normalizes: z-normalize the distances of each image.
    :param around: see :func:`stavpr_ros.prepare.normalization.z_normalized`.
    """

    def __init__(
        self,
        buffer: SequenceBuffer,
        layout: ColumnLayout,
        normalizes: bool = False,
        around: int = 0,
    ) -> None:
        self.buffer, self.layout = buffer, layout
        self._normalizes, self._around = normalizes, around

    @property
    def changes(self) -> tuple[float, ...]:
        """Change of each image from the one before, oldest first; empty without a filter."""
        return ()

    @property
    def is_standstill(self) -> bool:
        """Whether the newest image equals the one before, up to noise; False without a filter."""
        return False

    def push(self, row: Any, strips: np.ndarray, stamp: int) -> None:
        """
        Add the newest image, and drop the oldest.

        :param row: its distances to the places, (n,), float32, as the matcher returns them.
        :param strips: its features, centered, (W, d).
        :param stamp: ns; 0 = unknown.
        """
        self.buffer.push(self._as_columns(row), stamp)

    def _as_columns(self, row: Any) -> Any:
        """Return distances to the places, normalized, as a row of the buffer."""
        if self._normalizes:
            counted = self._counted(len(row))
            row = np.concatenate(
                [z_normalized(row[run], self._around, counted[run]) for run in self.layout.runs]
            )
        return self.layout.spread(row)

    def _counted(self, n: int) -> np.ndarray:
        """Return which of n places count for mean and deviation of a row, (n,), bool."""
        return np.ones(n, bool)

    def match(self, nms_radius: int) -> WindowMatch:
        """
        Return the match of the images in the window, in mode paper of a full one.

        :param nms_radius: of the non-maximum suppression, places.
        """
        return self.layout.in_places(self._match(nms_radius))

    @abstractmethod
    def _match(self, nms_radius: int) -> WindowMatch:
        """Return the match of the images in the window, in columns of the buffer."""

    def match_newest(self, nms_radius: int) -> tuple[WindowMatch, int]:
        """
        Return the match of the newest images, since the camera has come to the map.

        :returns: the match, and of how many images: 0 where the full window shows the same, or in
            loop closure and mode paper.
        """
        return WindowMatch(), 0

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
        self.buffer.clear()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self.buffer.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self.buffer.evict(count)


@kernel
def image_times(stamps: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """
    Return the times of images, (m,), float64, ascending, in intervals of most of them.

    A camera that loses images still advances evenly in time: the stamps of a window show where
    images are missing, and those of a map where places are. An interval is 1 where a stamp is
    unknown or not above the one before.

    :param stamps: ns, (m,), int64; 0 = unknown.
    :param numbers: (m,), int64; equal ones are of a camera at rest, for which no time passes.
    """
    steps = np.diff(stamps).astype(np.float64)
    is_known = (steps > 0) & (stamps[:-1] > 0)
    usual = np.median(steps[is_known]) if is_known.any() else 1.0
    times = np.zeros(len(stamps))
    for i in range(len(steps)):
        step = min(steps[i] / usual, LONGEST) if is_known[i] else 1.0
        times[i + 1] = times[i] + (step if numbers[i + 1] > numbers[i] else 0.0)
    return times
