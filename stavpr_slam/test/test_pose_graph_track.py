# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The odometry between keyframes: in paths and files it moves with its keyframe."""

import numpy as np
import pytest
from stavpr_slam.pose_graph import ChainSettings, GraphSettings, OdometryNoise, PoseGraph
from stavpr_slam.pose_graph.files import save_graph
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.track import MOST, OdometryTrack
from stavpr_slam.pose_graph.transforms import planar_poses
from test_pose_graph import circle, closure, error, LAP, odometry_of, SECOND

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
    found = np.array([graph.at(stamp) for stamp in stamps.tolist()])
    exact = np.array(
        [graph.at(stamp, pose) for stamp, pose in zip(stamps.tolist(), odometry, strict=True)]
    )
    assert np.linalg.norm(found[:, :3] - exact[:, :3], axis=1).max() < 0.06


def test_saved_trajectory_has_the_odometry_between_keyframes(solved, tmp_path):
    graph, stamps, odometry, truth = solved
    assert save_graph(graph, str(tmp_path / 'drive.tum')) < len(stamps) / 15
    rows = np.loadtxt(tmp_path / 'drive.tum')
    seconds = stamps / SECOND
    found = np.column_stack([np.interp(seconds, rows[:, 0], rows[:, i]) for i in (1, 2)])
    exact = [graph.at(t, pose) for t, pose in zip(stamps.tolist(), odometry, strict=True)]
    assert np.linalg.norm(found - np.array(exact)[:, :2], axis=1).max() < 0.1
    assert error(found, truth) < 1
    assert [len(each) for each in graph.chain.trajectory(graph.solved)] == 3 * [len(rows)]


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
    stamps, odometry, found = chain.trajectory(moved)
    np.testing.assert_array_equal(found[:, 1, 3], np.where(stamps < 15 * SECOND, 0.0, 7.0))
    np.testing.assert_allclose(found[:, 0, 3], odometry[:, 0, 3])
    for stamp in (14, 15, 16):
        assert chain.find(stamp * SECOND)[0] == (3 if stamp < 15 else 4)
