# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The window of the query, and the search of mode robust over it.

How the change of two images grows with the number of places in between is learned from the map
(:mod:`stavpr_ros.recognition.map_change`), so that the query's changes show how fast it moves.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stavpr_ros.alignment.lm_dtw import padded_width, SequenceMatch
from stavpr_ros.alignment.path import NO_PATH
from stavpr_ros.checks import no_nan
from stavpr_ros.recognition.map_change import APART, MapChange
from stavpr_ros.recognition.place_filter import CLOSE, distinct, NEGLIGIBLE, PlaceFilter
from stavpr_ros.recognition.robust import change_between, FilterSettings
from stavpr_ros.recognition.sessions import Sequences, SessionLayout
import torch

SMOOTHED = 5  # latest changes of the query whose mean predicts the speed
OFFSET = 0.02  # added to changes before the logarithm: noise between equal views
FLOOR = 1e-3  # least relative probability of a speed


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
    :param sequences: returns the costs of all sequences, shape (n,), +inf where there is none,
        and their middle places, shape (n,); valid until the next search.
    """

    nearest: SequenceMatch | None = None
    path: np.ndarray = field(default_factory=lambda: NO_PATH)
    sequences: Callable[[], Sequences] = _no_sequences


Search = Callable[[int], WindowMatch]
"""Matches a full window; the argument is the radius in places of the non-maximum suppression."""


class ImageChange(MapChange):
    """
    Changes of the query, read by those of the map.

    :param places: places that there is room for.
    """

    def __init__(self, places: int, settings: FilterSettings) -> None:
        super().__init__(places, settings)
        self.reset()

    def _update_curve(self) -> None:
        super()._update_curve()
        changes = np.interp(self._settings.speeds, np.arange(APART + 1), self.curve)
        self._expected = np.log(changes + OFFSET)  # by speed

    def reset(self) -> None:
        """Forget the query."""
        self._last: np.ndarray | None = None
        self._latest: deque[float] = deque(maxlen=SMOOTHED)

    def next_query(self, strips: np.ndarray) -> float:
        """Return the change of the query's next image (W, d) from the one before, 1 at first."""
        change = 1.0 if self._last is None else change_between(strips, self._last)
        self._last = strips
        return change

    def recenter_query(self, strips: np.ndarray) -> None:
        """Take the query's last image (W, d) again: its mean has changed. None after a reset."""
        if self._last is not None:
            self._last = strips

    def is_standstill(self, change: float) -> bool:
        """Whether the query's images are equal up to noise: the camera stands, or it is dark."""
        return bool(change < self.standstill)

    def weight(self, change: float) -> float:
        """Return the exponent alpha of the image's likelihood."""
        s = self._settings
        relative = change / max(float(self.curve[1]), 1e-6)
        return s.weight * min(s.most_change, max(s.least_change, relative))

    def speed_weights(self, change: float) -> np.ndarray:
        """Return the relative probability of each speed after another change, (V,)."""
        self._latest.append(change)
        seen = np.log(sum(self._latest) / len(self._latest) + OFFSET)
        off = (seen - self._expected) / self._settings.change_deviation
        return np.asarray(np.exp(-0.5 * off**2) + FLOOR)


class FilterSearch:
    """
    A :class:`PlaceFilter` fed image by image, and read at the middle of the window.

    The distance of a match is 1 less the probability that its place is right.

    :param buffer: the window.
    :param layout: of the places of several sessions in the columns of the buffer.
    :param to_oldest: states are followed back to the oldest image of the window, instead of the
        middle one: :meth:`at` any image.
    :param on_device: the filter is computed on the CUDA device where the buffer is.
    """

    def __init__(
        self,
        buffer: SequenceBuffer,
        settings: FilterSettings | None = None,
        layout: SessionLayout | None = None,
        to_oldest: bool = False,
        on_device: bool = False,
    ) -> None:
        self.buffer, self._layout, self.on_device = buffer, layout, on_device
        settings = settings or FilterSettings()
        self._middle = (buffer.length - 1) // 2
        gaps, places = None, buffer.places
        if layout is not None:
            gaps, places = layout.gaps, len(layout.columns)
        lag = buffer.length - 1 - (0 if to_oldest else self._middle)
        filter_class: Any = PlaceFilter
        if on_device:
            from stavpr_ros.recognition.cuda_filter import CudaPlaceFilter

            filter_class = CudaPlaceFilter
        self.filter = filter_class(buffer.places, lag, settings, gaps)
        self.change = ImageChange(places, settings)
        self._speeds = settings.speeds
        self._images: deque[int] = deque(maxlen=buffer.length)  # the filter's image of each

    def reset(self) -> None:
        """Forget the query."""
        self.filter.reset()
        self.change.reset()
        self._images.clear()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self.filter.grow(places)
        self.change.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self.filter.evict(count)
        self.change.evict(count)

    def update(self, z: np.ndarray | torch.Tensor, change: float) -> None:
        """
        Advance by an image.

        An image of a camera that stands adds nothing. Where the map's own images are equal, in a
        dark tunnel, it may move: the filter goes on at its speed, without evidence.

        :param z: z-normalized distances to the places, (m,), float32; on the filter's device.
        :param change: of the image, from :class:`ImageChange`.
        """
        if not (self.filter.count and self.change.is_standstill(change)):
            self.filter.update(z, self.change.weight(change), self._speed_weights(change))
        elif self.change.unlit(self._by_place(len(z))):
            self.filter.update(z, 0.0, np.ones(len(self._speeds)))
        self._images.append(self.filter.count - 1)

    def _by_place(self, n: int) -> np.ndarray:
        probabilities = self.filter.places_of_states()[:n]
        return probabilities if self._layout is None else probabilities[self._layout.columns]

    def _speed_weights(self, change: float) -> np.ndarray:
        if not self.filter.count:
            return np.ones(len(self._speeds))  # of the first image no change is known
        return self.change.speed_weights(change)

    def __call__(self, nms_radius: int) -> WindowMatch:
        return self.at(self._middle, nms_radius)

    def at(self, position: int, nms_radius: int) -> WindowMatch:
        """
        Return the match of an image by all images of the window.

        :param position: of the image in the window, not before the lag of the filter.
        :param nms_radius: see :data:`Search`.
        """
        n, first = self.buffer.known, self.buffer.first
        if not n:
            return WindowMatch()
        newest = self._images[-1]
        belief = self.filter.belief(n, newest - self._images[position])
        places, probabilities = belief.probabilities(n)
        if not places.size:
            return self._nowhere(n, first)
        best = int(np.argmax(probabilities))
        if self._layout is not None:
            places, probabilities, best = self._layout.shared(belief, CLOSE)
        near = np.abs(belief.places - places[best]) <= CLOSE
        weights = belief.weights[near]
        middle = round(float(belief.places[near] @ weights / weights.sum()))
        path = self._path(belief.ways[near][np.argmax(weights)], position)
        second, found = self._second_best(n, places, probabilities, middle, nms_radius)
        path[:, 1] += first
        match = SequenceMatch(
            first=int(path[0, 1]),
            last=int(path[-1, 1]),
            middle=middle + first,
            distance=float(1 - probabilities[best]),
            second_best_index=second + first if found > 0 else -1,
            second_best_distance=1 - found if found > 0 else float('nan'),
        )
        return WindowMatch(match, path, lambda: self._sequences(n, first, places, probabilities))

    def _second_best(
        self, n: int, places: np.ndarray, probabilities: np.ndarray, middle: int, radius: int
    ) -> tuple[int, float]:
        """Return the most probable place beyond a radius, and its probability, 0 if none."""
        around = np.arange(max(0, middle - radius), min(n, middle + radius + 1))
        now, faint = self.filter.most_probable(distinct(np.append(around, places)))
        faint *= NEGLIGIBLE
        apart = np.abs(places - middle) > radius
        if apart.any():
            second = int(np.argmax(np.where(apart, probabilities, 0)))
            if probabilities[second] >= faint:
                return int(places[second]), float(probabilities[second])
        return now, faint

    def _sequences(
        self, n: int, first: int, places: np.ndarray, probabilities: np.ndarray
    ) -> Sequences:
        """Return the costs of all places; of improbable ones by the filter's state today."""
        every = self.filter.places_of_states()[:n] * np.float64(NEGLIGIBLE)
        every[places] = probabilities
        return np.where(every > 0, 1 - every, np.inf), np.arange(first, first + n)

    def _nowhere(self, n: int, first: int) -> WindowMatch:
        """Return the place that is most probable now, with the distance 1."""
        nothing = np.empty(0, np.int64)
        place = self.filter.most_probable(nothing)[0] + first
        match = SequenceMatch(place, place, place, 1.0, -1, float('nan'))
        length = self.buffer.length
        path = np.stack([np.arange(length), np.full(length, place)], axis=1).astype(np.int32)
        return WindowMatch(match, path, lambda: self._sequences(n, first, nothing, np.empty(0)))

    def _path(self, way: np.ndarray, position: int) -> np.ndarray:
        """Return the place of each image, (l, 2); before the one at a position at one speed."""
        images = np.array(self._images)
        back = images[-1] - images
        lag = int(back[position])
        places = self.filter.way(way, lag)
        slope = (places[0] - places[lag]) / lag if lag else self._speeds[way[3]]
        earlier = np.maximum(back - lag, 0) * slope
        path = places[np.minimum(back, lag)] - np.rint(earlier).astype(np.int32)
        lowest = 0 if self._layout is None else self._layout.first_column(places[0])
        return np.stack([np.arange(len(path)), np.maximum(path, lowest)], axis=1).astype(np.int32)
