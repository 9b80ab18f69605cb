# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Breaks of the odometry that closures prove: where they are, and when they end."""

import numpy as np
from stavpr_slam.pose_graph import PoseGraph
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.transforms import planar_poses
from test_pose_graph import circle, closure, error, LAP, odometry_of, SECOND


def chain_of(poses: np.ndarray) -> KeyframeChain:
    chain = KeyframeChain(ChainSettings(), OdometryNoise())
    for i, pose in enumerate(poses):
        chain.add((i + 1) * SECOND, pose)
    return chain


def test_merge_session_restores_the_chain():
    chain = chain_of(planar_poses(circle(1)))
    for node in (20, 40):
        chain.split(node)
    assert chain.splits == [20, 40]
    assert np.bincount(chain.session).tolist() == [20, 20, 60]
    chain.merge_session(20)
    assert np.bincount(chain.session).tolist() == [40, 60]
    assert (chain.splits, chain.sessions) == ([40], 2)
    assert chain.previous[[20, 40]].tolist() == [19, -1]
    assert set(chain.recording.tolist()) == {0}


def test_update_false_break_ends_when_closures_are_against_it():
    """Forty closures in a row are of one wrong place: as if the robot was carried."""
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
    assert splits[-1] == 0
    assert graph.chain.sessions == 1
    assert error(found, truth) < 1.5
