# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The match of one image: its status, its path on the map, the matched place."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import enum
from functools import cached_property
import math
from typing import NamedTuple

import numpy as np
from stavpr_ros.alignment.lm_dtw import aligned_index, NO_PATH
from stavpr_ros.former import FormerNames

NO_SHARES: np.ndarray = np.empty(0)
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
class Path(FormerNames):
    """
    The places that the images of a window show, by the images alone; indices are 0-based.

    It is the nearest sequence of the map, accepted or not. Without one, it has no pairs.

    :param pairs: warping path, shape (m, 2), int32: position in the window, place.
    :param place: of the image that is matched, the middle of the sequence; -1 = none.
    :param distance: mode paper: q_m of LM-DTW, a mean image distance of this window alone; NaN
        without a path. Mode robust: 1 - probability.
    :param probability: that the place is right; NaN in mode paper.
    :param shares: probability of each place of the path and its neighbors, given the sequence,
        (m,); empty in mode paper.
    :param second_best: place of the nearest sequence outside the nms_radius; -1 = none.
    :param second_best_distance: its distance; NaN = none.
    :param direction: 1 = the camera moves along the map, -1 = against it, as a path that falls.
    """

    pairs: np.ndarray = field(default_factory=lambda: NO_PATH)
    place: int = -1
    distance: float = math.nan
    probability: float = math.nan
    shares: np.ndarray = field(default_factory=lambda: NO_SHARES)
    second_best: int = -1
    second_best_distance: float = math.nan
    direction: int = 1

    @property
    def first(self) -> int:
        """Return the first place; -1 = none."""
        return int(self.pairs[0, 1]) if len(self.pairs) else -1

    @property
    def last(self) -> int:
        """Return the last place; -1 = none."""
        return int(self.pairs[-1, 1]) if len(self.pairs) else -1


class WindowMatch(NamedTuple):
    """
    The nearest sequence of a window, and all others.

    :param path: of the nearest one; empty where no sequence is possible.
    :param sequences: returns all sequences; valid until the next match of the window.
    """

    path: Path = Path()
    sequences: Callable[[], WindowSequences] = WindowSequences


class Limits(NamedTuple):
    """
    From which on a window is matched.

    :param threshold: its distance must be below it; NaN = not set, nothing is matched.
    :param probability: mode robust: its probability must be above it.
    """

    threshold: float = math.nan
    probability: float = math.nan

    def with_min_probability(self, probability: float) -> 'Limits':
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


NO_LIMITS = Limits()


class WindowColumns(NamedTuple):
    """
    Image distances of a window to successive places.

    :param first: the first place.
    :param distances: shape (l, k), float32.
    """

    first: int
    distances: np.ndarray

    def at(self, places: np.ndarray) -> np.ndarray:
        """
        Return the distances to places, (l, k).

        :param places: shape (k,), int64, successive ones.
        :returns: +inf where they are not known.
        """
        columns = places - self.first
        inside = (columns >= 0) & (columns < self.distances.shape[1])
        rows: np.ndarray = np.full((len(self.distances), len(places)), np.inf, np.float32)
        rows[:, inside] = self.distances[:, columns[inside]]
        return rows


@dataclass(frozen=True, eq=False)
class Match(FormerNames):
    """
    The match of one image: what its window shows, and the decision; indices are 0-based places.

    :param status: only ``MATCH`` names a place.
    :param reason: why there is no match, one sentence; empty for ``MATCH`` and ``MAPPED``.
    :param limits: that were applied.
    :param path: by the images alone, accepted or not.
    :param probability: that the place is right, by odometry and the geometric check as well; NaN
        in mode paper. It has memory: successive values are correlated.
    :param inliers: of the geometric check, -1 = not checked.
    :param window_stamps: stamps (ns) of the images in the window, oldest first, this one the last.
    :param window_changes: difference of each of them from the image before it, 0 = equal; empty in
        mode paper.
    :param first_image: place of the window's first image on a route that grows with every image,
        -1 = none.
    :param is_oldest: it is the place of the oldest image of the window, not of the middle one.
    :param columns: of a late match: image distances of its window to the places around the path.
    :param late: loop closure: matches of earlier images that had none until now.
    """

    status: Status
    reason: str = ''
    limits: Limits = NO_LIMITS
    path: Path = Path()
    probability: float = math.nan
    inliers: int = -1
    window_stamps: tuple[int, ...] = ()
    window_changes: tuple[float, ...] = ()
    first_image: int = -1
    is_oldest: bool = False
    columns: WindowColumns | None = None
    late: 'tuple[Match, ...]' = ()

    def __repr__(self) -> str:
        fields = [self.status.name]
        if self.accepted:
            fields += [f'place={self.place}', f'newest={self.newest}']
        for name in ('probability', 'distance'):
            if not math.isnan(getattr(self, name)):
                fields.append(f'{name}={getattr(self, name):.4g}')
        return f'Match({", ".join(fields + [f"reason={self.reason!r}"] * bool(self.reason))})'

    @property
    def accepted(self) -> bool:
        """Return whether the image was matched."""
        return self.status is Status.MATCH

    @property
    def is_late(self) -> bool:
        """Return whether it is one of the late matches of another."""
        return self.columns is not None

    @property
    def place(self) -> int:
        """Return the matched place, of the image at ``position``; -1 unless matched."""
        return self.path.place if self.accepted else -1

    @cached_property
    def newest(self) -> int:
        """Return the place aligned with the newest image; -1 unless matched."""
        pairs = self.path.pairs
        return aligned_index(pairs, int(pairs[-1, 0])) if self.accepted else -1

    @property
    def distance(self) -> float:
        """Return 1 - probability, in mode paper the distance of the path; NaN without a path."""
        return self.path.distance if math.isnan(self.probability) else 1 - self.probability

    @property
    def threshold(self) -> float:
        """Return the distance below which a window is matched (1 - probability); NaN = none."""
        return self.limits.threshold

    @property
    def last_image(self) -> int:
        """Return the place of the newest image on a route that grows with it, -1 = none."""
        return self.first_image + len(self.window_stamps) - 1 if self.first_image >= 0 else -1

    @property
    def position(self) -> int:
        """Return the position in the window of the image that ``place`` belongs to."""
        return 0 if self.is_oldest else (len(self.window_stamps) - 1) // 2

    @property
    def path_probabilities(self) -> np.ndarray:
        """Return the probability of each place of the path, (m,); empty in mode paper."""
        shares = self.path.shares
        if not len(shares):
            return NO_SHARES
        return np.minimum(self.probability * (shares / max(shares[self.position], MIN_SHARE)), 1)

    def with_probability(self, probability: float, inliers: int = -1) -> 'Match':
        """Return the match of mode robust with another probability, accepted or not by it."""
        status, reason = self.limits.decide(1 - probability, probability)
        return replace(
            self, status=status, reason=reason, probability=probability, inliers=inliers
        )
