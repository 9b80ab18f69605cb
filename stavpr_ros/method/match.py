# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The match of one image: its status, the nearest sequence of the map, the matched place."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import enum
import math
from typing import NamedTuple

import numpy as np
from stavpr_ros.alignment.lm_dtw import aligned_index, NO_PATH, SequenceMatch
from stavpr_ros.errors import InputError

NO_SHARES, NO_COLUMNS = np.empty(0), np.empty((0, 0), np.float32)
MIN_SHARE = 1e-9  # of a place of the path; ratios to it are finite


class Status(enum.IntEnum):
    """Status of one image; names and values are the constants of ``stavpr_msgs/PlaceMatch``."""

    WARMING_UP = 0
    NO_MATCH = 1
    MATCH = 2
    INVALID_IMAGE = 3
    NOT_READY = 4
    DROPPED = 5
    SKIPPED = 6
    MAPPED = 7

    @property
    def label(self) -> str:
        """Return the name for people: ``no match``."""
        return self.name.lower().replace('_', ' ')


@dataclass(frozen=True)
class Candidate:
    """
    A place that the window may show.

    :param place: its index, the middle of the sequence that the window was matched with.
    :param distance: on the scale of :attr:`Match.distance`.
    :param probability: NaN in mode paper.
    """

    place: int
    distance: float
    probability: float = math.nan


class WindowSequences(NamedTuple):
    """
    All sequences that a window was compared with.

    :param costs: shape (n,); +inf where there is no sequence. Mode robust: 1 - probability.
    :param places: the middle of each, shape (n,), int64.
    :param probabilities: shape (n,); None in mode paper.
    """

    costs: np.ndarray = np.empty(0, np.float32)
    places: np.ndarray = np.empty(0, np.int64)
    probabilities: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class WindowMatch:
    """
    The nearest sequence of a window, by the images alone, and all others.

    :param nearest: with the second best; None where no sequence is possible.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param probability: of the nearest sequence; NaN in mode paper.
    :param shares: probability of each place of the path and its neighbors, given the sequence,
        (m,); empty in mode paper.
    :param sequences: returns all sequences; valid until the next match of the window.
    :param images: number of the newest images that are matched; 0 = the whole window.
    :param direction: 1 = along the map, -1 = against it.
    """

    nearest: SequenceMatch | None = None
    path: np.ndarray = field(default_factory=lambda: NO_PATH)
    sequences: Callable[[], WindowSequences] = WindowSequences
    probability: float = math.nan
    shares: np.ndarray = field(default_factory=lambda: NO_SHARES)
    images: int = 0
    direction: int = 1

    def path_ratios(self, position: int) -> np.ndarray:
        """Return the shares, divided by the share of the place at a position, (m,)."""
        if not len(self.shares):
            return NO_SHARES
        return self.shares / max(self.shares[position], MIN_SHARE)


class Limits(NamedTuple):
    """
    From which on a window is matched.

    :param threshold: its distance must be below it; NaN = not set, nothing is matched.
    :param probability: mode robust: its probability must be above it.
    """

    threshold: float = math.nan
    probability: float = math.nan

    def raised(self, probability: float) -> 'Limits':
        """Return these limits, the probability not below another one."""
        return Limits(1 - probability, probability) if probability > self.probability else self

    def decide(self, distance: float, probability: float) -> tuple[Status, str]:
        """
        Return ``MATCH`` or ``NO_MATCH``, and the reason for the latter.

        By the probability or, where it is NaN, by the distance.
        """
        if math.isnan(probability):
            accepted = distance < self.threshold
            reason = (
                f'nearest distance {distance:.4f} is not below the threshold {self.threshold:.4f}'
            )
        else:
            accepted = probability > self.probability
            reason = (
                f'the probability of the best place, {probability:.3f}, is not above '
                f'{self.probability:.3f}'
            )
        return (Status.MATCH, '') if accepted else (Status.NO_MATCH, reason)


@dataclass(frozen=True, eq=False)
class Match:
    """
    The match of one image; indices are 0-based places of the map.

    :param status: only ``MATCH`` names a place.
    :param reason: why there is no match, one sentence; empty for ``MATCH``.
    :param threshold: a window is matched below this distance; mode robust: 1 - min_probability.
        NaN = not set.
    :param sequence: the nearest sequence of the map by the images alone, accepted or not; None =
        there is none.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param distance: of the nearest sequence, accepted or not; NaN without one. Mode paper: q_m of
        LM-DTW, a mean image distance of this window alone. Mode robust: 1 - probability.
    :param probability: that the nearest sequence is the right place; NaN in mode paper. It has
        memory: successive values are correlated.
    :param min_probability: mode robust: a window is matched above this probability.
    :param path_ratios: probability of each place of the path over the matched place's, (m,);
        empty in mode paper.
    :param is_late: it is one of the late matches of another.
    :param late: loop closure: matches of earlier images that had none until now.
    :param window_stamps: stamps (ns) of the images in the window, oldest first, this one the last.
    :param window_changes: difference of each of them from the image before it, 0 = equal; empty in
        mode paper.
    :param image_index: place of a growing map that this image has become, -1 = none.
    :param is_oldest: it is the place of the oldest image of the window, not of the middle one.
    :param direction: 1 = the camera moves along the map, -1 = against it, as a path that falls.
    :param columns: of a late match: image distances of its window to places from ``first_column``
        on, (l, k), float32.
    """

    status: Status
    reason: str = ''
    threshold: float = math.nan
    sequence: SequenceMatch | None = None
    path: np.ndarray = field(default_factory=lambda: NO_PATH)
    distance: float = math.nan
    probability: float = math.nan
    min_probability: float = math.nan
    path_ratios: np.ndarray = field(default_factory=lambda: NO_SHARES)
    is_late: bool = False
    late: 'tuple[Match, ...]' = ()
    window_stamps: tuple[int, ...] = ()
    window_changes: tuple[float, ...] = ()
    image_index: int = -1
    is_oldest: bool = False
    direction: int = 1
    first_column: int = 0
    columns: np.ndarray = field(default_factory=lambda: NO_COLUMNS)

    def __repr__(self) -> str:
        fields = [self.status.name]
        if self.accepted:
            fields += [f'place_index={self.place_index}', f'newest_index={self.newest_index}']
        for name in ('probability', 'distance'):
            if not math.isnan(getattr(self, name)):
                fields.append(f'{name}={getattr(self, name):.4g}')
        return f'Match({", ".join(fields + [f"reason={self.reason!r}"] * bool(self.reason))})'

    @property
    def accepted(self) -> bool:
        """Whether the image was matched."""
        return self.status is Status.MATCH

    @property
    def place_index(self) -> int:
        """Return the matched place, the middle of the matched sequence; -1 unless matched."""
        return self.sequence.middle if self.sequence and self.accepted else -1

    @property
    def position(self) -> int:
        """Position in the window of the image that the place is of."""
        return 0 if self.is_oldest else (len(self.window_stamps) - 1) // 2

    @property
    def newest_index(self) -> int:
        """Return the place aligned with the newest image; -1 unless matched."""
        return aligned_index(self.path, int(self.path[-1, 0])) if self.accepted else -1

    @property
    def path_probabilities(self) -> np.ndarray:
        """Return the probability of each place of the path, (m,); empty in mode paper."""
        return np.minimum(self.probability * self.path_ratios, 1)

    def columns_of(self, places: np.ndarray) -> np.ndarray:
        """
        Return the image distances of the window of a late match, (l, k).

        :param places: shape (k,), int64, successive ones.
        :returns: +inf where they are not known.
        """
        columns = places - self.first_column
        inside = (columns >= 0) & (columns < self.columns.shape[1])
        rows: np.ndarray = np.full((len(self.columns), len(places)), np.inf, np.float32)
        rows[:, inside] = self.columns[:, columns[inside]]
        return rows

    def at(self, position: int) -> 'Match':
        """Return this as the match of another image of the window, with its probability."""
        if not len(self.path_ratios) or self.sequence is None:
            return self
        return self.with_probability(float(self.path_probabilities[position]))

    @property
    def score(self) -> float:
        """Return the distance; +inf without a sequence, or with a probability of 0."""
        impossible = self.distance >= 1 and not math.isnan(self.probability)
        return math.inf if self.sequence is None or impossible else self.distance

    def with_probability(self, probability: float) -> 'Match':
        """Return the match of mode robust with another probability, accepted or not by it."""
        distance = 1 - probability
        limits = Limits(self.threshold, self.min_probability)
        status, reason = limits.decide(distance, probability)
        return replace(
            self, status=status, reason=reason, distance=distance, probability=probability
        )

    @property
    def first_image_index(self) -> int:
        """Place of the window's first image on a route that grows with every image, -1 = none."""
        return self.image_index - len(self.window_stamps) + 1 if self.image_index >= 0 else -1


def ranked_candidates(
    nearest: Candidate | None,
    sequences: WindowSequences,
    count: int,
    nms_radius: int,
    positions: Callable[[np.ndarray | int], np.ndarray] = np.asarray,
    lap: int = 0,
) -> list[Candidate]:
    """
    Rank places by non-maximum suppression: no candidate is close to one ranked before it.

    The first is the nearest sequence, the second its second best. O(count x n).

    :param nearest: the nearest sequence; None if there is none.
    :param sequences: all sequences, in any order; the most probable first; else of equal costs
        the first one.
    :param count: most candidates, at least 0.
    :param nms_radius: candidates are more than this many places from each other.
    :param positions: of places, between which the distance is measured; lap: of a closed route,
        else 0.
    :raises InputError: count below 0.
    """
    if count < 0:
        raise InputError(f'count = {count} candidates: expected at least 0')
    if nearest is None or not count:
        return []
    costs, places, probabilities = sequences
    # the costs of improbable places are equal: 1 up to the last digit
    keys = costs.copy() if probabilities is None else -probabilities
    keys[~np.isfinite(costs)], at_position = np.inf, positions(places)
    ranked = [nearest]
    while len(ranked) < count and len(costs):
        apart = np.abs(at_position - positions(ranked[-1].place))
        keys[np.minimum(apart, np.abs(lap - apart) if lap else apart) <= nms_radius] = np.inf
        best = int(np.argmin(keys))
        if math.isinf(keys[best]):
            break
        probability = math.nan if probabilities is None else float(probabilities[best])
        ranked.append(Candidate(int(places[best]), float(costs[best]), probability))
    return ranked


def distinct_places(sequences: WindowSequences, count: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the nearest distinct places, nearest first (the lowest index on a tie).

    :returns: places and costs, at most ``count`` of each.
    """
    costs, places, _ = sequences
    order = np.argsort(costs, kind='stable')
    order = order[np.isfinite(costs[order])]
    _, first = np.unique(places[order], return_index=True)
    order = order[np.sort(first)[:count]]
    return places[order].astype(np.int64), costs[order]
