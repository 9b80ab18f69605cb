# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Few loops, before there are six clusters: a likelihood ratio weighs them and the odometry."""

import numpy as np
import pytest
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph import Closure, PoseGraph
from stavpr_slam.pose_graph.acceptance import LEAST_CLUSTERS, SCALES
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.simulated_odometry import drifted
from test_pose_graph import circle, error, LAP, SECOND, solve

WIDE = np.diag([0.5, 1.25, 1.25, 0.05, 0.05, 0.05]) ** 2
PRECISE, BENT = 1.0, 1.06  # factors on the turns of the odometry: 360 or 382 degrees a lap


def arc(turn: float) -> np.ndarray:
    """Return planar poses each .4 m, 1.6 laps of 40 m if the factor on turns is 1."""
    heading = np.arange(LAP + 60) * turn * 2 * np.pi / LAP
    middle = (heading[1:] + heading[:-1]) / 2
    steps = 0.4 * np.column_stack([np.cos(middle), np.sin(middle)])
    return np.column_stack([np.pad(np.cumsum(steps, axis=0), ((1, 0), (0, 0))), heading])


def short_loop(draw: int, turn: float) -> tuple[np.ndarray, np.ndarray, list[Closure]]:
    """Return the truth, an odometry that turns too far, and closures off by a third of a meter."""
    truth, noticed = arc(1.0), np.ones(LAP + 60, bool)
    dice = np.random.default_rng(draw)
    odometry = planar_poses(drifted(arc(turn), noticed, dice, 0.02))
    T, closures = matrices(planar_poses(truth)), []
    for q in range(LAP, len(truth)):
        Z = inverse(T[q - LAP]) @ T[q]
        Z[:2, 3] += dice.normal(size=2) * 0.3
        stamps = (q + 1) * SECOND, (q - LAP + 1) * SECOND
        closures.append(Closure(*stamps, to_poses(Z), WIDE, q % 10 == 0))
    return truth, odometry, closures


@pytest.mark.parametrize('draw', range(3))
def test_optimize_loops_that_agree_with_odometry_move_nothing(draw):
    truth, odometry, closures = short_loop(draw, PRECISE)
    found, graph = solve(truth, closures, odometry)
    assert graph.accepted > 0.9 * len(closures)
    assert graph._acceptance.is_precise
    np.testing.assert_allclose(found[:, :3], odometry[:, :3], atol=1e-6)


@pytest.mark.parametrize('draw', range(3))
def test_optimize_loops_that_contradict_odometry_move_the_solution(draw):
    truth, odometry, closures = short_loop(draw, BENT)
    found, graph = solve(truth, closures, odometry)
    assert graph.accepted > 0.9 * len(closures)
    assert graph._acceptance.solution_scale > SCALES[0]
    assert error(found, truth) < 0.5 * error(odometry, truth)


@pytest.mark.parametrize(('off', 'moves'), [(0.0, False), (0.4, False), (6.0, True)])
def test_loop_scale_of_one_loop_is_least_unless_excluded(off, moves):
    """One closure of .5 m: a loop of 80 m that stays open by less is no evidence."""
    graph = PoseGraph()
    poses = planar_poses(circle(1)[:, :3] * [0.4, 0.4, 1])
    for i, pose in enumerate(poses):
        graph.add_odometry((i + 1) * SECOND, pose)
    Z = inverse(matrices(poses[0])) @ matrices(poses[-1])
    Z[0, 3] += off
    covariance = np.diag([0.5, 0.5, 0.5, 0.02, 0.02, 0.02]) ** 2
    graph.add_closure(Closure(LAP * SECOND, SECOND, to_poses(Z), covariance))
    graph.update()
    edge = graph._acceptance.clusters[0].representative
    scale = Cycles(graph.chain, [edge]).loop_scale(SCALES)
    assert (scale > SCALES[0]) == moves


def test_rule_ends_where_there_are_clusters_enough():
    truth, drift = circle(), np.random.default_rng(3)
    odometry = planar_poses(drifted(truth, np.ones(len(truth), bool), drift, 1.0))
    T, graph = matrices(planar_poses(truth)), PoseGraph()
    for i, pose in enumerate(odometry):
        graph.add_odometry((i + 1) * SECOND, pose)
    for q in range(LAP, 2 * LAP):
        Z = to_poses(inverse(T[q - LAP]) @ T[q])
        graph.add_closure(Closure((q + 1) * SECOND, (q - LAP + 1) * SECOND, Z, WIDE))
    graph.update()
    assert len(graph._acceptance.clusters) >= LEAST_CLUSTERS
    assert graph._acceptance.solution_scale == graph.scale
