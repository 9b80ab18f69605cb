# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The result for one image: its match, and what the pipeline adds to it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from stavpr_ros.former import FormerNames
from stavpr_ros.method import Candidate, Match, Status


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

    @property
    def own_place(self) -> int:
        """Return the place that the image has become, or else that it matches; -1 = none."""
        is_mapped = self.match.status is Status.MAPPED
        return self.image_index if is_mapped else self.match.newest
