# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The relative pose of a query and a place, as an edge of a pose graph."""

from dataclasses import dataclass, field
import enum
import math

import numpy as np


class Source(enum.IntEnum):
    """Source of a relative pose; the constants of ``stavpr_msgs/RelativePose``."""

    NONE = 0
    ALIGNED = 1
    PNP = 2
    REFUTED = 3
    DROPPED = 4


@dataclass(frozen=True, eq=False)
class Edge:
    """
    The pose of the query's base in the base of the place.

    :param source: what it follows from; only ``ALIGNED`` and ``PNP`` have a pose.
    :param reason: why the source is not ``PNP``; empty = it is ``PNP``.
    :param pose: x y z (meters) and quaternion x y z w, shape (7,).
    :param covariance: of x y z and of rotations about the fixed axes of the place, shape (6, 6).
    :param inliers: of PnP, -1 = not tried.
    :param error: root mean square of their distances, pixels of the thumbnail; NaN = none.
    :param independent: far enough from the last such edge.
    """

    source: Source
    reason: str = ''
    pose: np.ndarray = field(default_factory=lambda: np.array([0, 0, 0, 0, 0, 0, 1.0]))
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    inliers: int = -1
    error: float = math.nan
    independent: bool = False

    @property
    def has_pose(self) -> bool:
        """Whether there is a relative pose."""
        return self.source in (Source.ALIGNED, Source.PNP)
