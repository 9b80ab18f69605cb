# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edges that agree with each other one, and contradict all others together."""

import numpy as np
import pytest
from stavpr_ros.pose_graph.consistency import LIMIT
from stavpr_ros.pose_graph.cycles import Cycles
from stavpr_ros.pose_graph.odometry import OdometryNoise
from stavpr_ros.pose_graph.refutation import refuted
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
    return sorted(refuted(chain, chain.transforms, pairs, NOISE, {0: -1}))


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
        found = refuted(chain, chain.transforms, pairs, NOISE, {0: -1})
        assert found == [int(np.argmin(weights))]


def test_refuted_of_edges_that_nothing_else_compares_are_none(graph):
    """One edge alone has no other that knows its ends."""
    truth, chain, _, dice = graph
    alone = {7: (measured(truth, chain, 2 * LAP + 30, 30, dice, 95, PLANE), 5.0)}
    quiet = OdometryNoise(1e3, 10.0, 0.0)
    assert refuted(chain, chain.transforms, alone, quiet, {0: -1}) == []
    assert refuted(chain, chain.transforms, {}, NOISE, {0: -1}) == []
