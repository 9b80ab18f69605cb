# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Breaks of the odometry that closures prove: where they are, and when they end."""

import tracemalloc

import numpy as np
import pytest
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_slam.pose_graph import breaks, PoseGraph
from stavpr_slam.pose_graph.closures import BETWEEN_NODES
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.transforms import planar_poses
from test_pose_graph import circle, closure, error, LAP, odometry_of, SECOND


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
            PoseGraph, '_more', lambda _, before, after: sum(after.accepted) - sum(before.accepted)
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
    found = np.array([graph.at((i + 1) * SECOND) for i in range(len(truth))])
    assert any(splits) == counted
    assert graph.chain.sessions == 1
    assert error(found, truth) < 1.5


def test_update_carried_robot_that_is_recognized_without_a_gap():
    truth = np.concatenate([circle(2), circle(2)[30:140]])
    odometry = odometry_of(truth, np.arange(len(truth)) != 2 * LAP)
    graph, splits = PoseGraph(), []
    for i, pose in enumerate(odometry):
        graph.add_odometry((i + 1) * SECOND, pose)
        if i >= LAP:
            graph.add_closure(closure(truth, i, i - LAP if i < 2 * LAP else i - 2 * LAP + 30))
        if i % 20 == 0:
            graph.update()
            splits.append(graph.splits)
    found = to_poses(graph.update(final=True))
    assert error(found, truth[np.arange(len(truth)) != 2 * LAP]) < 1.5
    assert splits[-3] == 1  # within 70 images


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
    nodes = breaks.find(chain_of(poses), matrices(poses), query < 200, closures)
    np.testing.assert_allclose(nodes, [270, 200], atol=70)
    assert abs(nodes[1] - 200) <= 1


def test_break_is_found_among_4000_rejected_closures_in_little_memory():
    """From node 200 on, all closures move the robot by 30 m to the left."""
    query = np.sort(np.random.default_rng(0).integers(20, 400, 8000))
    poses, closures = shifted(query, 30.0 * (query >= 200))
    tracemalloc.start()
    nodes = breaks.find(chain_of(poses), matrices(poses), query < 200, closures)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(nodes) == 1
    assert abs(nodes[0] - 200) <= 1
    assert peak < 200e6
