# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The window of mode robust: a place filter, read at the middle of the window."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
import math
from typing import Any

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.filter.choice import ChosenPath, PathChoice, WindowImages
from stavpr_ros.filter.columns import ColumnLayout
from stavpr_ros.filter.evidence import (
    APART,
    changed_images,
    lead_of,
    own_evidence,
    path_probability,
    RecentWindows,
)
from stavpr_ros.filter.model import FilterSettings, MODEL
from stavpr_ros.filter.motion import ImageChange
from stavpr_ros.filter.paths import NEGLIGIBLE, NO_PLACES
from stavpr_ros.filter.place_filter import PlaceFilter
from stavpr_ros.filter.place_means import PlaceMeans
from stavpr_ros.filter.protocol import Filter
from stavpr_ros.recognition.cells import CellAgreement
from stavpr_ros.recognition.match import WindowMatch, WindowSequences
from stavpr_ros.recognition.sessions import in_places
from stavpr_ros.recognition.window import QueryWindow, SequenceBuffer

MIN_IMAGES = 2  # of a match
ON_MAP = 0.5  # probability above which the newest images can have a match
AT_REST = 0.05  # relative probability of a camera at rest, below which it moves


class FilterWindow(QueryWindow):
    """
    A place filter that is updated image by image, and the query window that it matches.

    :param sequence: l and k.
    :param places: number of places n.
    :param settings: model of the filter.
    :param layout: of the places.
    :param normalizes, around: see :class:`stavpr_ros.recognition.window.QueryWindow`.
    :param to_oldest: for loop closure: states are followed back to the oldest image of the
        window, which :meth:`match_oldest` requires, instead of the middle one, and the mean z of
        each place is subtracted (:mod:`stavpr_ros.filter.place_means`).
    :param constant: of the evidence (:class:`stavpr_ros.features.registry.Kind`).
    :param cells: of the images; None = they are not compared.

    ``change`` compares images, ``filter`` contains the states, ``recent`` is of the drive.
    """

    buffer_class: Callable[..., SequenceBuffer] = SequenceBuffer
    filter_class: Callable[..., Filter] = PlaceFilter

    def __init__(
        self,
        sequence: SequenceSettings,
        places: int,
        settings: FilterSettings = MODEL,
        layout: ColumnLayout | None = None,
        normalizes: bool = False,
        around: int = 0,
        to_oldest: bool = False,
        *,
        constant: float,
        cells: CellAgreement | None = None,
    ) -> None:
        layout = layout or ColumnLayout()
        length, width = sequence.length, layout.width(places)
        buffer = self.buffer_class(length, width, sequence.k, copies=1)
        super().__init__(buffer, layout, normalizes, around)
        self._middle, self._to_oldest = (length - 1) // 2, to_oldest
        lag = length - 1 - (0 if to_oldest else self._middle)
        self.filter: Filter = self.filter_class(width, lag, settings, layout.gaps)
        self.change = ImageChange(layout.passes(places), settings, length)
        self.choice = PathChoice(self.filter, self.change, layout, width)
        self._constant, self.cells, self.recent = constant, cells, RecentWindows()
        self._own = -math.inf  # evidence of the latest match
        self._at_rest: WindowMatch | None = None  # match of a camera at rest
        self._means = PlaceMeans()
        self._repeated = slice(0, 0)  # columns that the latest path is in, beyond a lap
        self._entered = 0  # number of the image with which the latest path came to the map

    @property
    def changes(self) -> tuple[float, ...]:
        """Change of each image from the one before, oldest first."""
        return tuple(self.images['change'].tolist())

    @property
    def is_standstill(self) -> bool:
        """Whether the newest image equals the one before, up to noise."""
        return self.change.is_standstill(float(self.images['change'][-1]))

    def reset(self) -> None:
        """Drop all images."""
        super().reset()
        self.filter.reset()
        self.change.reset()
        self._at_rest, self._entered, self.recent = None, 0, RecentWindows()
        self._repeated, self._means = slice(0, 0), PlaceMeans()
        if self.cells is not None:
            self.cells.reset()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        for part in (self.buffer, self.choice, self.filter, self.change):
            part.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        for part in (self.buffer, self.filter, self.change, self._means):
            part.evict(count)

    def push(self, row: Any, strips: np.ndarray, stamp: int) -> None:
        """See :meth:`QueryWindow.push`."""
        row, change = self._as_columns(row), self.change.next_query(strips)
        if self._to_oldest:
            row = self._means.subtracted(row, self.change.is_standstill(change))
        if self.cells is not None:
            self.cells.push(strips)
        self._add(row, stamp, change)

    def add(self, row: np.ndarray, stamp: int, change: float) -> None:
        """
        Add the newest image by its normalized distances, and drop the oldest.

        :param row: to the places, (n,), float32.
        :param change: from the image before.
        """
        self._add(self.layout.to_columns(row), stamp, change)

    def _counted(self, n: int) -> np.ndarray:
        return self.change.distinct(n)

    def _add(self, z: Any, stamp: int, change: float) -> None:
        """
        Add an image, and advance the filter by it.

        An image of a camera at rest adds nothing. Where the map's own images are equal, in a dark
        tunnel, the camera may move: the filter goes on at its speed, without evidence.

        :param z: z-normalized distances to the columns, (m,), float32.
        """
        self.buffer.push(z)
        if self._repeated.stop:
            self.filter.move_back(self._repeated, self.layout.lap)
            self._repeated = slice(0, 0)
        weight, ones = 0.0, np.ones(len(self.filter.settings.speeds))
        if not self.filter.count:  # the change of the first image is unknown
            weight = self.change.weight(change)
            self.filter.update(z, weight, ones, ones)
        elif not self.change.is_standstill(change):
            weight = self.change.weight(change)
            speeds = self.change.speed_weights(change)
            likelihoods = self.change.speed_likelihoods(change)
            moves = speeds[0] < AT_REST * speeds.max()
            # places where the map's camera was at rest are not near to a moving one
            at_rest = self.layout.columns_of(self.change.at_rest()) if moves else NO_PLACES
            not_near = at_rest[at_rest < len(z)]
            self.filter.update(z, weight, speeds, likelihoods, not_near)
        else:
            by_pass = self.layout.to_passes(self.filter.places_of_states()[: len(z)])
            if self.change.is_dark_stretch(by_pass):
                self.filter.update(z, 0.0, ones, ones)
        self._append(stamp, change, weight, self.filter.count - 1)
        if self._at_rest is not None:
            self._at_rest = _shifted(self._at_rest) if self._rests(self._middle) else None

    def match(self, nms_radius: int) -> WindowMatch:
        """
        Return the match of the middle image; of a camera at rest, the match before it stopped.

        A window of equal images would show neither how even the path to them was nor how fast.
        """
        middle = (len(self.images) - 1) // 2
        match = self._at_rest
        if match is None:
            match = self._match_image(len(self.images), middle, nms_radius)
            self.recent.add(self._own)
        self._at_rest = match if self._rests(middle) else None
        return in_places(match, self.layout)

    def _rests(self, position: int) -> bool:
        """Whether the camera has not moved since an image; of a full window in localization."""
        numbers = self.images['number']
        is_equal = bool(numbers[position] == numbers[-1])
        return is_equal and self.buffer.full and not self._to_oldest

    def match_newest(self, nms_radius: int) -> WindowMatch:
        """Return the match of the newest images: :meth:`QueryWindow.match_newest`."""
        count = 0 if self._to_oldest else self._since_entering()
        if count < MIN_IMAGES:
            return WindowMatch()
        match = self._match_image(count, (count - 1) // 2, nms_radius)
        return in_places(replace(match, images=count), self.layout)

    def _since_entering(self) -> int:
        """
        Return how many of the newest images to match, if the whole window shows nothing.

        Those since the most probable path has come to the map, at most as many as states are
        followed back; all of a window that is not full.

        :returns: 0 if the path has been on the map for longer than the window.
        """
        belief = self.filter.belief(self.buffer.known, 0)
        if not belief.weights.sum() > ON_MAP:
            return 0
        if not self.buffer.full:
            return len(self.images)
        numbers = self.images['number']
        lag = min(len(self.images) - 1 - self._middle, int(numbers[-1]))
        path = self.filter.path(belief.states[np.argmax(belief.weights)], lag)
        on_map = int(np.count_nonzero(path >= 0))
        if on_map <= lag:
            self._entered = int(numbers[-1]) - on_map + 1
        if self._entered < numbers[0]:
            return 0
        return int(np.count_nonzero(numbers >= max(self._entered, numbers[-1] - lag)))

    def match_oldest(self, nms_radius: int, is_matched: bool) -> WindowMatch:
        """See :meth:`QueryWindow.match_oldest`."""
        self.images['is_matched'][self._middle] = is_matched
        if self.images['is_matched'][0] or not is_matched:
            return WindowMatch()
        return self._match_image(len(self.images), 0, nms_radius)

    def _match_image(self, count: int, position: int, nms_radius: int) -> WindowMatch:
        """
        Return the match of an image by the newest images of the window, in columns.

        :param count: of the newest images.
        :param position: of the image among these, not before the lag of the filter.
        """
        n, first = self.buffer.known, self.buffer.first
        if not n:
            return WindowMatch()
        self._own = -math.inf
        rows = self.images[len(self.images) - count :]
        numbers, weights, stamps = (
            np.ascontiguousarray(rows[name]) for name in ('number', 'weight', 'stamp')
        )
        belief = self.filter.belief(n, int(numbers[-1] - numbers[position]))
        if not len(belief.places):
            return self._off_map(count)
        rests = self._rests(len(self.images) - count + position)
        images = WindowImages(
            numbers,
            weights,
            stamps,
            z=lambda columns: self.buffer.at(columns, len(columns)),
            n=n,
            position=position,
            is_whole=count == len(self.images),
            lag_at_rest=count - 1 - self._middle if rests else None,
        )
        chosen = self.choice.choose(belief, images)
        place = int(chosen.path[position])
        self._repeated = self.layout.repeated(chosen.path)
        certain, least = self._probabilities(chosen, numbers, position)
        second, probability = self.choice.second_best(chosen, n, place, nms_radius)
        peak = float(chosen.probabilities.max(initial=0.0))
        share = certain / peak if peak > certain else 1.0  # none is above the match
        probability *= share
        path = _numbered(chosen.path + first)
        match = SequenceMatch(
            first=int(path[0, 1]),
            last=int(path[-1, 1]),
            middle=place + first,
            distance=1 - certain,
            second_best_index=second + first if probability > 0 else -1,
            second_best_distance=1 - probability if probability > 0 else float('nan'),
        )
        return WindowMatch(
            match,
            path,
            partial(self._sequences, n, first, chosen, share),
            certain,
            chosen.shares,
            least,
        )

    def _probabilities(
        self, chosen: ChosenPath, numbers: np.ndarray, position: int
    ) -> tuple[float, float]:
        """Return the probability of a path, and the one below which it is no match."""
        posterior, least = chosen.probability, chosen.min_probability
        if self._to_oldest:
            return posterior, least
        near = self.layout.around(int(chosen.path[position]), APART)
        elsewhere, competitor = self.buffer.best_elsewhere(numbers, position, near)
        cells = 0.0
        if self.cells is not None:
            counted = changed_images(numbers)
            cells = self.cells.lead(counted, chosen.path[counted], competitor)
        window = lead_of(chosen.score, elsewhere), len(numbers), cells
        recent = self.recent.share
        self._own = own_evidence(self._constant, posterior, *window)
        return path_probability(self._own, recent), path_probability(
            own_evidence(self._constant, least, *window), recent
        )

    def _sequences(
        self, n: int, first: int, chosen: ChosenPath | None = None, share: float = 1.0
    ) -> WindowSequences:
        """Return all places; improbable ones have a share of their probability now."""
        probabilities = self.filter.places_of_states()[:n] * np.float64(NEGLIGIBLE)
        if chosen is not None:
            probabilities[chosen.places] = chosen.probabilities
        probabilities *= share
        costs = np.where(probabilities > 0, 1 - probabilities, np.inf)
        return WindowSequences(costs, np.arange(first, first + n), probabilities)

    def _off_map(self, count: int) -> WindowMatch:
        """Return the place that is most probable now, with the probability 0."""
        n, first = self.buffer.known, self.buffer.first
        place = self.filter.most_probable(NO_PLACES)[0] + first
        match = SequenceMatch(place, place, place, 1.0, -1, float('nan'))
        sequences = partial(self._sequences, n, first)
        return WindowMatch(match, _numbered(np.full(count, place)), sequences, 0.0)


def _numbered(places: np.ndarray) -> np.ndarray:
    """Return the place of each image as a path: position in the window and place, (l, 2)."""
    path = np.empty((len(places), 2), np.int32)
    path[:, 0], path[:, 1] = np.arange(len(places)), places
    return path


def _shifted(match: WindowMatch) -> WindowMatch:
    """Return the match of a window after one more image of a camera at rest."""
    if match.nearest is None:
        return match
    path, shares = match.path.copy(), np.append(match.shares[1:], match.shares[-1:])
    path[:-1, 1] = match.path[1:, 1]
    nearest = replace(match.nearest, first=int(path[0, 1]))
    return replace(match, nearest=nearest, path=path, shares=shares)
