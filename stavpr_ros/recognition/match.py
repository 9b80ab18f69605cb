# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result for one image: its status, the nearest sequence of the map, the matched place."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import enum
import math

import numpy as np
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.alignment.path import aligned_index, NO_PATH
from stavpr_ros.errors import InputError

NO_SHARES = np.empty(0)


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
    """

    place: int
    distance: float


@dataclass(frozen=True, eq=False)
class Match:
    """
    The result for one image; indices are 0-based places of the map.

    The recognizer fills the fields up to ``window_changes``, the pipeline the others.

    :param status: only ``MATCH`` names a place.
    :param reason: why there is no match, one sentence; empty for ``MATCH`` and ``MAPPED``.
    :param threshold: a window is matched below it; NaN = not set.
    :param sequence: the nearest sequence of the map, accepted or not; None where there is none.
    :param path: its warping path, shape (m, 2), int32: position in the window, place.
    :param relative: distances are those of mode robust, 1 - probability.
    :param probability: that the nearest sequence is the right place; NaN = unknown (mode paper).
    :param path_ratios: probability of each place of the path over that of the matched place, (m,);
        empty in mode paper.
    :param is_late: the place is that of the oldest image of the window instead of the middle one.
    :param late: the match of the oldest image, where it had none as the middle one; None = it had,
        or is not certain now either.
    :param window_stamps: stamps (ns) of the images in the window, oldest first, this one the last.
    :param window_changes: how much each of them differs from the image before it, 0 = equal; empty
        in mode paper.
    :param image_index: place of a growing map that this image has become, -1 = none.
    :param inliers: of the geometric verification, -1 = not verified.
    :param candidates: nearest places, nearest first.
    :param cause: why the image is in no window, two or three words to be counted; '' = it is in
        one.
    :param stages: seconds that each stage took.
    :param image: the image, RGB, where it was decoded.
    """

    status: Status
    reason: str = ''
    threshold: float = math.nan
    sequence: SequenceMatch | None = None
    path: np.ndarray = field(default_factory=lambda: NO_PATH, repr=False)
    relative: bool = False
    probability: float = math.nan
    path_ratios: np.ndarray = field(default_factory=lambda: NO_SHARES, repr=False)
    is_late: bool = False
    late: 'Match | None' = field(default=None, repr=False)
    window_stamps: tuple[int, ...] = field(default=(), repr=False)
    window_changes: tuple[float, ...] = field(default=(), repr=False)
    image_index: int = -1
    inliers: int = -1
    candidates: tuple[Candidate, ...] = ()
    cause: str = ''
    stages: Mapping[str, float] = field(default_factory=dict, repr=False)
    image: np.ndarray | None = field(default=None, repr=False)

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
        return 0 if self.is_late else (len(self.window_stamps) - 1) // 2

    @property
    def newest_index(self) -> int:
        """Return the place aligned with the newest image; -1 unless matched."""
        return aligned_index(self.path, int(self.path[-1, 0])) if self.accepted else -1

    @property
    def distance(self) -> float:
        """
        Distance of the nearest sequence, accepted or not; NaN without one.

        In mode paper, q_m of LM-DTW: a mean image distance of this window alone. In mode robust
        (``relative``), 1 - probability, which has memory: successive values are correlated.
        """
        return self.sequence.distance if self.sequence else math.nan

    @property
    def path_probabilities(self) -> np.ndarray:
        """Return the probability of each place of the path, (m,); empty in mode paper."""
        return np.minimum(self.probability * self.path_ratios, 1)

    def at(self, position: int) -> 'Match':
        """Return this as the match of another image of the window, with its probability."""
        if not len(self.path_ratios) or self.sequence is None:
            return self
        return self.with_probability(float(self.path_probabilities[position]))

    @property
    def score(self) -> float:
        """Return the distance; +inf without a sequence, or without any probability."""
        if self.sequence is None or (self.relative and self.sequence.distance >= 1):
            return math.inf
        return self.sequence.distance

    def with_probability(self, probability: float) -> 'Match':
        """Return the match of mode robust with another probability, accepted or not by it."""
        if self.sequence is None:
            return self
        sequence = replace(self.sequence, distance=1 - probability)
        accepted = sequence.distance < self.threshold
        return replace(
            self,
            status=Status.MATCH if accepted else Status.NO_MATCH,
            reason='' if accepted else improbable(probability, self.threshold),
            sequence=sequence,
            probability=1 - sequence.distance,
        )

    def with_candidates(self, ranked: Sequence[Candidate]) -> 'Match':
        """Return the match with its ranked places; the first is the match itself."""
        own = [replace(first, distance=self.distance) for first in ranked[:1]]
        return replace(self, candidates=(*own, *ranked[1:]))

    @property
    def first_image_index(self) -> int:
        """Place of the window's first image on a route that grows with every image, -1 = none."""
        return self.image_index - len(self.window_stamps) + 1 if self.image_index >= 0 else -1


def improbable(probability: float, threshold: float) -> str:
    """Return the reason of mode robust for no match."""
    return (
        f'the probability of the best place, {probability:.3f}, is not above {1 - threshold:.3f}'
    )


def ranked_candidates(
    nearest: SequenceMatch | None,
    sequences: tuple[np.ndarray, np.ndarray],
    count: int,
    nms_radius: int,
    positions: Callable[[np.ndarray | int], np.ndarray] = np.asarray,
) -> list[Candidate]:
    """
    Rank places by non-maximum suppression: around a place that is taken no other one is.

    The first is the nearest sequence, the second its second best. O(count x n).

    :param nearest: the nearest sequence as it was matched; None if there is none.
    :param sequences: costs of all sequences, shape (n,), +inf where there is none, and their
        places, shape (n,), whole numbers, in any order; of equal costs the first is taken.
    :param count: most candidates, at least 0.
    :param nms_radius: candidates are more than so many places from each other.
    :param positions: of places, between which the distance is measured.
    :raises InputError: count below 0.
    """
    if count < 0:
        raise InputError(f'count = {count} candidates: expected at least 0')
    if nearest is None or not count:
        return []
    costs, places = sequences[0].copy(), sequences[1]
    at_position = positions(places)
    found = [Candidate(nearest.middle, nearest.distance)]
    while len(found) < count and len(costs):
        costs[np.abs(at_position - positions(found[-1].place)) <= nms_radius] = np.inf
        at = int(np.argmin(costs))
        cost = float(costs[at])
        if math.isinf(cost):
            break
        found.append(Candidate(int(places[at]), cost))
    return found


def distinct_places(
    distances: np.ndarray, places: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the nearest distinct places, nearest first (the lowest index on a tie).

    :param distances: of each sequence, shape (m,); +inf where there is none.
    :param places: its middle, shape (m,).
    :returns: places and distances, at most ``count`` of each.
    """
    order = np.argsort(distances, kind='stable')
    order = order[np.isfinite(distances[order])]
    _, first = np.unique(places[order], return_index=True)
    order = order[np.sort(first)[:count]]
    return places[order].astype(np.int64), distances[order]
