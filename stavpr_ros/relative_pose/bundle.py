# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Bundle adjustment of a place and its neighbors, with the odometry between them as a prior.

The errors of single steps of odometry are larger than the errors of keypoints. Points that several
views have in common correct rotations and directions; odometry alone determines the lengths.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from stavpr_ros.mapping.transforms import cross, inverse

# Deviations of a step of the odometry: of the translation, m and share of it; of the rotation, rad
# per square root of a meter.
SHIFT, TURN = (0.02, 0.02), 0.01
MIN_LENGTH = 0.05  # meters of a step
MIN_INVERSE_DEPTH = 1 / 500  # 1/m: everything beyond is at infinity


@dataclass(frozen=True, eq=False)
class Observations:
    """
    Keypoints of the place, observed from its neighbors: m pairs.

    :param keypoint: its number, shape (m,); neighbor: number of the neighbor.
    :param ray: ray of the keypoint in the place, shape (m, 3); observed: in the neighbor, (m, 2).
    """

    keypoint: np.ndarray
    neighbor: np.ndarray
    ray: np.ndarray
    observed: np.ndarray

    def _rotate_rays(self, motions: np.ndarray) -> np.ndarray:
        return np.einsum('mij,mj->mi', motions[self.neighbor, :3, :3], self.ray)

    def depths(
        self, motions: np.ndarray, rho: np.ndarray, use: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return the inverse depths of the k keypoints, (k,), with information and variance.

        Both are for a noise of one in the rays: the information of the neighbors alone, the
        variance with the noise of the place as well, which all neighbors have in common.
        """
        base, slope = self._rotate_rays(motions), motions[self.neighbor, :3, 3]
        # (base + rho slope)_xy = observed (base + rho slope)_z
        a = slope[:, :2] - self.observed * slope[:, 2:]
        b = self.observed * base[:, 2:] - base[:, :2]
        depth = np.maximum(base[:, 2] + rho[self.keypoint] * slope[:, 2], 0.05)
        weight, k = use / depth**2, len(rho)
        information = np.bincount(self.keypoint, weight * (a * a).sum(axis=1), k)
        rho = np.bincount(self.keypoint, weight * (a * b).sum(axis=1), k)
        precision = np.maximum(information, 1e-12)
        common = [np.bincount(self.keypoint, weight * column, k) for column in a.T]
        variance = 1 / precision + np.sum(np.square(common), axis=0) / precision**2
        return np.maximum(rho / precision, MIN_INVERSE_DEPTH), information, variance

    def residuals(self, motions: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far observations are off, (m, 2), and whether they are ahead, (m,)."""
        direction = (
            self._rotate_rays(motions) + rho[self.keypoint, None] * motions[self.neighbor, :3, 3]
        )
        ahead = direction[:, 2] > 1e-6
        depth = np.where(ahead, direction[:, 2], 1)[:, None]
        return direction[:, :2] / depth - self.observed, ahead

    def select(self, use: np.ndarray) -> 'Observations':
        """Return a part of the observations, (m,) bool."""
        return Observations(*(array[use] for array in vars(self).values()))

    def refine(
        self, motions: np.ndarray, rho: np.ndarray, prior: np.ndarray, information: np.ndarray,
        focal: float,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """
        Return motions (n, 4, 4) and inverse depths (k,) after a step of Gauss and Newton.

        Observations have Cauchy's weights. The inverse depths are eliminated (Schur complement).

        :param prior: the motions by odometry, shape (n, 4, 4), and ``information`` of them.
        """
        count, keypoints = len(motions), len(rho)
        directions = self._rotate_rays(motions)
        slope = motions[self.neighbor, :3, 3]
        x, y, z = (directions + rho[self.keypoint, None] * slope).T
        z = np.maximum(z, 1e-6)
        off = focal * (np.stack([x / z, y / z], axis=1) - self.observed)
        zero = np.zeros_like(z)
        projection = np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]])
        projection = focal * projection.transpose(2, 0, 1)
        by_motion = np.concatenate(
            [projection * rho[self.keypoint, None, None], -projection @ cross(directions)],
            axis=2,
        )
        by_depth = np.einsum('mij,mj->mi', projection, slope)
        weight = 1 / (1 + (off**2).sum(axis=1))
        hessian = np.bincount(self.keypoint, weight * (by_depth**2).sum(axis=1), keypoints) + 1e-9
        pull = np.bincount(self.keypoint, weight * (by_depth * off).sum(axis=1), keypoints)
        shared = np.zeros((count, keypoints, 6))
        both = weight[:, None] * np.einsum('mij,mi->mj', by_motion, by_depth)
        np.add.at(shared, (self.neighbor, self.keypoint), both)
        coupling = shared.transpose(0, 2, 1).reshape(6 * count, keypoints)
        rotations = motions[:, :3, :3] @ prior[:, :3, :3].transpose(0, 2, 1)
        turns = [cv2.Rodrigues(rotation)[0].ravel() for rotation in rotations]
        since = np.column_stack([motions[:, :3, 3] - prior[:, :3, 3], turns])  # (n, 6)
        normal, right = information.copy(), information @ since.ravel()
        for number in range(count):
            is_own, part = self.neighbor == number, slice(6 * number, 6 * number + 6)
            rows, weights = by_motion[is_own].reshape(-1, 6), np.repeat(weight[is_own], 2)
            normal[part, part] += rows.T @ (weights[:, None] * rows)
            right[part] += rows.T @ (weights * off[is_own].ravel())
        step = -np.linalg.solve(
            normal - (coupling / hessian) @ coupling.T, right - coupling @ (pull / hessian)
        )
        deeper = rho - (pull + coupling.T @ step) / hessian
        result = motions.copy()
        for motion, change in zip(result, step.reshape(-1, 6), strict=True):
            motion[:3, 3] += change[:3]
            motion[:3, :3] = cv2.Rodrigues(change[3:])[0] @ motion[:3, :3]
        return result, np.maximum(deeper, MIN_INVERSE_DEPTH)


def odometry_information(motions: np.ndarray, before: int) -> np.ndarray:
    """
    Return the information of motions by odometry: the errors of its steps are independent.

    :param motions: from the place to its neighbors, in the order of the drive, shape (n, 4, 4).
    :param before: the number of neighbors before the place.
    :returns: of translations and rotations, in the axes of the neighbors, shape (6n, 6n).
    """
    covariance = np.zeros((len(motions), 6, len(motions), 6))
    for side in (range(before - 1, -1, -1), range(before, len(motions))):
        last = np.eye(4)
        for position, number in enumerate(side):
            motion = motions[number]
            step = motion @ inverse(last)
            length = max(float(np.linalg.norm(step[:3, 3])), MIN_LENGTH)
            variances = [(SHIFT[0] + SHIFT[1] * length) ** 2] * 3 + [TURN**2 * length] * 3
            farther = list(side)[position:]
            effect = np.zeros((len(farther), 6, 6))
            # a turn of the step moves all behind it, about its start
            effect[:, :3, :3] = effect[:, 3:, 3:] = motions[farther, :3, :3] @ motion[:3, :3].T
            arm = cross((step[:3, :3] @ last[:3, 3])[None])[0]
            effect[:, :3, 3:] = -effect[:, :3, :3] @ arm
            rows = np.ix_(farther, range(6), farther, range(6))
            covariance[rows] += np.einsum('aij,j,bkj->aibk', effect, variances, effect)
            last = motion
    size = 6 * len(motions)
    return np.asarray(np.linalg.inv(covariance.reshape(size, size)))
