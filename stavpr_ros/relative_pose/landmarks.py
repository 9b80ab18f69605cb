# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points of a place in three dimensions: its keypoints, triangulated with its neighbors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.recognition.verification import mutual_matches
from stavpr_ros.relative_pose.transforms import cross_matrices

RATIO = 0.8  # of the distances to the nearest and the second nearest descriptor
FEATURES = 600  # most keypoints of a thumbnail
CONTRAST = 0.02  # of SIFT; thumbnails are small, so that weaker keypoints count
PIXELS = (6.0, 4.0, 3.0, 2.0)  # how far an observation may be off its landmark, round by round
MOST_SHIFT = 2.0  # deviation of a landmark in an image one meter away, pixels
LEAST_SHARE = 1 / 500  # least inverse depth, 1/m: everything beyond is at infinity
# Deviations of the odometry between places: of the translation, m and share of it, of the rotation
SHIFT, TURN = (0.02, 0.02), 0.02


@dataclass(frozen=True, eq=False)
class View:
    """
    The keypoints of a thumbnail.

    :param rays: x / z and y / z in the optical frame, shape (k, 2), float64.
    :param descriptors: SIFT, shape (k, 128), float32.
    :param focal: focal length, pixels of the thumbnail.
    """

    rays: np.ndarray
    descriptors: np.ndarray
    focal: float


@dataclass(frozen=True, eq=False)
class Landmarks:
    """
    Points that a place shows, in its optical frame.

    :param points: shape (m, 3), meters, float64.
    :param descriptors: of the place's keypoints, shape (m, 128), float32.
    :param motions: from that frame to those of the neighbors, refined, shape (neighbors, 4, 4).
    """

    points: np.ndarray
    descriptors: np.ndarray
    motions: np.ndarray

    def seen_from(self, motion: np.ndarray) -> 'Landmarks':
        """Return the points in another frame, to which this one has the transform (4, 4)."""
        points = self.points @ motion[:3, :3].T + motion[:3, 3]
        return replace(self, points=points)


def view_of(image: np.ndarray, camera: Camera) -> View:
    """
    Detect the keypoints of a thumbnail.

    :param image: RGB, uint8, shape (h, w, 3).
    """
    library: Any = cv2  # its types leave SIFT out
    detector = library.SIFT_create(FEATURES, contrastThreshold=CONTRAST)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    height, width = gray.shape
    focal = camera.focal[0] * width / camera.width
    if descriptors is None:
        return View(np.empty((0, 2)), np.empty((0, 128), np.float32), focal)
    points = np.array([point.pt for point in keypoints])
    return View(camera.rays(points, width, height), descriptors, focal)


def triangulate(place: View, neighbors: Sequence[tuple[View, np.ndarray]]) -> Landmarks:
    """
    Triangulate the keypoints of a place.

    A landmark is on the ray r of its keypoint, at the inverse depth rho: a neighbor with the
    motion (R, t) observes it in the direction R r + rho t, which is linear in rho. The motions are
    of odometry; they and the inverse depths are refined in turn.

    :param neighbors: other views, each with the transform (4, 4) from the optical frame of the
        place to that of the view, meters.
    """
    seen = _Observations.of(place, neighbors)
    k = len(place.rays)
    motions = np.array([motion for _, motion in neighbors])
    prior = motions.copy()
    use = np.ones(len(seen.keypoint), bool)
    rho = np.full(k, LEAST_SHARE)
    for limit in PIXELS:
        for _ in range(2):
            rho, information = seen.depths(motions, rho, use, k)
            off, ahead = seen.residuals(motions, rho)
            use = ahead & (np.linalg.norm(off, axis=1) * place.focal < limit)
        if limit != PIXELS[-1]:
            motions = seen.refined(motions, prior, rho, use, place.focal)
    good = information * MOST_SHIFT**2 > 1
    rays = np.column_stack([place.rays, np.ones(k)])
    return Landmarks(rays[good] / rho[good, None], place.descriptors[good], motions)


@dataclass(frozen=True, eq=False)
class _Observations:
    """
    Keypoints of the place, seen from its neighbors: m pairs.

    :param keypoint: its number, shape (m,); neighbor: number of the neighbor.
    :param ray: of the keypoint in the place, shape (m, 3); seen: in the neighbor, (m, 2).
    """

    keypoint: np.ndarray
    neighbor: np.ndarray
    ray: np.ndarray
    seen: np.ndarray

    @classmethod
    def of(cls, place: View, neighbors: Sequence[tuple[View, np.ndarray]]) -> '_Observations':
        """Match the place with each neighbor."""
        pairs = [
            mutual_matches(place.descriptors, view.descriptors, RATIO) for view, _ in neighbors
        ]
        keypoint = np.concatenate([mine for mine, _ in pairs]).astype(np.intp)
        neighbor = np.repeat(np.arange(len(pairs)), [len(mine) for mine, _ in pairs])
        rays = np.column_stack([place.rays, np.ones(len(place.rays))])
        seen = [view.rays[theirs] for (_, theirs), (view, _) in zip(pairs, neighbors, strict=True)]
        return cls(keypoint, neighbor, rays[keypoint], np.concatenate(seen))

    def _turned(self, motions: np.ndarray) -> np.ndarray:
        return np.einsum('mij,mj->mi', motions[self.neighbor, :3, :3], self.ray)

    def depths(
        self, motions: np.ndarray, rho: np.ndarray, use: np.ndarray, k: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the inverse depths of the k keypoints, and their information, (k,) each."""
        base, slope = self._turned(motions), motions[self.neighbor, :3, 3]
        # (base + rho slope)_xy = seen (base + rho slope)_z
        a = slope[:, :2] - self.seen * slope[:, 2:]
        b = self.seen * base[:, 2:] - base[:, :2]
        depth = np.maximum(base[:, 2] + rho[self.keypoint] * slope[:, 2], 0.05)
        weight = use / depth**2
        information = np.bincount(self.keypoint, weight * (a * a).sum(axis=1), k)
        rho = np.bincount(self.keypoint, weight * (a * b).sum(axis=1), k)
        return np.maximum(rho / np.maximum(information, 1e-12), LEAST_SHARE), information

    def residuals(self, motions: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far observations are off, (m, 2), and whether they are ahead, (m,)."""
        direction = (
            self._turned(motions) + rho[self.keypoint, None] * motions[self.neighbor, :3, 3]
        )
        ahead = direction[:, 2] > 1e-6
        return direction[:, :2] / np.where(ahead, direction[:, 2], 1)[:, None] - self.seen, ahead

    def refined(
        self, motions: np.ndarray, prior: np.ndarray, rho: np.ndarray, use: np.ndarray,
        focal: float,
    ) -> np.ndarray:  # fmt: skip
        """Return the motions after a step of Gauss and Newton each, near to those of odometry."""
        turned = self._turned(motions)
        direction = turned + rho[self.keypoint, None] * motions[self.neighbor, :3, 3]
        off, _ = self.residuals(motions, rho)
        x, y, z = direction.T
        z = np.maximum(z, 1e-6)
        zero = np.zeros_like(z)
        projection = np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]])
        projection = focal * projection.transpose(2, 0, 1)
        jacobian = np.concatenate(
            [projection * rho[self.keypoint, None, None], -projection @ cross_matrices(turned)],
            axis=2,
        )
        result = motions.copy()
        for number, (motion, before) in enumerate(zip(motions, prior, strict=True)):
            own = use & (self.neighbor == number)
            rows, error = jacobian[own].reshape(-1, 6), focal * off[own].ravel()
            weights = np.repeat(1 / (1 + (error.reshape(-1, 2) ** 2).sum(axis=1)), 2)
            shift = SHIFT[0] + SHIFT[1] * np.linalg.norm(before[:3, 3])
            trust = np.concatenate([np.full(3, shift**-2), np.full(3, TURN**-2)])
            turn = cv2.Rodrigues(motion[:3, :3] @ before[:3, :3].T)[0].ravel()
            moved = np.concatenate([motion[:3, 3] - before[:3, 3], turn])
            normal = rows.T @ (weights[:, None] * rows) + np.diag(trust)
            step = -np.linalg.solve(normal, rows.T @ (weights * error) + trust * moved)
            result[number, :3, 3] += step[:3]
            result[number, :3, :3] = cv2.Rodrigues(step[3:])[0] @ motion[:3, :3]
        return result
