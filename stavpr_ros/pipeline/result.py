# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The result for one image: a match, if its window has one, and what the pipeline adds to it.

The geometric check compares the thumbnails of query and place, by keypoints.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
import math

import numpy as np
from stavpr_ros.alignment.lm_dtw import aligned_index
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.method import Candidate, Match, Status
from stavpr_ros.method.match import Limits
from stavpr_ros.method.verification import (
    GeometricEvidence,
    GeometricSettings,
    PlaceVerifier,
)


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

    @cached_property
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


class GeometricCheck:
    """Checks matches; it learns from those since the last reset how often right ones pass."""

    def __init__(self, settings: GeometricSettings) -> None:
        self.settings = settings
        self._verifier = PlaceVerifier(settings)
        self._evidence = GeometricEvidence()

    def reset(self) -> None:
        """Forget the passes of earlier matches."""
        self._evidence = GeometricEvidence()

    def checked(
        self,
        result: ImageResult,
        places: PlaceMap | GrowingMap,
        query: np.ndarray | None,
        is_weighed: bool,
    ) -> ImageResult:
        """
        Return a result after the check; without thumbnails, as it is.

        Matches with too few inliers are rejected.

        :param query: thumbnail of its image, RGB (h, w, 3) uint8; None = unknown.
        :param is_weighed: the result changes the probability instead (:class:`GeometricEvidence`),
            where the match is doubtful.
        """
        match = result.match
        if match is None or match.sequence is None or query is None:
            return result
        if not (self._evidence.wants(match.probability) if is_weighed else match.accepted):
            return result
        inliers = self._verifier.inliers(query, places, match.sequence.middle)
        if inliers is None:
            return result
        least, result = self.settings.min_inliers, replace(result, inliers=inliers)
        if is_weighed:
            probability = self._evidence.updated(match.probability, inliers >= least)
            return result.with_probability(probability)
        if inliers >= least:
            return result
        reason = (
            f'geometric check: {inliers} inliers are fewer than {least} (parameter min_inliers)'
        )
        return replace(result, status=Status.NO_MATCH, reason=reason)
