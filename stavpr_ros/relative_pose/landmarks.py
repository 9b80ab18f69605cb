# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Points of a place in three dimensions: its keypoints, triangulated with its neighbors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from stavpr_ros.mapping.camera import Camera
from stavpr_ros.method.verification import mutual_matches
from stavpr_ros.relative_pose.bundle import MIN_INVERSE_DEPTH, Observations, odometry_information

RATIO = 0.8  # largest ratio of the distances to the nearest two descriptors
FEATURES = 600  # most keypoints of a thumbnail
CONTRAST = 0.02  # threshold of SIFT; thumbnails are small, so that weaker keypoints count
PIXELS = (6.0, 4.0, 3.0, 2.0)  # how far an observation may be off its landmark, round by round
STEPS = 2  # steps of the bundle adjustment in each round but the last
MAX_SHIFT = 2.0  # deviation of a landmark in an image one meter away, pixels


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
    :param rays: from the camera of the place to the points, shape (m, 3), meters.
    :param deviations: relative deviations of the inverse depths for a noise of one pixel, (m,).
    :param descriptors: descriptors of the keypoints, shape (m, 128), float32.
    :param motions: from that frame to the neighbors' frames, refined, shape (neighbors, 4, 4).
    """

    points: np.ndarray
    rays: np.ndarray
    deviations: np.ndarray
    descriptors: np.ndarray
    motions: np.ndarray

    def transform(self, motion: np.ndarray) -> 'Landmarks':
        """Return the points in another frame, by the transform to it, shape (4, 4)."""
        rays, points = (vectors @ motion[:3, :3].T for vectors in (self.rays, self.points))
        return replace(self, points=points + motion[:3, 3], rays=rays)


def view_of(image: np.ndarray, camera: Camera) -> View:
    """
    Detect the keypoints of a thumbnail.

    :param image: RGB, uint8, shape (h, w, 3).
    :raises InputError: of other proportions than the camera's.
    """
    height, width = image.shape[:2]
    camera.require_fitting(width, height)
    library: Any = cv2  # its types leave SIFT out
    detector = library.SIFT_create(FEATURES, contrastThreshold=CONTRAST)
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = detector.detectAndCompute(gray, None)
    focal = camera.focal[0] * width / camera.width
    if descriptors is None:
        return View(np.empty((0, 2)), np.empty((0, 128), np.float32), focal)
    points = np.array([point.pt for point in keypoints])
    return View(camera.rays(points, width, height), descriptors, focal)


def triangulate(
    place: View, neighbors: Sequence[tuple[View, np.ndarray]], before: int
) -> Landmarks:
    """
    Triangulate the keypoints of a place.

    A landmark is on the ray r of its keypoint, at the inverse depth rho: a neighbor with the
    motion (R, t) observes it in the direction R r + rho t, which is linear in rho. The motions are
    of odometry; they are refined together with the inverse depths (:mod:`.bundle`).

    :param neighbors: other views in the order of the drive, each with the transform (4, 4) from
        the optical frame of the place to the optical frame of the view, meters.
    :param before: the number of views before the place.
    """
    observations = _observations(place, neighbors)
    prior = motions = np.array([motion for _, motion in neighbors])
    trust = odometry_information(prior, before)
    use = np.ones(len(observations.keypoint), bool)
    rho = np.full(len(place.rays), MIN_INVERSE_DEPTH)
    for limit in PIXELS:
        for _ in range(2):
            rho, information, variance = observations.depths(motions, rho, use)
            off, ahead = observations.residuals(motions, rho)
            use = ahead & (np.linalg.norm(off, axis=1) * place.focal < limit)
        if limit != PIXELS[-1]:
            inliers = observations.select(use)
            for _ in range(STEPS):
                motions, rho = inliers.refine(motions, rho, prior, trust, place.focal)
    good = information * MAX_SHIFT**2 > 1
    rays = np.column_stack([place.rays, np.ones(len(place.rays))])
    points = rays[good] / rho[good, None]
    deviations = np.sqrt(variance[good]) / (place.focal * rho[good])
    return Landmarks(points, points, deviations, place.descriptors[good], motions)


def _observations(place: View, neighbors: Sequence[tuple[View, np.ndarray]]) -> Observations:
    """Match the place with each neighbor."""
    pairs = [mutual_matches(place.descriptors, view.descriptors, RATIO) for view, _ in neighbors]
    keypoint = np.concatenate([keypoints for keypoints, _ in pairs]).astype(np.intp)
    neighbor = np.repeat(np.arange(len(pairs)), [len(keypoints) for keypoints, _ in pairs])
    rays = np.column_stack([place.rays, np.ones(len(place.rays))])
    view_rays = [view.rays[rows] for (_, rows), (view, _) in zip(pairs, neighbors, strict=True)]
    return Observations(keypoint, neighbor, rays[keypoint], np.concatenate(view_rays))
