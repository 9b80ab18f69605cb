# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an image showed of a taught route."""

from dataclasses import dataclass
import math

from stavpr_ros.relative_pose.offset import Offset

BRIDGE_SIMILARITY = 0.3  # minimum, to the expected place, of an image without a match


@dataclass(frozen=True)
class Observation:
    """
    Result of an image.

    :param stamp: when the image was taken, seconds.
    :param place: place that the image shows; -1 = unknown.
    :param probability: probability of the place; NaN = no match, it is the expected place.
    :param offset: offset of the image against the place; None = unknown.
    :param is_new: the image differs from the images before.
    :param is_compared: the image was compared with the map; False = skipped, as no keyframe.
    """

    stamp: float
    place: int
    probability: float
    offset: Offset | None
    is_new: bool = True
    is_compared: bool = True

    @property
    def is_confirmed(self) -> bool:
        """Whether the image is of the route: its sequence is matched, and it is similar."""
        if self.place < 0 or self.offset is None:
            return False
        return self.offset.is_similar and (
            self.is_matched or not self.is_compared or self.offset.similarity >= BRIDGE_SIMILARITY
        )

    @property
    def is_matched(self) -> bool:
        """Whether the place is of a match."""
        return not math.isnan(self.probability)
