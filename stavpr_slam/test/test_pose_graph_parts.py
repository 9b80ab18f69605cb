# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts of the pose graph: runs of keyframes as one factor, breaks, and the track between."""

import tracemalloc
from unittest.mock import Mock

import numpy as np
import pytest
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph import (
    breaks,
    ChainSettings,
    GraphSettings,
    OdometryNoise,
    optimize,
    PoseGraph,
    tuning,
)
from stavpr_slam.pose_graph.closures import BETWEEN_NODES
from stavpr_slam.pose_graph.files import save_graph
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.track import MOST, OdometryTrack
from stavpr_slam.pose_graph.transforms import adjoints, planar_poses
from test_pose_graph import circle, closure, error, graph_of, LAP, odometry_of, SECOND

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
    """Return the covariance of errors in the middle of a step, in the axes of its end."""
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
    result = chain.path_errors(ends[:1], ends[1:])
    T, expected = chain.transforms, np.zeros((6, 6))
    for k in range(11, 21):
        change = adjoints((inverse(T[ends[0]]) @ T[k])[None])[0]
        step = inverse(T[k - 1]) @ T[k]
        expected += change @ step_covariance(step, NOISE) @ change.T
    assert result[0] == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_optimize_with_runs_agrees_with_all_keyframes(monkeypatch):
    truth = circle()
    closures = [closure(truth, q, q - LAP) for q in range(LAP, 2 * LAP)]
    stamps = (np.arange(len(truth)) + 1) * SECOND
    estimate, _ = optimize(stamps, odometry_of(truth), closures)
    monkeypatch.setattr(tuning, 'LONGEST', 1)
    every, _ = optimize(stamps, odometry_of(truth), closures)
    assert np.linalg.norm(estimate[:, :3] - every[:, :3], axis=1).max() < 0.02


def test_update_splits_runs_where_edges_arrive():
    truth = circle(3)
    closures = [closure(truth, i, i - LAP, independent=i % 7 == 0) for i in range(LAP, 3 * LAP)]
    graph = graph_of(odometry_of(truth, drift=0.3, seed=4), closures, every=9)
    graph.update()
    online = graph.solved.copy()
    final = graph.update(final=True)
    assert np.linalg.norm(online[:, :3, 3] - final[:, :3, 3], axis=1).max() < 0.1


def chain_of(poses: np.ndarray) -> KeyframeChain:
    chain = KeyframeChain(ChainSettings(), OdometryNoise())
    for i, pose in enumerate(poses):
        chain.add((i + 1) * SECOND, pose)
    return chain


@pytest.mark.parametrize('counted', [False, True])
def test_update_one_false_run_proves_no_break(monkeypatch, counted):
    """Forty closures in a row are of one wrong place: as if the robot was carried."""
    if counted:
        monkeypatch.setattr(
            PoseGraph, '_proves', lambda _, a, b, node: sum(b.accepted) - sum(a.accepted) > 23
        )
    truth = circle(3)
    graph, splits = PoseGraph(), []
    for i, pose in enumerate(odometry_of(truth)):
        graph.add_odometry((i + 1) * SECOND, pose)
        if i >= LAP:
            wrong = (i + 40) % LAP if 150 <= i < 190 else None
            graph.add_closure(closure(truth, i, i % LAP, wrong))
            if i % 5 == 0:
                graph.update()
                splits.append(graph.splits)
    graph.update(final=True)
    estimate = np.array([graph.at((i + 1) * SECOND) for i in range(len(truth))])
    assert any(splits) == counted
    assert graph.chain.sessions == 1
    assert error(estimate, truth) < 1.5


def test_update_carried_robot_that_is_recognized_without_a_gap():
    truth = np.concatenate([circle(2), circle(2)[30:140]])
    odometry = odometry_of(truth, np.arange(len(truth)) != 2 * LAP)
    graph, splits = PoseGraph(), []
    for i, pose in enumerate(odometry):
        graph.add_odometry((i + 1) * SECOND, pose)
        if i >= LAP:
            graph.add_closure(
                closure(truth, i, i - LAP if i < 2 * LAP else (i - 2 * LAP + 30) % LAP)
            )
        if i % 20 == 0:
            graph.update()
            splits.append(graph.splits)
    estimate = to_poses(graph.update(final=True))
    assert error(estimate, truth[np.arange(len(truth)) != 2 * LAP]) < 1.5
    assert splits[-1] == 1  # closures of two events


def shifted(query: np.ndarray, left: np.ndarray):
    """Return 400 poses on a line, and closures to its start that are moved to the left (m)."""
    poses = planar_poses(np.column_stack([np.arange(400.0), np.zeros((400, 2))]))
    closures = np.zeros(len(query), BETWEEN_NODES).view(np.recarray)
    closures.query, closures.place = query, np.arange(len(query)) % 20
    moves = np.column_stack([query - closures.place, left, np.zeros(len(query))])
    closures.transform, closures.covariance = matrices(planar_poses(moves)), np.eye(6) * 0.01
    return poses, closures


def test_break_is_found_behind_a_longer_run_of_false_closures():
    """From node 200 on the robot is 30 m to the left; a run of 80 closures is of another place."""
    query = np.arange(20, 400, 2).repeat(1 + (np.arange(20, 400, 2) >= 340) * 3)
    is_false = query >= 340
    poses, closures = shifted(query, 30.0 * (query >= 200) + 30.0 * is_false)
    assert is_false.sum() > (query >= 200).sum() - is_false.sum()
    trial = Mock(nodes=matrices(poses), inliers=query < 200)
    nodes = breaks.find(chain_of(poses), [trial], closures)
    np.testing.assert_allclose(nodes, [270, 200], atol=70)
    assert abs(nodes[1] - 200) <= 1


def test_break_is_found_among_4000_rejected_closures_in_little_memory():
    """From node 200 on, all closures move the robot by 30 m to the left."""
    query = np.sort(np.random.default_rng(0).integers(20, 400, 8000))
    poses, closures = shifted(query, 30.0 * (query >= 200))
    tracemalloc.start()
    trial = Mock(nodes=matrices(poses), inliers=query < 200)
    nodes = breaks.find(chain_of(poses), [trial], closures)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(nodes) == 1
    assert abs(nodes[0] - 200) <= 1
    assert peak < 200e6


RATE = 20  # poses of the odometry between two images of a circle


def fine(poses: np.ndarray) -> np.ndarray:
    """
    Return planar poses (n, 3) with others in between, (RATE * (n - 1) + 1, 3).

    Each step of 2 m begins with half of it, then the robot stands, then it drives the rest.
    """
    share = np.clip(np.arange(RATE) / RATE * 4, 0, 2) / 4
    share = np.maximum(share, np.arange(RATE) / RATE * 4 / 2 - 1)
    at = np.concatenate([np.add.outer(np.arange(len(poses) - 1), share).ravel(), [len(poses) - 1]])
    return np.column_stack([np.interp(at, np.arange(len(poses)), column) for column in poses.T])


@pytest.fixture(scope='module')
def solved() -> tuple[PoseGraph, np.ndarray, np.ndarray, np.ndarray]:
    """Return a graph with keyframes each 2 m, its stamps, odometry and truth, all images."""
    truth, coarse = circle(), odometry_of(circle())
    yaw = np.unwrap(2 * np.arctan2(coarse[:, 5], coarse[:, 6]))
    odometry = planar_poses(fine(np.column_stack([coarse[:, :2], yaw])))
    stamps = SECOND + np.arange(len(odometry), dtype=np.int64) * (SECOND // RATE)
    graph = PoseGraph(GraphSettings(ChainSettings(1.9, 1.0)))
    for stamp, pose in zip(stamps.tolist(), odometry, strict=True):
        graph.add_odometry(stamp, pose)
    for query in range(LAP, 2 * LAP):
        graph.add_closure(closure(truth, query, query - LAP))
    graph.update()
    graph.update(final=True)
    return graph, stamps, odometry, fine(truth)


def test_at_between_keyframes_is_where_the_odometry_has_it(solved):
    graph, stamps, odometry, _ = solved
    estimate = np.array([graph.at(stamp) for stamp in stamps.tolist()])
    exact = np.array(
        [graph.at(stamp, pose) for stamp, pose in zip(stamps.tolist(), odometry, strict=True)]
    )
    assert np.linalg.norm(estimate[:, :3] - exact[:, :3], axis=1).max() < 0.06


def test_saved_trajectory_has_the_odometry_between_keyframes(solved, tmp_path):
    graph, stamps, odometry, truth = solved
    assert save_graph(graph, str(tmp_path / 'drive.tum')) < len(stamps) / 15
    rows = np.loadtxt(tmp_path / 'drive.tum')
    seconds = stamps / SECOND
    result = np.column_stack([np.interp(seconds, rows[:, 0], rows[:, i]) for i in (1, 2)])
    exact = [graph.at(t, pose) for t, pose in zip(stamps.tolist(), odometry, strict=True)]
    assert np.linalg.norm(result - np.array(exact)[:, :2], axis=1).max() < 0.1
    assert error(result, truth) < 1
    assert [len(column) for column in graph.chain.trajectory(graph.solved)] == 3 * [len(rows)]


def test_track_behind_its_last_kept_pose_is_up_to_the_newest():
    track = OdometryTrack(2.0, 1.0)
    first, second, newest = planar_poses(np.array([[0, 0, 0], [2, 0, 0], [2.1, 0, 0.0]]))
    track.add(SECOND, first, True)
    track.add(2 * SECOND, second, True)
    track.add(4 * SECOND, newest, False)
    assert len(track.kept[0]) == 2
    assert track.at(3 * SECOND)[0] == pytest.approx(2.05)


def test_add_odometry_of_an_equal_stamp_is_ignored():
    chain = KeyframeChain(ChainSettings(), OdometryNoise())
    here, there = planar_poses(np.array([[0, 0, 0], [1.9, 0, 0.0]]))
    assert chain.add(SECOND, here)
    assert not chain.add(SECOND, there)
    assert len(chain) == 1


@pytest.mark.parametrize(('jitter', 'most'), [(0.0, 5), (0.05, MOST + 2)])
def test_add_odometry_of_high_rate_keeps_few_poses(jitter, most):
    chain, dice = KeyframeChain(ChainSettings(), OdometryNoise()), np.random.default_rng(0)
    rows = np.column_stack([np.arange(4000) / 200, *jitter * dice.normal(size=(2, 4000)) / 5])
    for i, pose in enumerate(planar_poses(rows)):
        chain.add((i + 1) * SECOND // 200, pose)
    stamps, _, _ = chain.trajectory(chain.transforms)
    assert 18 < len(chain) < len(stamps) < most * len(chain)


def test_trajectory_after_a_split_belongs_to_the_session_from_its_stamp():
    chain = KeyframeChain(ChainSettings(), OdometryNoise())
    for i, pose in enumerate(planar_poses(np.arange(30)[:, None] / 4 * [1, 0, 0])):
        chain.add((i + 1) * SECOND, pose)
    chain.split(4)  # at 15 s: its keyframe has stamp 17, the one before 13
    moved = chain.transforms.copy()
    moved[4:, 1, 3] = 7.0
    stamps, odometry, result = chain.trajectory(moved)
    np.testing.assert_array_equal(result[:, 1, 3], np.where(stamps < 15 * SECOND, 0.0, 7.0))
    np.testing.assert_allclose(result[:, 0, 3], odometry[:, 0, 3])
    for stamp in (14, 15, 16):
        assert chain.find(stamp * SECOND)[0] == (3 if stamp < 15 else 4)
