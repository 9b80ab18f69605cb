# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The window of a query: its latest images, and their distances to all places.

A recognizer has one window, which is all that is reset between two queries beside running means:
:class:`stavpr_ros.method.window.FilterWindow` in mode robust, a window of
:mod:`stavpr_ros.method.lm_dtw_window` where sequences are matched by LM-DTW.
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.match import WindowMatch
from stavpr_ros.prepare.normalization import z_normalized

# An image of the window:
# stamp       ns; 0 = unknown
# change      from the image before; mode robust
# number      of the filter's last update; images of a camera at rest share one
# is_matched  it had a match as the middle image
WINDOW_IMAGE = np.dtype([('stamp', 'i8'), ('change', 'f8'), ('number', 'i8'), ('is_matched', '?')])


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
        before = min(len(self.images), self.length - 1)
        if self._end == len(self._images):
            self._move_to_front(before)
        self._images[self._end] = stamp, change, number, False
        self._end += 1
        self.images = self._images[self._end - before - 1 : self._end]

    def _move_to_front(self, count: int) -> None:
        """Move the newest images, so many, from the end of the memory to its front."""
        self._images[:count], self._end = self._images[self._end - count :], count

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
    def match(self) -> WindowMatch:
        """Return the match of the images in the window, in mode paper of a full one."""

    def match_newest(self) -> WindowMatch:
        """
        Return the match of the newest images, since the camera has come to the map.

        :returns: without a sequence where the full window shows the same, or in loop closure and
            mode paper.
        """
        return WindowMatch()

    def match_oldest(self, is_matched: bool) -> WindowMatch:
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

    def grow(self, places: int) -> None:
        """Make room for more places of a route; a map has none."""
        raise NotImplementedError

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self.first += count
