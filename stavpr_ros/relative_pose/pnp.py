# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose of a query by keypoints that it shares with the landmarks of a place."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from stavpr_ros.mapping.transforms import cross, inverse
from stavpr_ros.recognition.verification import mutual_matches
from stavpr_ros.relative_pose.landmarks import Landmarks, RATIO, View

LEAST_INLIERS = 14  # keypoints of the query; 1,000 pairs of wrong places had 12 at most
PIXELS = 2.5  # of an inlier, off its landmark
ITERATIONS, CONFIDENCE = 500, 0.999


@dataclass(frozen=True, eq=False)
class PnpPose:
    """
    The pose of a query's camera in the optical frame of a place.

    :param matrix: (4, 4); None = fewer than ``LEAST_INLIERS``, or not near the place.
    :param covariance: of the position and the rotation about the fixed axes of the place, by the
        Jacobian alone, for a noise of one pixel, shape (6, 6).
    :param inliers: matches that the pose explains.
    :param error: root mean square of their distances, pixels of the thumbnail; NaN = none.
    """

    matrix: np.ndarray | None
    covariance: np.ndarray
    inliers: int
    error: float


NOTHING = PnpPose(None, np.full((6, 6), np.nan), 0, float('nan'))


def solve_pnp(query: View, landmarks: Sequence[Landmarks]) -> PnpPose:
    """
    Find the pose of a query: EPnP in RANSAC, and its refinement with the inliers.

    :param landmarks: of the place, and of others near by in its frame: a point that several of
        them have is an inlier once.
    """
    pairs = [mutual_matches(query.descriptors, each.descriptors, RATIO) for each in landmarks]
    mine = np.concatenate([own for own, _ in pairs])
    if len(np.unique(mine)) < LEAST_INLIERS:
        return NOTHING
    points = np.concatenate(
        [each.points[theirs] for each, (_, theirs) in zip(landmarks, pairs, strict=True)]
    )
    pixels = np.ascontiguousarray(query.rays[mine] * query.focal)
    matrix = np.diag([query.focal, query.focal, 1.0])
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points, pixels, matrix, None, iterationsCount=ITERATIONS, reprojectionError=PIXELS,
            confidence=CONFIDENCE, flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
    except cv2.error:  # points in a line
        return NOTHING
    if not found or inliers is None:
        return NOTHING
    count = 0
    for _ in range(2):  # the second time with the inliers of the refined pose
        chosen = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(
            points[chosen], pixels[chosen], matrix, None, turn, shift
        )
        off = cv2.projectPoints(points, turn, shift, matrix, None)[0][:, 0] - pixels
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        ahead = points @ motion[2, :3] + motion[2, 3] > 0
        distances = np.linalg.norm(off, axis=1)
        inliers = np.flatnonzero(ahead & (distances < PIXELS))
        count = len(np.unique(mine[inliers]))
        if count < LEAST_INLIERS:
            return PnpPose(None, NOTHING.covariance, count, np.nan)
    pose = inverse(motion)
    error = float(np.sqrt(np.mean(distances[inliers] ** 2)))
    # observations of one keypoint are not independent
    covariance = _covariance(pose, points[inliers], query.focal) * len(inliers) / count
    return PnpPose(pose, covariance, count, error)


def _covariance(pose: np.ndarray, points: np.ndarray, focal: float) -> np.ndarray:
    """Return the inverse of the information of observations with a noise of one pixel, (6, 6)."""
    away = points - pose[:3, 3]
    x, y, z = (away @ pose[:3, :3]).T
    zero = np.zeros_like(z)
    projection = focal * np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]])
    turned = projection.transpose(2, 0, 1) @ pose[:3, :3].T
    # a motion of the query by d and its turn by w move a point by w x away - d, reversed
    jacobian = np.concatenate([-turned, turned @ cross(away)], axis=2).reshape(-1, 6)
    return np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
