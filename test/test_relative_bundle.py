# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle adjustment of a place and its neighbors, and the matches that it is of."""

from itertools import pairwise
import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.method.verification import mutual_matches
from stavpr_ros.relative_pose.bundle import odometry_information, SHIFT, TURN
from stavpr_ros.relative_pose.landmarks import triangulate
from test_pnp import motions, points_ahead, pose, views_of


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
