# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window of a query, and in mode robust what it shows, by filter, paths and evidence."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
import math
from typing import Any, NamedTuple

import numpy as np
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.method.cells import CellAgreement
from stavpr_ros.method.columns import ColumnLayout
from stavpr_ros.method.evidence import probability_of, Quantities, RecentWindows, unevenness
from stavpr_ros.method.filter import Filter, NEGLIGIBLE, PlaceFilter, SPACING
from stavpr_ros.method.match import Path, WindowMatch, WindowSequences
from stavpr_ros.method.model import (
    APART,
    AROUND,
    CLOSE,
    MODEL,
    Model,
    ON_MAP,
    ROUTE_IMAGES,
    STRAIGHT,
)
from stavpr_ros.method.motion import ImageChange
from stavpr_ros.method.path import centered_place, close_sums, follow
from stavpr_ros.method.place_means import PlaceMeans
from stavpr_ros.prepare.centering import z_normalized

MIN_IMAGES = 2  # of a match by the newest images alone
LEAST = 1e-9  # probability that shares are relative to
NOT_COMPARED: np.ndarray = np.empty(0, np.float32)  # a row without distances

# An image of the window:
# stamp       ns; 0 = unknown
# change      from the image before; 0 in mode paper
# number      of the filter's last update; images of a camera at rest share one
# is_matched  it had a match as the middle image
WINDOW_IMAGE = np.dtype([('stamp', 'i8'), ('change', 'f8'), ('number', 'i8'), ('is_matched', '?')])


class QueryWindow(ABC):
    """
    The latest l images of a query, their distances to all places, and what they show.

    A recognizer has one window, which is all that is reset between two queries beside running
    means.

    :param length: l.
    :param layout: of the places in columns.

    ``images`` are those in the window, oldest first, (m,), ``WINDOW_IMAGE``; ``is_standstill`` is
    whether the newest one equals the one before, up to noise; False without a filter. ``first`` is
    the number of the first place, ``size`` the number of columns that have distances.
    """

    def __init__(self, length: int, layout: ColumnLayout) -> None:
        self.length, self.layout = length, layout
        self.first = self.size = 0
        self.is_standstill = False
        # one behind the other; at the end, the window moves to the front
        self._images, self._end = np.empty(2 * length, WINDOW_IMAGE), 0
        self.images = self._images[:0]

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
            self._images[:before], self._end = self._images[-before:], before
        self._images[self._end] = stamp, change, number, False
        self._end += 1
        self.images = self._images[self._end - before - 1 : self._end]

    def assess(self) -> None:  # noqa: B027 -- mode paper notes nothing
        """Note what the window shows, once it is full: before :meth:`match`, once an image."""

    @abstractmethod
    def match(self) -> WindowMatch:
        """Return the match of the images in the window, full and assessed."""

    def match_newest(self) -> WindowMatch:
        """
        Return the match of the newest images, since the camera has come to the map.

        :returns: without a sequence where the full window shows the same, or in loop closure and
            mode paper.
        """
        return WindowMatch()

    def note_match(self) -> None:
        """Note that the middle image has a match."""
        self.images['is_matched'][(len(self.images) - 1) // 2] = True

    def match_oldest(self) -> WindowMatch:
        """
        Return the match of the oldest image by the whole window, where it had none as the middle.

        :returns: without a sequence where the oldest image had a match, and in mode paper.
        """
        return WindowMatch()

    def reset(self) -> None:
        """Drop all images."""
        self.images, self._end, self.is_standstill = self._images[:0], 0, False

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self.first += count


class View(NamedTuple):
    """
    What the newest l images that moved show.

    :param path: column of each, (l,), int64; position: of the image whose place is sought.
    :param quantities: of the evidence; own: of the window alone; -inf = nothing is probable.
    :param probability: of the place.
    :param candidates, probabilities: columns of the image at the position, (m,) each.
    :param shares: probability of the places of the path, given the place, (l,).
    """

    path: np.ndarray
    position: int
    quantities: Quantities
    own: float
    probability: float
    candidates: np.ndarray
    probabilities: np.ndarray
    shares: np.ndarray


class FilterWindow(QueryWindow):
    """
    The latest images of a query, a filter of those that moved, and what they show.

    :param sequence: l and k.
    :param places: number of places n.
    :param layout: of the places.
    :param is_route: for loop closure: the mean z of each place is subtracted
        (:mod:`stavpr_ros.method.place_means`) and that around it, and paths are compared with no
        others.
    :param constant: of the evidence (:class:`stavpr_ros.features.registry.Kind`).
    :param model: of the filter.

    ``change`` compares images, ``filter`` contains the states, ``recent`` is of the drive;
    ``cells``, of the images, are None unless they are compared.
    """

    filter_class: Callable[..., Filter] = PlaceFilter

    def __init__(
        self,
        sequence: SequenceSettings,
        places: int,
        layout: ColumnLayout,
        is_route: bool = False,
        *,
        constant: float = 0.0,
        model: Model = MODEL,
    ) -> None:
        length, width = sequence.length, layout.width(places)
        super().__init__(length, layout)
        self._is_route = is_route
        self.filter: Filter = self.filter_class(width, length, model, layout.gaps)
        self.change = ImageChange(width, length)
        self._constant, self.recent = constant, RecentWindows()
        self.cells: CellAgreement | None = None
        self._means = PlaceMeans()
        self._width, self._newest = width, NOT_COMPARED
        self._view: View | None = None  # by the latest images that moved
        self._by_half: View | None = None  # by half of them
        self._seam = slice(0, 0)  # columns that the latest path is in, beyond a lap

    def reset(self) -> None:
        """Drop all images."""
        super().reset()
        self.filter.reset()
        self.change.reset()
        self._view = self._by_half = None
        self.recent, self.size = RecentWindows(), 0
        self._newest = NOT_COMPARED
        self._seam, self._means = slice(0, 0), PlaceMeans()
        if self.cells is not None:
            self.cells.reset()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self._width = places
        self.filter.grow(places)
        self.change.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        super().evict(count)
        self.size, self._view = max(0, self.size - count), None
        for part in (self.filter, self.change, self._means):
            part.evict(count)

    def push(self, row: Any, strips: np.ndarray, stamp: int) -> None:
        """See :meth:`QueryWindow.push`."""
        row, change = self._z(row), self.change.next_query(strips)
        if self._is_route:
            row = self._means.correct(row, self.change.is_standstill(change))
        self.add(row, stamp, change, strips)

    def _z(self, row: Any) -> Any:
        """Return distances to the places as z of the columns."""
        around = AROUND * self._is_route
        counted = self.change.distinct(self.layout.along(len(row)))
        return self.layout.to_columns(z_normalized(row, around, counted, self.layout.starts))

    def newest_row(self) -> np.ndarray:
        """See :meth:`QueryWindow.newest_row`; as it was added, also of a camera at rest."""
        more = np.full(self._width - len(self._newest), np.inf, np.float32)
        return np.append(self._newest, more)

    def at(self, columns: np.ndarray) -> np.ndarray:
        """See :meth:`QueryWindow.at`."""
        count = min(self.filter.count, self.length)
        if not count:
            return np.empty((0, len(columns)), np.float32)
        rows = self.images['number'] - (self.filter.count - count)
        return self.filter.z(columns, count)[rows]

    def add(self, z: Any, stamp: int, change: float, strips: np.ndarray) -> None:
        """
        Add the newest image.

        An image of a camera at rest adds nothing. Where the map's own images are equal, in a dark
        tunnel, the camera may move.

        :param z: z-normalized distances to the columns, (m,), float32.
        :param change: from the image before.
        """
        self._newest, self.size = z, max(self.size, len(z))
        if self._seam.stop:
            self.filter.move_back(self._seam, self.layout.lap)
            self._seam = slice(0, 0)
        self.is_standstill = self.change.is_standstill(change)
        moved = not self.filter.count or not self.is_standstill
        if not moved:
            moved = self.change.is_dark_stretch(self.filter.by_place()[: self.size])
        if moved:
            self.filter.update(z, self.change.weight(change))
            if self.cells is not None:
                self.cells.push(strips)
            self._view = self._by_half = None
        self._append(stamp, change, self.filter.count - 1)

    def assess(self) -> None:
        """See :meth:`QueryWindow.assess`; a camera at rest shows nothing new."""
        if not self.size:
            return
        if self._view is None:
            self._view = self._assess(min(self.filter.count, self.length))
            self.recent.add(self._view.own)
        path = self._view.path
        # with the images before the window from which the filter follows states
        before = (path[-1] - path[0]) * SPACING // self.length + CLOSE
        self._seam = self.layout.seam_columns(path - before)
        if self._by_half is None and self._middle == self.filter.count - 1:
            self._by_half = self._assess((len(path) + 1) // 2)

    @property
    def _middle(self) -> int:
        """Return the number of the middle image."""
        return int(self.images['number'][(len(self.images) - 1) // 2])

    def match(self) -> WindowMatch:
        """Return the match of the middle image; of a camera at rest, as before it stopped."""
        if (view := self._view) is None:
            return WindowMatch()
        if self._by_half is not None:  # no later image shows its place: nor do early ones
            probability = min(view.probability, self._by_half.probability)
            view = view._replace(probability=probability)
        return self._match(view, self.images, self._middle)

    def match_newest(self) -> WindowMatch:
        """Return the match of the newest images: :meth:`QueryWindow.match_newest`."""
        if self._is_route or not self.size:
            return WindowMatch()
        count = min(self.filter.count, self.length)
        on_map = self.filter.beliefs(count).probabilities.sum(axis=1) > ON_MAP
        since = count if on_map.all() else int(np.argmin(on_map[::-1]))
        if since < MIN_IMAGES or (since == count == self.length):
            return WindowMatch()
        view, numbers = self._assess(since), self.images['number']
        images = self.images[numbers > numbers[-1] - since]
        middle = int(images['number'][(len(images) - 1) // 2])
        return self._match(view, images, middle)

    def match_oldest(self) -> WindowMatch:
        """See :meth:`QueryWindow.match_oldest`."""
        if self.images['is_matched'][0]:
            return WindowMatch()
        oldest = int(self.images['number'][0])
        count = self.filter.count - oldest
        return self._match(self._assess(count, 0), self.images, oldest)

    def _assess(self, l: int, position: int | None = None) -> View:
        """Return what the newest l images that moved show."""
        position = (l - 1) // 2 if position is None else position
        columns, of_images = self.filter.beliefs(l)
        columns = columns[: columns.searchsorted(self.size)]
        of_images = of_images[:, : len(columns)]
        if not of_images[position].any():
            return self._nothing(l, position)
        probabilities, at = self.layout.merge(columns, of_images[position])
        belief = float(probabilities.max())
        place = centered_place(columns, of_images, position, at)
        path = follow(columns, of_images, position, round(place))
        shares = close_sums(columns, of_images, path)
        shares = np.minimum(shares / max(shares[position], LEAST), 1)
        z = self.filter.z(path[:, None], l)[:, 0]
        excess = 0.0
        if l == self.length:
            excess = self.change.excess(max(float(path[-1] - path[0]) / (l - 1), 0.0))
        quantities = Quantities(belief, unevenness(path, z), excess)
        quantities = self._compare(quantities, path, position)
        own = quantities.own(self._constant)
        # most of a route passes no earlier place: its windows say nothing about the next one
        probability = probability_of(own, 0.5 if self._is_route else self.recent.share)
        return View(path, position, quantities, own, probability, columns, probabilities, shares)

    def _compare(self, quantities: Quantities, path: np.ndarray, position: int) -> Quantities:
        """Return quantities with those that compare the path with straight ones elsewhere."""
        l, at = len(path), int(path[position])
        steps = np.rint(np.outer(STRAIGHT, np.arange(l) - position)).astype(np.int64)
        near, here = (self.layout.around(at, radius, True) for radius in (APART, CLOSE))
        straight = self.filter.best_straight
        score = max(straight(steps, slice(*span), near[:0])[0] for span in here.tolist())
        if self._is_route:  # the camera may have passed there several times
            return quantities._replace(lead=max(score, 0.0), images=ROUTE_IMAGES)
        elsewhere, competitor = straight(steps, slice(0, self.size), near)
        lead = max(score - max(elsewhere, 0.0), 0.0)
        cells = 0.0 if self.cells is None else self.cells.lead(path, competitor)
        creep = self.change.creep(int(path[0]), int(path[-1]), l)
        return quantities._replace(lead=lead, images=l, cells=cells, creep=creep)

    def _nothing(self, l: int, position: int) -> View:
        """Return what images show that are probably off the map: the most probable place now."""
        path = np.full(l, int(np.argmax(self.filter.by_place()[: self.size])))
        nothing = np.empty(0)
        columns, none = nothing.astype(int), Quantities(0.0)
        return View(path, position, none, -math.inf, 0.0, columns, nothing, np.ones(l))

    def _match(self, view: View, images: np.ndarray, number: int) -> WindowMatch:
        """Return the match of the image of a number by images of the window."""
        first, oldest = self.first, self.filter.count - len(view.path)
        numbers, row = images['number'] - oldest, number - oldest
        columns, shares = view.path[numbers], view.shares[numbers]
        peak = float(view.probabilities.max(initial=0.0))
        certain = view.probability * float(view.shares[row])
        shares = shares if certain > 0 else shares[:0]
        place = int(view.path[row])
        share = certain / peak if peak > certain else 1.0  # no place is above the match
        second, probability = self._second_best(view, place)
        probability *= share
        pairs = np.empty((len(images), 2), np.int32)
        pairs[:, 0], pairs[:, 1] = np.arange(len(images)), columns + first
        path = Path(
            pairs,
            place + first,
            1 - certain,
            certain,
            shares,
            second + first if probability > 0 else -1,
            1 - probability if probability > 0 else float('nan'),
        )
        sequences = partial(self._sequences, view, share, self.size, first)
        return self.layout.in_places(WindowMatch(path, sequences))

    def _second_best(self, view: View, place: int) -> tuple[int, float]:
        """Return the most probable column elsewhere, and its probability, 0 if none."""
        now, is_near = self.filter.by_place()[: self.size], np.zeros(self.size, bool)
        now[view.candidates] = 0
        for low, end in self.layout.around(place, self.layout.nms_radius).tolist():
            near = slice(max(low, 0), max(end, 0))
            now[near], is_near[near] = 0, True
        elsewhere = ~is_near[view.candidates]
        second = int(np.argmax(now))
        probability = float(now[second]) * NEGLIGIBLE
        if elsewhere.any():
            best = int(np.argmax(np.where(elsewhere, view.probabilities, -1)))
            if view.probabilities[best] >= probability:
                second, probability = int(view.candidates[best]), float(view.probabilities[best])
        return second, probability

    def _sequences(self, view: View, share: float, n: int, first: int) -> WindowSequences:
        """Return all places; improbable ones have a share of their probability now."""
        probabilities = self.filter.by_place()[:n] * np.float64(NEGLIGIBLE)
        probabilities[view.candidates] = view.probabilities
        probabilities *= share
        costs = np.where(probabilities > 0, 1 - probabilities, np.inf)
        return WindowSequences(costs, np.arange(first, first + n), probabilities)
