# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where a query is along the track of the places, by the odometry of both passes."""

import math

import numpy as np
from stavpr_ros.mapping.trajectory import interpolate
from stavpr_ros.relative_pose.edge import Edge, Source
from stavpr_ros.relative_pose.pair import MatchedPair
from stavpr_ros.relative_pose.transforms import inverse, matrix_of, pose_of

INNER = 0.5  # share of the window around its middle whose pairs count
LEAST_PAIRS = 3
# Deviations: along the track, in places, and at least (m); across it (m); of the rotation (rad).
ALONG, LEAST_ALONG, ACROSS, TURN = 0.5, 0.1, 1.25, math.radians(3)


def align(pair: MatchedPair) -> Edge:
    """
    Place the query on the track of the places.

    Each pair of the path says where on the track the query's middle image is: where its place is,
    less the distance that the query moved between. The median of them is free of calibration, and
    of single wrong pairs. The offset to the side is unknown, and its variance says so.
    """
    if np.isnan(pair.pose(pair.place)).any():
        return Edge(Source.NONE, 'the place has no pose: record maps and routes with odometry')
    if np.isnan(pair.query_pose).any():
        return Edge(Source.NONE, 'no odometry at the middle image of the window')
    track, driven = _lengths(pair.poses), _lengths(pair.query_poses)
    inner = np.abs(pair.path[:, 0] - pair.middle) <= INNER * len(driven) / 2
    images, places = pair.path[inner].T
    ahead = track[places - pair.first] - driven[images] + driven[pair.middle]
    ahead = ahead[np.isfinite(ahead)]
    if len(ahead) < LEAST_PAIRS:
        return Edge(Source.NONE, 'the odometry of query or places has gaps in the window')
    at = float(np.median(ahead))
    known = np.flatnonzero(np.isfinite(track))
    place = matrix_of(pair.pose(pair.place))
    pose = pose_of(inverse(place) @ matrix_of(_on_track(pair.poses[known], track[known], at)))
    direction = _direction(pair, place)
    along = max(ALONG * pair.spacing, LEAST_ALONG)
    covariance = np.diag([ACROSS**2] * 3 + [TURN**2] * 3)
    covariance[:3, :3] += (along**2 - ACROSS**2) * np.outer(direction, direction)
    return Edge(Source.ALIGNED, '', pose, covariance)


def _lengths(poses: np.ndarray) -> np.ndarray:
    """Return the distance driven until each pose (m, 7); NaN where a pose is unknown."""
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    lengths = np.full(len(poses), np.nan)
    steps = np.linalg.norm(np.diff(poses[known, :3], axis=0), axis=1)
    lengths[known] = np.concatenate([[0.0], np.cumsum(steps)])[: len(known)]
    return lengths


def _on_track(poses: np.ndarray, track: np.ndarray, at: float) -> np.ndarray:
    """Return the pose (7,) at a length of the track, between the poses (m, 7) of its places."""
    after = int(np.clip(np.searchsorted(track, at), 1, len(track) - 1))
    step = track[after] - track[after - 1]
    part = 0.0 if step == 0 else (at - track[after - 1]) / step
    return interpolate(poses[after - 1], poses[after], float(np.clip(part, 0, 1)))


def _direction(pair: MatchedPair, place: np.ndarray) -> np.ndarray:
    """Return the direction of the track at the place, in the base of the place, (3,)."""
    known = pair.poses[np.isfinite(pair.poses[:, 0]), :3]
    nearest = int(np.argmin(np.linalg.norm(known - place[:3, 3], axis=1)))
    ahead = known[min(nearest + 1, len(known) - 1)] - known[max(nearest - 1, 0)]
    length = float(np.linalg.norm(ahead))
    return place[:3, :3].T @ ahead / length if length > 0 else np.array([1.0, 0, 0])
