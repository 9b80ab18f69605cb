# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The geometric check of matches: the thumbnails of query and place, by keypoints."""

from dataclasses import replace

import numpy as np
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.recognition import Status
from stavpr_ros.recognition.verification import (
    GeometricEvidence,
    GeometricSettings,
    PlaceVerifier,
)


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
