# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The result for one image: its match, and what the pipeline adds to it.

The geometric check compares the thumbnails of query and place, by keypoints.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from stavpr_ros.former import FormerNames
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.method import Candidate, Match, Status
from stavpr_ros.method.verification import (
    GeometricEvidence,
    GeometricSettings,
    PlaceVerifier,
)


@dataclass(frozen=True, eq=False)
class ImageResult(FormerNames):
    """
    The match of one image, and what the pipeline adds to it.

    :param match: after the geometric check; without a path, of an image that is in no window.
    :param cause: why the image is in no window, two or three words for statistics; '' = it is in
        one.
    :param image_index: place of a growing map that this image has become, -1 = none.
    :param candidates: nearest places, nearest first.
    :param session_probabilities: of each session of the map, that the newest image is on it;
        empty in mode paper, and of a map without sessions.
    :param relative_yaw: of the robot in the base of the matched place, radians to the left, by the
        mountings of the two cameras; 0 also where the mounting in the map is unknown.
    :param image: the decoded image, RGB; None = not decoded.
    :param stages: duration of each stage, seconds.
    """

    match: Match
    cause: str = ''
    image_index: int = -1
    candidates: tuple[Candidate, ...] = ()
    session_probabilities: tuple[float, ...] = ()
    relative_yaw: float = 0.0
    image: np.ndarray | None = None
    stages: Mapping[str, float] = field(default_factory=dict)


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
        match: Match,
        places: PlaceMap | GrowingMap,
        query: np.ndarray | None,
        is_weighed: bool,
    ) -> Match:
        """
        Return a match after the check; without thumbnails, as it is.

        Matches with too few inliers are rejected.

        :param query: thumbnail of its image, RGB (h, w, 3) uint8; None = unknown.
        :param is_weighed: the result changes the probability instead (:class:`GeometricEvidence`),
            where the match is doubtful.
        """
        if match.path.place < 0 or query is None:
            return match
        if not (self._evidence.wants(match.probability) if is_weighed else match.accepted):
            return match
        inliers = self._verifier.inliers(query, places, match.path.place)
        if inliers is None:
            return match
        least = self.settings.min_inliers
        if is_weighed:
            probability = self._evidence.updated(match.probability, inliers >= least)
            return match.with_probability(probability, inliers)
        if inliers >= least:
            return replace(match, inliers=inliers)
        reason = (
            f'geometric check: {inliers} inliers are fewer than {least} (parameter min_inliers)'
        )
        return replace(match, inliers=inliers, status=Status.NO_MATCH, reason=reason)
