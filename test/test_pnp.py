# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of cameras from keypoints: PnP of one place, and bundles of several."""

from dataclasses import replace
from itertools import pairwise
import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.camera import Camera, FORWARD
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.method.verification import mutual_matches
from stavpr_ros.relative_pose.bundle import odometry_information, SHIFT, TURN
from stavpr_ros.relative_pose.landmarks import Landmarks, triangulate, View
from stavpr_ros.relative_pose.pnp import MIN_INLIERS, solve_pnp

SIZE = 320, 240
CAMERA = Camera(*SIZE, (200.0, 200.0), (159.5, 119.5))


def pose(x, y=0.0, yaw=0.0):
    return np.array([x, y, 0, 0, 0, math.sin(yaw / 2), math.cos(yaw / 2)])


def points_ahead(count, seed=0):
    """Return points on both sides of the way ahead, in the base's frame, (count, 3)."""
    rng = np.random.default_rng(seed)
    side = np.where(rng.random(count) < 0.5, -1, 1)
    return np.column_stack(
        [rng.uniform(4, 45, count), side * rng.uniform(1, 9, count), rng.uniform(-1, 5, count)]
    )


def views_of(points, poses, noise=0.0, seed=1):
    """Return ideal views of points with a descriptor each, (m, 3), from poses of the base."""
    rng = np.random.default_rng(seed)
    descriptors = rng.uniform(0, 100, (len(points), 128)).astype(np.float32)
    views = []
    for each in poses:
        seen = in_camera(points, each, CAMERA)
        known = seen[:, 2] > 0.5
        rays = seen[known, :2] / seen[known, 2:]
        views.append(
            View(rays + noise / 200 * rng.normal(size=rays.shape), descriptors[known], 200.0)
        )
    return views


def in_camera(points, base, camera):
    to = inverse(matrices(base) @ matrices(np.array(camera.mount)))
    return points @ to[:3, :3].T + to[:3, 3]


def motions(poses, center):
    mount = matrices(np.array(FORWARD))
    own = matrices(center) @ mount
    return [inverse(matrices(each) @ mount) @ own for each in poses]


def test_triangulate_of_exact_views_returns_the_points():
    poses = [pose(x) for x in (-2, -1, 0, 1, 2)]
    points = points_ahead(200)
    views = views_of(points, poses)
    around = [0, 1, 3, 4]
    neighbors = list(zip([views[i] for i in around], motions([poses[i] for i in around], poses[2]),
                         strict=True))  # fmt: skip
    found = triangulate(views[2], neighbors, 2)
    assert len(found.points) > 140  # others are far ahead, without parallax
    true = in_camera(points, poses[2], CAMERA)
    away = np.linalg.norm(found.points[:, None] - true, axis=2).min(axis=1)
    assert away.max() < 1e-3


@pytest.mark.parametrize('seed', range(2))
def test_deviations_of_landmarks_fit_the_errors_of_their_depths(seed):
    """Of views with a noise of half a pixel, errors of inverse depths are as large as stated."""
    points, noise = points_ahead(200, seed), 0.5
    poses = [pose(x) for x in (0, -3, -2, -1, 1, 2, 3)]
    views = views_of(points, poses, noise)
    neighbors = list(zip(views[1:], motions(poses[1:], poses[0]), strict=True))
    found = triangulate(views[0], neighbors, 3)
    exact = views_of(points, poses)[0]
    rows = [np.flatnonzero((exact.descriptors == own).all(1))[0] for own in found.descriptors]
    true = in_camera(points, poses[0], CAMERA)
    depths = true[true[:, 2] > 0.5][rows, 2]
    errors = (found.points[:, 2] / depths - 1) / found.deviations / noise
    assert len(errors) > 100
    assert 0.5 < np.median(np.abs(errors)) / 0.6745 < 1.5


def test_pnp_with_noisy_depths_is_unbiased_and_its_covariance_fits_the_errors():
    """Errors of the depths must not draw the query to the place: 8 cm of 1 m if left out."""
    dice, focal, noise, sigma = np.random.default_rng(0), 200.0, 0.5, 0.01
    errors, squares = [], []
    for _ in range(60):
        rays = np.column_stack([dice.uniform(-0.6, 0.6, (120, 2)), np.ones(120)])
        rho = 1 / dice.uniform(12, 40, 120)
        moved = rays / rho[:, None] - (1, 0, 0)
        seen = moved[:, :2] / moved[:, 2:] + noise / focal * dice.normal(size=(120, 2))
        measured = np.maximum(rho + noise * sigma * dice.normal(size=120), 0.002)
        points, descriptors = rays / measured[:, None], dice.random((120, 128), np.float32)
        own = Landmarks(points, points, sigma / measured, descriptors, np.empty((0, 4, 4)))
        found = solve_pnp(View(seen, descriptors, focal), [own])
        turn = Rotation.from_matrix(found.matrix[:3, :3]).as_rotvec()
        errors.append(np.concatenate([found.matrix[:3, 3] - (1, 0, 0), turn]))
        squares.append(errors[-1] @ np.linalg.solve(noise**2 * found.covariance, errors[-1]))
    assert np.abs(np.mean(errors, axis=0)[:3]).max() < 0.02
    assert 4 < np.mean(squares) < 8


def test_pnp_counts_each_keypoint_once_and_rejects_other_points():
    points = points_ahead(60)
    center, aside = pose(0), [pose(-2), pose(2)]
    views = views_of(points, [center, *aside])
    around = list(zip(views[1:], motions(aside, center), strict=True))
    landmarks = triangulate(views[0], around, 1)
    query = views_of(points, [pose(0.5, 0.5)])[0]
    once, twice = solve_pnp(query, [landmarks]), solve_pnp(query, [landmarks, landmarks])
    assert once.inliers == twice.inliers > 30
    few = replace(landmarks, points=landmarks.points[:11], descriptors=landmarks.descriptors[:11])
    assert solve_pnp(query, [few, few]).matrix is None
    other = np.random.default_rng(3).permutation(landmarks.points)
    assert solve_pnp(query, [replace(landmarks, points=other)]).inliers < MIN_INLIERS


@pytest.mark.parametrize('seed', range(4))
def test_triangulate_corrects_the_steps_of_poor_odometry(seed):
    """From the side, places are off by less than a third of what the odometry is off."""
    rng = np.random.default_rng(seed)
    poses = [pose(2 * x) for x in range(-4, 5)]
    points = points_ahead(300, seed)
    views = views_of(points, poses, noise=0.3)
    measured = [np.eye(4)]
    for before, after in pairwise(map(matrices, poses)):
        noise = matrices(pose(*rng.normal(0, (0.04, 0.005, 0.012))))
        measured.append(measured[-1] @ inverse(before) @ after @ noise)
    wrong = motions([to_poses(each) for each in measured], to_poses(measured[4]))
    true = motions(poses, poses[4])
    del views[4:5], wrong[4], true[4]
    place = views_of(points, poses[4:5], noise=0.3, seed=1)[0]
    landmarks = triangulate(place, list(zip(views, wrong, strict=True)), 4)

    def aside(found):  # only odometry knows the length of the way
        steps = np.array(found)[:, :3, 3]
        return np.abs(steps / np.linalg.norm(steps, axis=1)[:, None])[:, 0]

    def turned(found):
        pairs = zip(found, true, strict=True)
        return [
            Rotation.from_matrix(each[:3, :3] @ own[:3, :3].T).magnitude() for each, own in pairs
        ]

    assert max(aside(landmarks.motions)) < 0.006
    assert np.mean(turned(landmarks.motions)) < np.mean(turned(wrong)) / 3


def test_odometry_information_of_two_steps_is_that_of_their_composition():
    around = np.array(motions([pose(-1), pose(2, 0.5, 0.3), pose(4, 2, 0.8)], pose(0)))
    covariance = np.linalg.inv(odometry_information(around, 1)).reshape(3, 6, 3, 6)
    rng, samples = np.random.default_rng(0), []
    for _ in range(5000):
        last = own = np.eye(4)
        row = []
        for motion in around[1:]:
            step = motion @ inverse(last)
            length = np.linalg.norm(step[:3, 3])
            step[:3, 3] += (SHIFT[0] + SHIFT[1] * length) * rng.normal(size=3)
            turn = TURN * math.sqrt(length) * rng.normal(size=3)
            step[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ step[:3, :3]
            own, last = step @ own, motion
            off = Rotation.from_matrix(own[:3, :3] @ motion[:3, :3].T).as_rotvec()
            row += [*(own[:3, 3] - motion[:3, 3]), *off]
        samples.append(row)
    expected = covariance[1:, :, 1:].reshape(12, 12)
    scale = np.sqrt(np.diag(expected))
    off = (np.cov(np.array(samples).T) - expected) / np.outer(scale, scale)
    assert np.abs(off).max() < 0.08
    assert not covariance[0, :, 1:].any()  # the other side of the place has other steps


@pytest.mark.parametrize('ratio', [0.6, 0.8, 0.95])
def test_mutual_matches_of_floats_agree_with_opencv(ratio):
    rng = np.random.default_rng(2)
    mine = rng.integers(0, 120, (90, 128)).astype(np.float32)
    theirs = rng.permutation(mine)[:60] + rng.integers(-25, 26, (60, 128)).astype(np.float32)
    theirs[:10] = theirs[10:20] + 1  # not clear
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    ahead, back = matcher.knnMatch(mine, theirs, 2), matcher.knnMatch(theirs, mine, 1)
    expected = [
        (one.queryIdx, one.trainIdx)
        for one, two in ahead
        if one.distance < ratio * two.distance and back[one.trainIdx][0].trainIdx == one.queryIdx
    ]
    found = mutual_matches(mine, theirs, ratio)
    assert list(zip(*(each.tolist() for each in found), strict=True)) == expected
    assert 20 < len(expected) < 60
