# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs of keyframes as one factor: covariances, and the same solution as with all keyframes."""

import numpy as np
import pytest
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph import optimize, runs
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.transforms import adjoints, planar_poses
from test_pose_graph import circle, closure, graph_of, LAP, odometry_of, SECOND

NOISE = OdometryNoise(0.05, 0.012)


@pytest.fixture(scope='module')
def chain():
    """Return a chain far from the origin of its odometry, in two sessions."""
    chain = KeyframeChain(ChainSettings(), NOISE)
    poses = planar_poses(circle(1)[:40])
    poses[:, :2] += 5e5
    for i, pose in enumerate(poses):
        chain.add((i + 1) * SECOND, pose)
    chain.split(25)
    return chain


def step_covariance(step: np.ndarray, noise: OdometryNoise) -> np.ndarray:
    """Return that of errors in the middle of a step, in the axes of its end, rotation first."""
    length = np.linalg.norm(step[:3, 3])
    middle = np.eye(4)
    middle[:3, 3] = -(step[:3, :3].T @ step[:3, 3]) / 2
    own = np.diag(np.repeat([noise.rotation**2 * length, noise.translation**2 * length], 3))
    change = adjoints(middle[None])[0]
    covariance: np.ndarray = change @ own @ change.T
    return covariance


@pytest.mark.parametrize('side', [1, -1])
def test_path_errors_are_sums_over_the_steps(chain, side):
    ends = np.array([10, 20])[::side]
    found = chain.path_errors(ends[:1], ends[1:])
    T, expected = chain.transforms, np.zeros((6, 6))
    for k in range(11, 21):
        change = adjoints((inverse(T[ends[0]]) @ T[k])[None])[0]
        step = inverse(T[k - 1]) @ T[k]
        expected += change @ step_covariance(step, NOISE) @ change.T
    assert found[0] == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_optimize_with_runs_agrees_with_all_keyframes(monkeypatch):
    truth = circle()
    closures = [closure(truth, q, q - LAP) for q in range(LAP, 2 * LAP)]
    stamps = (np.arange(len(truth)) + 1) * SECOND
    found, _ = optimize(stamps, odometry_of(truth), closures)
    monkeypatch.setattr(runs, 'LONGEST', 1)
    every, _ = optimize(stamps, odometry_of(truth), closures)
    assert np.linalg.norm(found[:, :3] - every[:, :3], axis=1).max() < 0.02


def test_update_splits_runs_where_edges_arrive():
    truth = circle(3)
    closures = [closure(truth, i, i - LAP, independent=i % 7 == 0) for i in range(LAP, 3 * LAP)]
    graph = graph_of(odometry_of(truth, drift=0.3, seed=4), closures, every=9)
    graph.update()
    online = graph.solved.copy()
    final = graph.update(final=True)
    assert np.linalg.norm(online[:, :3, 3] - final[:, :3, 3], axis=1).max() < 0.1
