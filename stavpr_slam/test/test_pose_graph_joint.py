# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges that agree with each other one, and contradict all others together."""

from dataclasses import replace

import numpy as np
import pytest
from stavpr_slam.pose_graph import optimize
from stavpr_slam.pose_graph.consistency import LIMIT
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.false_places import FalsePlaces
from stavpr_slam.pose_graph.odometry import OdometryNoise
from stavpr_slam.pose_graph.refutation import Refutation
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.simulated_odometry import drifted
from test_pose_graph import circle, closure, error, solve
from test_pose_graph_cycles import drive, LAP, laps, measured, PLANE

NOISE = OdometryNoise(0.05, 0.02, 0.0004)


@pytest.fixture(scope='module')
def graph():
    """Return the truth, a drive of three laps, and right edges of both later laps."""
    truth, dice = laps(3 * LAP), np.random.default_rng(0)
    chain = drive(truth, dice, NOISE, PLANE)
    queries = [LAP + 40, LAP + 50, LAP + 60, *range(2 * LAP + 20, 2 * LAP + 60, 10)]
    right = [measured(truth, chain, q, q % LAP, dice, None, PLANE) for q in queries]
    return truth, chain, right, dice


def refuted_of(graph, wrong, weights=None):
    _, chain, right, _ = graph
    edges = [*right, *wrong]
    weights = weights or [5.0] * len(edges)
    pairs = dict(enumerate(zip(edges, weights, strict=True)))
    return sorted(Refutation(chain, NOISE, {0: -1}).refuted(chain.transforms, pairs))


def test_refuted_right_edges_are_none(graph):
    assert refuted_of(graph, []) == []


def test_refuted_edge_that_agrees_with_each_other_one(graph):
    """By a third edge, the place is near one of lap 1, and so is the query."""
    truth, chain, right, dice = graph
    wrong = measured(truth, chain, 2 * LAP + 60, 60, dice, LAP + 75, PLANE)
    cycles = Cycles(chain, [wrong, *right])
    assert cycles.deviations(0, NOISE).max() < LIMIT
    assert refuted_of(graph, [wrong]) == [len(right)]


def test_refuted_wrong_edges_that_support_each_other_leave_the_right_ones(graph):
    truth, chain, right, dice = graph
    ends = [(2 * LAP + 60, LAP + 75), (2 * LAP + 63, LAP + 78)]
    wrong = [measured(truth, chain, q, q % LAP, dice, p, PLANE) for q, p in ends]
    assert Cycles(chain, wrong).deviations(0, NOISE)[1] < LIMIT
    assert refuted_of(graph, wrong) == [len(right), len(right) + 1]


def test_refuted_is_the_lighter_of_two_that_contradict(graph):
    truth, chain, _, dice = graph
    edges = [
        measured(truth, chain, 2 * LAP + 30, 30, dice, None, PLANE),
        measured(truth, chain, 2 * LAP + 35, 35, dice, 39, PLANE),
    ]
    for weights in ([20.0, 3.0], [3.0, 20.0]):
        pairs = dict(enumerate(zip(edges, weights, strict=True)))
        found = Refutation(chain, NOISE, {0: -1}).refuted(chain.transforms, pairs)
        assert found == [int(np.argmin(weights))]


def test_refuted_of_edges_that_nothing_else_compares_are_none(graph):
    """One edge alone has no other that knows its ends."""
    truth, chain, _, dice = graph
    alone = {7: (measured(truth, chain, 2 * LAP + 30, 30, dice, 95, PLANE), 5.0)}
    quiet = OdometryNoise(1e3, 10.0, 0.0)
    assert Refutation(chain, quiet, {0: -1}).refuted(chain.transforms, alone) == []
    assert Refutation(chain, NOISE, {0: -1}).refuted(chain.transforms, {}) == []


def test_compared_edge_in_the_solution_is_as_far_as_one_left_out(graph):
    """The residuals of one solution are as good as a solution without each edge."""
    _, chain, right, _ = graph
    together, edges = Refutation(chain, NOISE, {0: -1}), dict(enumerate(right))
    _, squared = together.compared(chain.transforms, edges, {})
    for key, edge in edges.items():
        others = {k: each for k, each in edges.items() if k != key}
        _, expected = together.compared(chain.transforms, others, {key: edge})
        assert squared[key] == pytest.approx(expected[key], rel=0.1)


def ratio_of_drive(draw: int) -> float:
    """Return the error after / before of four laps, half of whose closures are false in runs."""
    truth, lap = circle(4), 100
    false, known, closures = FalsePlaces(0.5, True, draw), set(), []
    for query in range(lap, 4 * lap):
        known |= {query, query % lap}
        closures.append(closure(truth, query, query % lap, false.place(query % lap, known)))
    dice = np.random.default_rng(draw)
    odometry = planar_poses(drifted(truth, np.ones(len(truth), bool), dice, 1.0))
    found, _ = solve(truth, closures, odometry)
    return error(found, truth) / error(odometry, truth)


@pytest.mark.parametrize('draw', [5, 9, 13])
def test_optimize_with_half_of_the_closures_false_in_runs(draw, monkeypatch):
    assert ratio_of_drive(draw) < 0.2
    monkeypatch.setattr(Refutation, 'refuted', lambda *_: [])
    assert ratio_of_drive(draw) > 0.35


def two_sessions(covariance=None):
    """Return stamps, odometry, and closures within each of two sessions of two laps."""
    truth, lap = circle(4), 100
    stamps = (np.arange(len(truth)) + 1) * 10**9
    stamps[2 * lap :] += 1000 * 10**9
    dice, noticed = np.random.default_rng(1), np.ones(len(truth), bool)
    odometry = planar_poses(drifted(truth, noticed, dice, 1.0))
    queries = [*range(lap, 2 * lap), *range(3 * lap, 4 * lap)]
    closures = [closure(truth, q, q - lap, None, stamps) for q in queries]
    if covariance is not None:
        closures = [replace(each, covariance=covariance) for each in closures]
    return stamps, odometry, closures


def test_optimize_sessions_that_nothing_joins_are_compared_each():
    _, graph = optimize(*two_sessions())
    assert graph.chain.sessions == 2
    assert graph.uncompared == 0
    assert graph.accepted >= 198


@pytest.mark.parametrize('variance', [1e-8, 1e4])
def test_optimize_ill_conditioned_edges_are_counted_and_not_compared_together(variance):
    found, graph = optimize(*two_sessions(np.eye(6) * variance))
    assert np.isfinite(found).all()
    assert graph.accepted >= 198
    assert (graph.uncompared > 0) == (variance < 1)
