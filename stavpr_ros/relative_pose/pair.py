# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A matched pair of images, with what is around them, and their relative pose: an edge."""

from collections.abc import Callable
from dataclasses import dataclass, field
import enum
from functools import cached_property
import math

import numpy as np
from stavpr_ros.errors import MapFileError
from stavpr_ros.mapping import GrowingMap, Map
from stavpr_ros.method import Match

NEIGHBORS = 4  # places before and after a place that its keypoints are triangulated with
LANDMARK_RADIUS = 1  # places before and after the place whose landmarks are used as well
TRIANGULATION_RADIUS = NEIGHBORS + LANDMARK_RADIUS


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
    :param covariance: covariance of x y z and rotations about the place's fixed axes, (6, 6).
    :param inliers: inliers of PnP, -1 = not tried.
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
        """Return whether there is a relative pose."""
        return self.source in (Source.ALIGNED, Source.PNP)


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """
    An image of a window and its place; nothing in it changes when the map grows.

    It is the middle image, or the oldest of a late match.

    :param source: the map that the place is of.
    :param place: its index.
    :param query: thumbnail of the image, RGB (h, w, 3) uint8; None = unknown.
    :param query_poses: poses of the base at the window's images, shape (l, 7); NaN = unknown.
    :param middle: position of the image in the window.
    :param distances: of the images of the window to the places around, shape (l, k); +inf = not
        compared. Empty where alignment by odometry is impossible or not wanted.
    :param first: index of the first of the places around it, all of the place's session.
    :param poses: poses of the base at these places, shape (k, 7); NaN = unknown.
    :param direction: 1 = the camera moves along the places, -1 = against them.
    :param thumbnails: of these places at most ``TRIANGULATION_RADIUS`` away, by index: JPEG
        images, empty = none.
    :param relative_yaw: yaw of the query's base in the base of the place, by the mountings of the
        cameras, radians to the left.
    """

    source: Map | GrowingMap
    place: int
    query: np.ndarray | None
    query_poses: np.ndarray
    middle: int
    distances: np.ndarray
    first: int
    poses: np.ndarray
    thumbnails: dict[int, bytes]
    direction: int = 1
    relative_yaw: float = 0.0

    def pose(self, place: int) -> np.ndarray:
        """Return the pose of a place near by, shape (7,); NaN = unknown."""
        return np.asarray(self.poses[place - self.first])

    @property
    def query_pose(self) -> np.ndarray:
        """Return the pose of the query, in the frame of the odometry, shape (7,)."""
        return np.asarray(self.query_poses[self.middle])

    @cached_property
    def spacing(self) -> float:
        """Return the median distance between successive places, meters; NaN = unknown."""
        steps = np.linalg.norm(np.diff(self.poses[:, :3], axis=0), axis=1)
        steps = steps[np.isfinite(steps)]
        return float(np.median(steps)) if len(steps) else float('nan')


def matched_pair(
    match: Match,
    places: Map | GrowingMap,
    query: np.ndarray | None,
    query_poses: np.ndarray,
    distances_to: Callable[[np.ndarray], np.ndarray] | None,
    relative_yaw: float = 0.0,
) -> MatchedPair:
    """
    Copy what the edge of a match needs.

    :param query, query_poses, relative_yaw: see :class:`MatchedPair`.
    :param distances_to: returns the distances of the window to places (k,), shape (l, k), +inf =
        not compared; None = not needed. Called only where the pair has both poses.
    """
    start = places.first if isinstance(places, GrowingMap) else 0
    place, on_path = match.place, match.path.pairs[:, 1]
    low, high = int(on_path.min()), int(on_path.max())
    low = max(start, min(low, place) - TRIANGULATION_RADIUS)
    high = min(start + len(places), max(high, place) + TRIANGULATION_RADIUS + 1)
    session = places.place(place).session  # its neighbors in another one were taken elsewhere
    others = np.array([i for i in range(low, high) if places.place(i).session != session], int)
    low = int(others[others < place].max(initial=low - 1)) + 1
    high = int(others[others > place].min(initial=high))
    poses = np.full((high - low, 7), np.nan)
    if places.poses is not None:
        poses[:] = places.poses[low - start : high - start]
    distances = np.empty((0, high - low), np.float32)
    has_poses = not np.isnan([poses[place - low], query_poses[match.position]]).any()
    if distances_to is not None and has_poses:
        distances = distances_to(np.arange(low, high))
    thumbnails, radius = {}, TRIANGULATION_RADIUS
    if len(places.thumbnails):
        for index in range(max(low, place - radius), min(high, place + radius + 1)):
            thumbnails[index] = _thumbnail(places, index - start)
    return MatchedPair(
        places, place, query, query_poses, match.position, distances, low, poses, thumbnails,
        match.path.direction, relative_yaw,
    )  # fmt: skip


def _thumbnail(places: Map | GrowingMap, position: int) -> bytes:
    try:
        return places.thumbnails[position]
    except MapFileError:  # the file has been overwritten since it was opened
        return b''
