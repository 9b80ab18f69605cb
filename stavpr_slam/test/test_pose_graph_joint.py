# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges that agree with each other one, and contradict all others together."""

import gtsam
import numpy as np
import pytest
from stavpr_ros.mapping.transforms import inverse, to_poses
from stavpr_slam.pose_graph import Closure, joint, optimize, PoseGraph
from stavpr_slam.pose_graph.cycles import Cycles, LIMIT
from stavpr_slam.pose_graph.joint import NodeErrors, predicted, refuted
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.transforms import adjoints
from test_pose_graph import circle, closure, error, odometry_of, SECOND
from test_pose_graph import LAP as IMAGES
from test_pose_graph_cycles import drive, LAP, laps, measured, PLANE
from test_pose_graph_runs import step_covariance

NOISE = OdometryNoise(0.05, 0.02, 0.0004)


@pytest.fixture(scope='module')
def graph():
    """Return the truth, a drive of three laps, and right edges of both later laps."""
    truth, dice = laps(3 * LAP), np.random.default_rng(0)
    chain = drive(truth, dice, 1.0, PLANE, NOISE)
    queries = [LAP + 40, LAP + 50, LAP + 60, *range(2 * LAP + 20, 2 * LAP + 60, 10)]
    right = [measured(truth, chain, q, q % LAP, dice, None, PLANE) for q in queries]
    return truth, chain, right


def refuted_of(graph, edges, weights=None):
    """Linearize at the truth: earlier closures have corrected the odometry."""
    truth, chain, *_ = graph
    nodes = NodeErrors(chain, truth, 1.0, {0})
    weights = np.full(len(edges), 5.0) if weights is None else np.array(weights)
    return sorted(refuted(nodes, edges, weights))


def test_refuted_right_edges_are_none(graph):
    assert refuted_of(graph, graph[2]) == []


def test_refuted_edge_that_agrees_with_each_other_one(graph):
    """By a third edge, the place is near one of lap 1, and so is the query."""
    (truth, chain, right), dice = graph, np.random.default_rng(1)
    wrong = measured(truth, chain, 2 * LAP + 60, 60, dice, LAP + 75, PLANE)
    assert Cycles(chain, [wrong, *right]).deviations(0, 1.0).max() < LIMIT
    assert refuted_of(graph, [*right, wrong]) == [len(right)]


def test_refuted_light_wrong_edges_that_support_each_other(graph):
    (truth, chain, right), dice = graph, np.random.default_rng(1)
    ends = [(2 * LAP + 60, LAP + 75), (2 * LAP + 63, LAP + 78)]
    wrong = [measured(truth, chain, q, q % LAP, dice, p, PLANE) for q, p in ends]
    assert Cycles(chain, wrong).deviations(0, 1.0)[1] < LIMIT
    weights = [5.0] * len(right) + [3.0] * 2
    assert refuted_of(graph, [*right, *wrong], weights) == [len(right), len(right) + 1]


@pytest.mark.parametrize('weights', [[20.0, 3.0], [3.0, 20.0]])
def test_refuted_is_the_lighter_of_two_that_contradict(graph, weights):
    (truth, chain, _), dice = graph, np.random.default_rng(1)
    edges = [
        measured(truth, chain, 2 * LAP + 30, 30, dice, None, PLANE),
        measured(truth, chain, 2 * LAP + 35, 35, dice, 39, PLANE),
    ]
    assert refuted_of(graph, edges, weights) == [int(np.argmin(weights))]


def deviation_by_gtsam(chain, edges, left_out):
    """Return the squared deviation of an edge from the solution without it, and that."""
    factors, values, gaussian = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.noiseModel
    T = chain.transforms
    tight = gaussian.Isotropic.Sigma(6, 1e-5)
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(T[0]), tight))
    for k in range(len(T)):
        values.insert(k, gtsam.Pose3(T[k]))
        if k:
            step = inverse(T[k - 1]) @ T[k]
            model = gaussian.Gaussian.Covariance(step_covariance(step, NOISE))
            factors.add(gtsam.BetweenFactorPose3(k - 1, k, gtsam.Pose3(step), model))
    for i, edge in enumerate(edges):
        model = gaussian.Gaussian.Covariance(edge.covariance)
        factor = gtsam.BetweenFactorPose3(
            edge.place, edge.query, gtsam.Pose3(edge.transform), model
        )
        if i == left_out:
            open_edge = factor
        else:
            factors.add(factor)
    solved = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    own = edges[left_out]
    joined = gtsam.Marginals(factors, solved).jointMarginalCovariance([own.place, own.query])
    A, off = open_edge.linearize(solved).jacobian()  # whitened by the covariance of the edge
    keys = list(open_edge.keys())
    ends = np.block([[joined.at(a, b) for b in keys] for a in keys])
    squared = off @ np.linalg.solve(np.eye(6) + A @ ends @ A.T, off)
    return squared, np.array([solved.atPose3(k).matrix() for k in range(len(T))])


@pytest.mark.parametrize('number', [1, 7])
def test_deviation_by_all_others_is_that_of_a_solution_without_the_edge(
    graph, number, monkeypatch
):
    """Edge 7 is wrong: the others refute it just from this deviation."""
    truth, dice = graph[0], np.random.default_rng(1)
    quiet = OdometryNoise(0.05, 0.004, 0.0)  # GTSAM's odometry has no bias
    monkeypatch.setattr('test_pose_graph_joint.NOISE', quiet)
    chain = drive(truth, dice, 1.0, PLANE, quiet)
    queries = [LAP + 40, LAP + 50, LAP + 60, *range(2 * LAP + 20, 2 * LAP + 60, 10)]
    edges = [measured(truth, chain, q, q % LAP, dice, None, PLANE) for q in queries]
    edges.append(measured(truth, chain, 2 * LAP + 60, 60, dice, 63, PLANE))
    expected, solved = deviation_by_gtsam(chain, edges, number)
    others = edges[:number] + edges[number + 1 :]
    nodes = NodeErrors(chain, solved, 1.0, {0})
    squared, _ = predicted(nodes, [edges[number]], others)
    assert squared[0] == pytest.approx(expected, rel=0.01)
    if number == 7:
        for factor, found in ((0.95, [7]), (1.05, [])):
            monkeypatch.setattr(joint, 'REFUTED', factor * expected)
            assert refuted(nodes, edges, np.full(len(edges), 5.0)) == found


def test_covariance_of_nodes_is_the_sum_over_their_steps():
    """Also where the map is not the odometry, far from its origin, and in other sessions."""
    truth = laps(60)
    truth[:, :2, 3] += 5e5
    chain = drive(truth, np.random.default_rng(0), 1.0, PLANE, NOISE)
    chain.split(40, int(chain.stamps[40]))
    solved = truth.copy()
    solved[40:, 0, 3] += 7.0
    nodes = NodeErrors(chain, solved, 0.5, {0})
    assert nodes.loose[:, 0].tolist() == [0.0] * 40 + [1.0] * 20
    found = nodes.covariance(np.arange(60), np.arange(60))
    X = solved.copy()
    X[:, :3, 3] -= X[:, :3, 3].mean(axis=0)
    steps, bent = np.zeros((60, 6, 6)), np.zeros((60, 6, 3))
    for k in range(1, 60):
        if k != 40:
            change = adjoints(X[k : k + 1])[0]
            step = inverse(chain.transforms[k - 1]) @ chain.transforms[k]
            steps[k] = change @ step_covariance(step, NOISE) @ change.T / 4
            half = np.eye(4)
            half[:3, 3] = -(step[:3, :3].T @ step[:3, 3]) / 2
            length = np.linalg.norm(step[:3, 3])
            bent[k] = NOISE.bias / 2 * length * (change @ adjoints(half[None])[0])[:, :3]

    def expected(a, b, first):
        turned = [bent[(0 if n < 40 else 41) : n + 1].sum(axis=0) for n in (a, b)]
        spread = np.zeros((6, 6)) if first is None else steps[first : min(a, b) + 1].sum(axis=0)
        return spread + turned[0] @ turned[1].T

    for a, b, first in ((10, 30, 1), (30, 30, 1), (45, 59, 41), (20, 50, None)):
        whole = expected(a, b, first)
        assert found[a, b] == pytest.approx(whole, rel=1e-3, abs=1e-6), (a, b)
        assert found[b, a] == pytest.approx(whole.T, rel=1e-3, abs=1e-6)


def two_sessions():
    """Return stamps, odometry, and closures within each of two sessions of two laps."""
    truth, half = circle(4), 2 * IMAGES
    stamps = (np.arange(len(truth)) + 1) * SECOND
    stamps[half:] += 1000 * SECOND
    queries = [*range(IMAGES, half), *range(half + IMAGES, 2 * half)]
    closures = [closure(truth, q, q - IMAGES, None, stamps) for q in queries]
    return stamps, odometry_of(truth), closures


def test_optimize_sessions_that_nothing_joins_are_compared_each():
    _, graph = optimize(*two_sessions())
    assert graph.chain.sessions == 2
    assert graph.accepted >= 198


def test_update_two_robots_with_closures_between_end_in_one_frame():
    """Robot b begins half a lap ahead, at the same time, in an odometry of its own."""
    truth, half = circle(2), IMAGES // 2
    graph, paths = PoseGraph(), {'a': truth[: 3 * half], 'b': truth[half:]}
    for i in range(3 * half):
        for robot, path in paths.items():
            graph.add_odometry((i + 1) * SECOND, odometry_of(path)[i], robot)
    for q in range(half, 2 * IMAGES):  # b, where a was a lap ago or will be
        place = q % IMAGES
        made = closure(truth, q, place)
        ends = (q - half + 1) * SECOND, (place + 1) * SECOND
        graph.add_closure(
            Closure(*ends, made.pose, made.covariance, q % 3 == 0, query_robot='b',
                    place_robot='a')
        )  # fmt: skip
    graph.update()
    graph.update(final=True)
    stamps = [(i + 1) * SECOND for i in range(3 * half)]
    found = np.array([graph.at(t, None, robot) for robot in paths for t in stamps])
    assert graph.accepted > 0.9 * 3 * half
    assert error(found, np.concatenate(list(paths.values()))) < 1.5
    for robot in paths:
        node = graph.chain.newest(robot)
        T = graph.solved[node] @ inverse(graph.chain.transforms[node])
        np.testing.assert_allclose(graph.map_to_odom(robot), to_poses(T), atol=1e-9)
