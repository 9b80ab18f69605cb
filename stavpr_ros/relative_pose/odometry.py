# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The position of a query along the track of the places, by the odometry of both passes."""

import math

import numpy as np
from stavpr_ros.mapping.trajectory import interpolate
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.relative_pose.pair import Edge, MatchedPair, Source

MAX_OFFSET, STEP = 4.0, 0.05  # offsets that are tried, and between two of them, places
NEAR = 0.5  # places around the least sum to which a parabola is fitted
MIN_IMAGES = 3
MIN_STEP = 0.01  # meters
# Deviations: along the track, in places, and at least (m); across it (m); of the rotation (rad).
ALONG, MIN_ALONG, ACROSS, TURN = 0.5, 0.1, 1.25, math.radians(3)


def align(pair: MatchedPair) -> Edge:
    """
    Place the query on the track of the places.

    Odometry has the places of the images of the window relative to each other. So the window is
    moved along the track as a whole, to where the sum of its image distances is least. Unlike the
    path of the recognizer, which moves at one of a few speeds, this has no bias. The offset to the
    side is unknown, and has a variance accordingly.
    """
    if np.isnan(pair.pose(pair.place)).any():
        return Edge(Source.NONE, 'the place has no pose: record maps and routes with odometry')
    if np.isnan(pair.query_pose).any():
        return Edge(Source.NONE, 'no odometry at the middle image of the window')
    track, driven = _lengths(pair.poses), _lengths(pair.query_poses)
    from scipy.interpolate import CubicSpline

    places, images = np.flatnonzero(np.isfinite(track)), np.flatnonzero(np.isfinite(driven))
    spaced = places[np.diff(track[places], prepend=-1) > MIN_STEP]  # not where the robot stood
    if min(len(images), len(spaced)) < MIN_IMAGES or not pair.spacing > 0:
        reason = 'the odometry of query or places has gaps, or no motion, in the window'
        return Edge(Source.NONE, reason)
    offsets = np.arange(-MAX_OFFSET, MAX_OFFSET + STEP, STEP) * pair.spacing
    start = float(track[pair.place - pair.first])
    total = np.zeros(len(offsets))
    rows = pair.distances[np.ix_(images, spaced)]
    compared = np.where(np.isfinite(rows), rows, -np.inf)
    # places that are not compared are as far as the farthest
    rows = np.where(np.isfinite(rows), rows, compared.max(axis=1, keepdims=True))
    rows = np.nan_to_num(rows, neginf=0)  # an image that is compared with none
    # smooth: between places, linear interpolation would pull all images to the same side
    grid = np.arange(track[spaced[0]], track[spaced[-1]], STEP * pair.spacing)
    smooth = CubicSpline(track[spaced], rows.T)(grid)
    for column, image in enumerate(images):
        at = start + offsets + pair.direction * (driven[image] - driven[pair.middle])
        total += np.interp(at, grid, smooth[:, column])
    at = start + _find_minimum(offsets, total)
    place = matrices(pair.pose(pair.place))
    pose = to_poses(inverse(place) @ matrices(_on_track(pair.poses[places], track[places], at)))
    direction = _direction(pair, place)
    along = max(ALONG * pair.spacing, MIN_ALONG)
    covariance = np.diag([ACROSS**2] * 3 + [TURN**2] * 3)
    covariance[:3, :3] += (along**2 - ACROSS**2) * np.outer(direction, direction)
    return Edge(Source.ALIGNED, '', pose, covariance)


def _find_minimum(offsets: np.ndarray, total: np.ndarray) -> float:
    """Return the offset at the vertex of the parabola around the least sum."""
    lowest = int(np.argmin(total))
    width = round(NEAR / STEP)
    window = slice(max(0, lowest - width), lowest + width + 1)
    a, b, _ = np.polyfit(offsets[window], total[window], 2)
    if not a > 0:
        return float(offsets[lowest])
    return float(np.clip(-b / (2 * a), offsets[window][0], offsets[window][-1]))


def _lengths(poses: np.ndarray) -> np.ndarray:
    """Return the distance driven until each pose (m, 7); NaN where a pose is unknown."""
    indices = np.flatnonzero(np.isfinite(poses[:, 0]))
    lengths = np.full(len(poses), np.nan)
    steps = np.linalg.norm(np.diff(poses[indices, :3], axis=0), axis=1)
    lengths[indices] = np.concatenate([[0.0], np.cumsum(steps)])[: len(indices)]
    return lengths


def _on_track(poses: np.ndarray, track: np.ndarray, at: float) -> np.ndarray:
    """Return the pose (7,) at a length of the track, between the poses (m, 7) of its places."""
    after = int(np.clip(np.searchsorted(track, at), 1, len(track) - 1))
    step = track[after] - track[after - 1]
    part = 0.0 if step == 0 else (at - track[after - 1]) / step
    return interpolate(poses[after - 1], poses[after], float(np.clip(part, 0, 1)))


def _direction(pair: MatchedPair, place: np.ndarray) -> np.ndarray:
    """Return the direction of the track at the place, in the base of the place, (3,)."""
    positions = pair.poses[np.isfinite(pair.poses[:, 0]), :3]
    nearest = int(np.argmin(np.linalg.norm(positions - place[:3, 3], axis=1)))
    ahead = positions[min(nearest + 1, len(positions) - 1)] - positions[max(nearest - 1, 0)]
    length = float(np.linalg.norm(ahead))
    return place[:3, :3].T @ ahead / length if length > 0 else np.array([1.0, 0, 0])
