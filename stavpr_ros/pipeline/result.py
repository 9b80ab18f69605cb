# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result for one image: a match, if its window has one, and what the pipeline adds to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np
from stavpr_ros.alignment.path import aligned_index
from stavpr_ros.recognition import Candidate, Match, Status
from stavpr_ros.recognition.match import Limits


@dataclass(frozen=True, eq=False)
class ImageResult:
    """
    The result for one image; indices are 0-based places of the map.

    :param status: only ``MATCH`` names a place.
    :param reason: why there is no match, one sentence; empty for ``MATCH`` and ``MAPPED``.
    :param threshold: the limit of the distance that applied to the match; without a match, the
        general one. NaN = not set.
    :param cause: why the image is in no window, two or three words for statistics; '' = it is in
        one.
    :param match: of the window that ends with the image, as the recognizer made it; None = none.
    :param distance: of the match, as is the probability; :class:`GeometricCheck` changes both.
    :param probability: NaN in mode paper.
    :param inliers: of the geometric check, -1 = not checked.
    :param candidates: nearest places, nearest first.
    :param session_probabilities: of each session of the map, that the newest image is on it;
        empty in mode paper, and of a map without sessions.
    :param late: loop closure: results of earlier images that had no match until now.
    :param image_index: place of a growing map that this image has become, -1 = none.
    :param image: the decoded image, RGB; None = not decoded.
    :param stages: duration of each stage, seconds.
    :param relative_yaw: of the robot in the base of the matched place, radians to the left, by the
        mountings of the two cameras; 0 also where the mounting in the map is unknown.
    """

    status: Status
    reason: str = ''
    threshold: float = math.nan
    cause: str = ''
    match: Match | None = None
    distance: float = math.nan
    probability: float = math.nan
    inliers: int = -1
    candidates: tuple[Candidate, ...] = ()
    session_probabilities: tuple[float, ...] = ()
    late: 'tuple[ImageResult, ...]' = ()
    image_index: int = -1
    image: np.ndarray | None = None
    stages: Mapping[str, float] = field(default_factory=dict)
    relative_yaw: float = 0.0

    @classmethod
    def of_match(cls, match: Match) -> 'ImageResult':
        """Return the result of a match, and of its late ones."""
        return cls(
            *(match.status, match.reason, match.threshold, ''),
            *(match, match.distance, match.probability),
            late=tuple(map(cls.of_match, match.late)),
            image_index=match.image_index,
        )

    @property
    def accepted(self) -> bool:
        """Whether the image was matched."""
        return self.status is Status.MATCH

    @property
    def nearest_index(self) -> int:
        """Return the place of the match, accepted or not; -1 = none."""
        return self.match.sequence.middle if self.match and self.match.sequence else -1

    @property
    def place_index(self) -> int:
        """Return the matched place; -1 unless matched."""
        return self.nearest_index if self.accepted else -1

    @property
    def newest_index(self) -> int:
        """Return the place aligned with the newest image; -1 unless matched."""
        if self.match is None or not self.accepted:
            return -1
        return aligned_index(self.match.path, int(self.match.path[-1, 0]))

    @property
    def path_probabilities(self) -> np.ndarray:
        """Return the probability of each place of the path, (m,); empty in mode paper."""
        ratios = np.empty(0) if self.match is None else self.match.path_ratios
        return np.minimum(self.probability * ratios, 1)

    def with_probability(self, probability: float) -> 'ImageResult':
        """Return the result of mode robust with another probability, matched or not by it."""
        assert self.match is not None
        distance, limits = 1 - probability, Limits(self.threshold, self.match.min_probability)
        status, reason = limits.decide(distance, probability)
        return replace(
            self, status=status, reason=reason, distance=distance, probability=probability
        )

    def with_candidates(self, ranked: Sequence[Candidate]) -> 'ImageResult':
        """Return the result with its ranked places; the first is the match's."""
        own = [
            replace(first, distance=self.distance, probability=self.probability)
            for first in ranked[:1]
        ]
        return replace(self, candidates=(*own, *ranked[1:]))
