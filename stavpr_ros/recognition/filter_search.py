# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search of mode robust: what the filter believes about the window, as a sequence match."""

from collections import deque

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.recognition.image_change import ImageChange
from stavpr_ros.recognition.place_filter import Belief, CLOSE, FilterSettings, PlaceFilter
from stavpr_ros.recognition.sequence_search import SequenceBuffer, Sequences, WindowMatch


class FilterSearch:
    """
    A :class:`PlaceFilter` fed image by image, and read at the middle of the window.

    The distance of a match is 1 less the probability that its place is right.

    :param buffer: the window.
    """

    def __init__(self, buffer: SequenceBuffer, settings: FilterSettings | None = None) -> None:
        self.buffer = buffer
        settings = settings or FilterSettings()
        self._middle = (buffer.length - 1) // 2
        self.filter = PlaceFilter(buffer.places, buffer.length - 1 - self._middle, settings)
        self.change = ImageChange(buffer.places, settings)
        self._speeds = settings.speeds
        self._images: deque[int] = deque(maxlen=buffer.length)  # the filter's image of each
        # alpha and speed weights of each image until the window is full; None = nothing was added
        self._first: list[tuple[float, np.ndarray] | None] = []

    def reset(self) -> None:
        """Forget the query."""
        self.filter.reset()
        self.change.reset()
        self._images.clear()
        self._first.clear()

    def grow(self, places: int) -> None:
        """Make room for more places."""
        self.filter.grow(places)
        self.change.grow(places)

    def evict(self, count: int) -> None:
        """Drop the oldest places; the others move up."""
        self.filter.evict(count)
        self.change.evict(count)

    def update(self, z: np.ndarray, change: float, standstill: bool) -> None:
        """
        Advance by an image.

        An image of a camera that stands adds nothing. Where the map's own images are equal, in a
        dark tunnel, it may move: the filter goes on at its speed, without evidence.

        :param z: z-normalized distances to the places, (m,), float32.
        :param change, standstill: of the image, from :class:`ImageChange`.
        """
        still = standstill and self.filter.count > 0
        evidence: tuple[float, np.ndarray] | None = None
        if not still:
            evidence = self.change.weight(change), self._speed_weights(change)
        elif self.change.unlit(self.filter.places_of_states()[: len(z)]):
            evidence = 0.0, np.ones(len(self._speeds))
        self._advance(z, evidence)
        if len(self._first) < self.buffer.length:
            self._first.append(evidence)

    def start_again(self, rows: np.ndarray) -> None:
        """
        Repeat the first window with the z-normalization that is known at its end.

        :param rows: z-normalized distances of the window, (l, n).
        """
        self.filter.reset()
        self._images.clear()
        for row, evidence in zip(rows, self._first, strict=True):
            self._advance(row, evidence)

    def _advance(self, z: np.ndarray, evidence: tuple[float, np.ndarray] | None) -> None:
        if evidence is not None:
            self.filter.update(z, *evidence)
        self._images.append(self.filter.count - 1)

    def _speed_weights(self, change: float) -> np.ndarray:
        if not self.filter.count:
            return np.ones(len(self._speeds))  # of the first image no change is known
        return self.change.speed_weights(change)

    def __call__(self, nms_radius: int) -> WindowMatch:
        n, first = self.buffer.known, self.buffer.first
        if not n:
            return WindowMatch()
        newest = self._images[-1]
        belief = self.filter.belief(n, newest - self._images[self._middle])
        place = int(np.argmax(belief.probabilities))
        if not belief.probabilities[place] > 0:
            return self._nowhere(n, first)
        near = slice(max(0, place - CLOSE), min(n, place + CLOSE + 1))
        weights = belief.weights[near]
        middle = round(float(np.arange(near.start, near.stop) @ weights / weights.sum()))
        path = self._path(belief.ways[near.start + int(np.argmax(weights))])
        elsewhere = belief.probabilities.copy()
        elsewhere[max(0, middle - nms_radius) : middle + nms_radius + 1] = 0
        second = int(np.argmax(elsewhere))
        found = float(elsewhere[second])
        path[:, 1] += first
        match = SequenceMatch(
            first=int(path[0, 1]),
            last=int(path[-1, 1]),
            middle=middle + first,
            distance=float(1 - belief.probabilities[place]),
            second_best_index=second + first if found > 0 else -1,
            second_best_distance=1 - found if found > 0 else float('nan'),
        )
        return WindowMatch(match, path, lambda: _sequences(belief, first))

    def _nowhere(self, n: int, first: int) -> WindowMatch:
        """Return the place that is most probable now, with the distance 1."""
        place = int(np.argmax(self.filter.places_of_states()[:n])) + first
        match = SequenceMatch(place, place, place, 1.0, -1, float('nan'))
        length = self.buffer.length
        path = np.stack([np.arange(length), np.full(length, place)], axis=1).astype(np.int32)
        return WindowMatch(match, path)

    def _path(self, way: np.ndarray) -> np.ndarray:
        """Return the place of each image of the window, (l, 2); before the middle at one speed."""
        images = np.array(self._images)
        back = images[-1] - images
        lag = int(back[self._middle])
        places = self.filter.way(way, lag)
        slope = (places[0] - places[lag]) / lag if lag else self._speeds[way[3]]
        earlier = np.maximum(back - lag, 0) * slope
        path = places[np.minimum(back, lag)] - np.rint(earlier).astype(np.int32)
        return np.stack([np.arange(len(path)), np.maximum(path, 0)], axis=1).astype(np.int32)


def _sequences(belief: Belief, first: int) -> Sequences:
    costs = np.where(belief.probabilities > 0, 1 - belief.probabilities, np.inf)
    return costs.astype(np.float32), np.arange(first, first + len(costs))
