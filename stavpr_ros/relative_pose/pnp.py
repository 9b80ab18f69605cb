# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose of a query by keypoints that it shares with the landmarks of a place."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from stavpr_ros.mapping.transforms import cross, inverse
from stavpr_ros.method.verification import mutual_matches
from stavpr_ros.relative_pose.landmarks import Landmarks, RATIO, View

MIN_INLIERS = 14  # keypoints of the query; 1,000 pairs of wrong places had 12 at most
PIXELS = 2.5  # distance of an inlier from its landmark
ITERATIONS, CONFIDENCE = 500, 0.999
STEPS = 6  # steps of Gauss and Newton
MIN_SCALE = 0.05  # inverse depth over the triangulated one
MIN_DEPTH = 0.05  # meters


@dataclass(frozen=True, eq=False)
class PnpPose:
    """
    The pose of a query's camera in the optical frame of a place.

    :param matrix: (4, 4); None = fewer than ``MIN_INLIERS``, or not near the place.
    :param covariance: of the position and the rotation about the fixed axes of the place, for a
        noise of one pixel in the query and in the views of the landmarks, shape (6, 6).
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
    Find the pose of a query: EPnP in RANSAC, refined with the inliers and their depths.

    :param landmarks: of the place, and of others near by in its frame: a point that several of
        them have is an inlier once.
    """
    matches = _match(query, landmarks)
    if matches.count < MIN_INLIERS:
        return NOTHING
    matrix = np.diag([query.focal, query.focal, 1.0])
    try:
        success, turn, shift, inliers = cv2.solvePnPRansac(
            matches.points, matches.pixels, matrix, None, iterationsCount=ITERATIONS,
            reprojectionError=PIXELS, confidence=CONFIDENCE, flags=cv2.SOLVEPNP_EPNP,
        )  # fmt: skip
    except cv2.error:  # points in a line
        return NOTHING
    if not success or inliers is None:
        return NOTHING
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    indices = inliers.ravel()
    for _ in range(2):  # the second time with the inliers of the refined pose
        pairs = matches.select(indices)
        try:
            motion, covariance = _refine(pairs, motion)
        except np.linalg.LinAlgError:  # the landmarks do not determine a pose
            return NOTHING
        off, ahead = matches.residuals(motion)
        distances = np.linalg.norm(off, axis=1)
        indices = np.flatnonzero(ahead & (distances < PIXELS))
        count = matches.select(indices).count
        if count < MIN_INLIERS:
            return PnpPose(None, NOTHING.covariance, count, np.nan)
    pose = inverse(motion)
    error = float(np.sqrt(np.mean(distances[indices] ** 2)))
    axes = np.kron(np.eye(2), pose[:3, :3])
    # observations of one keypoint are not independent
    covariance *= len(pairs.keypoint) / pairs.count
    return PnpPose(pose, axes @ covariance @ axes.T, count, error)


@dataclass(frozen=True, eq=False)
class _Matches:
    """
    Keypoints of a query and the landmarks that they match, m pairs; see :class:`Landmarks`.

    :param keypoint: number of the keypoint, shape (m,); pixels: from the principal point, (m, 2).
    :param focal: focal length, pixels of the thumbnail.
    """

    keypoint: np.ndarray
    pixels: np.ndarray
    points: np.ndarray
    rays: np.ndarray
    deviations: np.ndarray
    focal: float

    @property
    def count(self) -> int:
        """Return the number of keypoints."""
        return len(np.unique(self.keypoint))

    def select(self, use: np.ndarray) -> '_Matches':
        """Return the pairs of these indices."""
        arrays = (self.keypoint, self.pixels, self.points, self.rays, self.deviations)
        keypoint, pixels, points, rays, deviations = (array[use] for array in arrays)
        return _Matches(keypoint, pixels, points, rays, deviations, self.focal)

    def residuals(self, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far landmarks are off, pixels, (m, 2), and whether they are ahead, (m,)."""
        x, y, z = (self.points @ motion[:3, :3].T + motion[:3, 3]).T
        ahead = z > 0
        z = np.where(ahead, z, 1.0)
        return self.focal * np.stack([x / z, y / z], axis=1) - self.pixels, ahead


def _match(query: View, landmarks: Sequence[Landmarks]) -> _Matches:
    """Match the query with the landmarks of each place."""
    pairs = [mutual_matches(query.descriptors, place.descriptors, RATIO) for place in landmarks]
    keypoint = np.concatenate([keypoints for keypoints, _ in pairs])
    points, rays, deviations = (
        np.concatenate(
            [getattr(place, name)[m] for place, (_, m) in zip(landmarks, pairs, strict=True)]
        )
        for name in ('points', 'rays', 'deviations')
    )
    pixels = np.ascontiguousarray(query.rays[keypoint] * query.focal)
    return _Matches(keypoint, pixels, points, rays, deviations, query.focal)


def _refine(pairs: _Matches, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Refine a pose together with the inverse depths of its landmarks: maximum likelihood.

    With the landmarks as they were triangulated, the errors of their depths would shorten the
    motion (regression dilution). Residuals, of depths as well, have Cauchy's weights.

    :param motion: from the frame of the landmarks to the query's frame, (4, 4).
    :returns: the motion, and the covariance of its translation and rotation (6, 6), for a noise of
        one pixel.
    :raises LinAlgError: the landmarks do not determine it.
    """
    shift = np.zeros(len(pairs.points))  # changes of inverse depths, in deviations
    for _ in range(STEPS):
        scale = np.maximum(1 + shift * pairs.deviations, MIN_SCALE)
        points = pairs.points + pairs.rays * (1 / scale - 1)[:, None]
        x, y, z = in_query = (points @ motion[:3, :3].T + motion[:3, 3]).T
        z = np.maximum(z, MIN_DEPTH)
        off = pairs.focal * np.stack([x / z, y / z], axis=1) - pairs.pixels
        zero = np.zeros_like(z)
        projection = np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]])
        projection = pairs.focal * projection.transpose(2, 0, 1)
        by_pose = np.concatenate([projection, -projection @ cross(in_query.T)], axis=2)
        slope = -pairs.rays * (pairs.deviations / scale**2)[:, None] @ motion[:3, :3].T
        by_depth = np.einsum('mij,mj->mi', projection, slope)
        weight = 1 / (1 + (off**2).sum(axis=1) + shift**2)
        hessian = weight * ((by_depth**2).sum(axis=1) + 1)
        pull = weight * ((by_depth * off).sum(axis=1) + shift)
        coupling = weight[:, None] * np.einsum('mij,mi->mj', by_pose, by_depth)
        normal = np.einsum('m,mij,mik->jk', weight, by_pose, by_pose)
        normal -= (coupling / hessian[:, None]).T @ coupling  # Schur complement
        right = np.einsum('m,mij,mi->j', weight, by_pose, off) - coupling.T @ (pull / hessian)
        step = -np.linalg.solve(normal, right)
        shift -= (pull + coupling @ step) / hessian
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = cv2.Rodrigues(step[3:])[0], step[:3]
        motion = change @ motion
    return motion, np.linalg.inv(normal)
