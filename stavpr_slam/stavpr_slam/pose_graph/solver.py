# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The graph as factors of GTSAM: iSAM2 with QR, or all at once.

Few nodes are variables: a run of the odometry between two of them is one factor, and the
nodes inside a run follow from its ends.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from stavpr_ros.errors import UnavailableError
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.runs import Runs

ANCHOR = 1e-4  # deviation of the pose of the first node, rad and m
LOOSE_ANGLE, LOOSE_POSITION = 3.0, 1e3  # of a session that nothing joins to the others
RELINEARIZE = 0.05
STEPS, MOVED = 10, 0.05  # of iSAM2 after a change: at most, and until the nodes move less (m)


def load_gtsam() -> Any:
    """
    Import GTSAM.

    :raises UnavailableError: it is not installed.
    """
    try:
        import gtsam
    except ImportError as error:
        raise UnavailableError(
            'the pose graph requires GTSAM, which is not installed: pip install gtsam (the extra '
            'slam of this package)'
        ) from error
    return gtsam


@dataclass(frozen=True, eq=False)
class Problem:
    """
    What is solved.

    :param initial: transforms of all nodes, shape (N, 4, 4).
    :param edges: accepted closures by their numbers.
    :param scale: factor on the errors of the odometry.
    :param links: first node of each session that no edge joins to others: the node that it is
        tied to loosely; -1 = it is the anchor.
    """

    chain: KeyframeChain
    initial: np.ndarray
    edges: dict[int, ResolvedClosure]
    scale: float
    links: dict[int, int]


class Solver:
    """
    Estimates the nodes of a graph.

    :raises UnavailableError: GTSAM is not installed.
    """

    def __init__(self) -> None:
        self._gtsam = load_gtsam()
        self.restart()

    def restart(self) -> None:
        """Forget everything: the next update builds the graph anew."""
        self._isam: Any = None
        self._factors: dict[int, int] = {}  # number of a closure: index of its factor
        self._ends: set[int] = set()  # nodes that edges have made variables
        self._runs: dict[int, tuple[int, int]] = {}  # variable: the one before, index of factor

    def update(self, problem: Problem) -> np.ndarray:
        """
        Bring the estimate up to date by iSAM2; return all nodes in the map, shape (N, 4, 4).

        Nodes after the last edge are where the odometry has them: they wait for the next edge.
        """
        gtsam, edges = self._gtsam, problem.edges
        removed = [self._factors.pop(k) for k in list(self._factors) if k not in edges]
        added = [k for k in edges if k not in self._factors]
        if self._isam is not None and not added and not removed:
            return problem.initial
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if self._isam is None:
            options = gtsam.ISAM2Params()
            options.setFactorization('QR')
            options.setRelinearizeThreshold(RELINEARIZE)
            options.relinearizeSkip = 1
            self._isam = gtsam.ISAM2(options)
        runs = self._divide(problem)
        new, replaced = self._add_runs(graph, values, problem, runs)
        first = graph.size()
        for number in added:
            graph.add(self._edge(edges[number]))
        result = self._isam.update(graph, values, removed + replaced)
        indices = result.getNewFactorsIndices()
        for node in new:
            before, position = self._runs[node]
            self._runs[node] = before, indices[position]
        for i, number in enumerate(added):
            self._factors[number] = indices[first + i]
        nodes = problem.initial
        for _ in range(STEPS):  # each one moves the points of linearization
            self._isam.update()
            last, nodes = nodes, self._nodes(self._isam.calculateEstimate(), runs)
            if np.abs(nodes[:, :3, 3] - last[:, :3, 3]).max() < MOVED:
                break
        return nodes

    def solve(self, problem: Problem) -> np.ndarray:
        """Return the estimate of all nodes by Levenberg-Marquardt, shape (N, 4, 4)."""
        gtsam = self._gtsam
        self.restart()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        runs = self._divide(problem)
        self._add_runs(graph, values, problem, runs)
        for edge in problem.edges.values():
            graph.add(self._edge(edge))
        self.restart()
        options = gtsam.LevenbergMarquardtParams()
        options.setLinearSolverType('MULTIFRONTAL_QR')
        options.setMaxIterations(100)
        return self._nodes(
            gtsam.LevenbergMarquardtOptimizer(graph, values, options).optimize(), runs
        )

    def _divide(self, problem: Problem) -> Runs:
        self._ends |= {n for edge in problem.edges.values() for n in (edge.query, edge.place)}
        self._ends |= {node for node in problem.links.values() if node >= 0}
        return Runs.of(problem.chain, self._ends)

    def _add_runs(
        self, graph: Any, values: Any, problem: Problem, runs: Runs
    ) -> tuple[list[int], list[int]]:
        """Add variables and runs; return where runs begin anew, and the factors they replace."""
        gtsam, new, replaced = self._gtsam, [], []
        initial, links = problem.initial, problem.links
        diagonal = gtsam.noiseModel.Diagonal.Sigmas
        tight = diagonal(np.full(6, ANCHOR))
        loose = diagonal(np.array([LOOSE_ANGLE] * 3 + [LOOSE_POSITION] * 3))
        for node in np.flatnonzero(runs.variable).tolist():
            before = int(runs.before[node])
            known = self._runs.get(node)
            if known is not None and known[0] == before:
                continue
            if known is None:
                values.insert(node, gtsam.Pose3(initial[node]))
            else:
                replaced.append(known[1])
            if before >= 0:
                covariance = problem.scale**2 * runs.covariance[node]
                model = gtsam.noiseModel.Gaussian.Covariance(covariance)
                motion = gtsam.Pose3(runs.motion[node])
                factor = gtsam.BetweenFactorPose3(before, node, motion, model)
            elif problem.chain.session[node] < 0 or links.get(node) == -1:
                factor = gtsam.PriorFactorPose3(node, gtsam.Pose3(initial[node]), tight)
            elif node in links:
                link = links[node]
                step = gtsam.Pose3(inverse(initial[link]) @ initial[node])
                factor = gtsam.BetweenFactorPose3(link, node, step, loose)
            else:
                self._runs[node] = before, -1
                continue
            self._runs[node] = before, graph.size()
            new.append(node)
            graph.add(factor)
        return new, replaced

    def _edge(self, edge: ResolvedClosure) -> Any:
        gtsam = self._gtsam
        model = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        measured = gtsam.Pose3(edge.transform)
        return gtsam.BetweenFactorPose3(edge.place, edge.query, measured, model)

    def _nodes(self, values: Any, runs: Runs) -> np.ndarray:
        """Return all nodes, shape (N, 4, 4), from the values of the variables."""
        rows = self._gtsam.utilities.extractPose3(values)  # the rotation by rows, then x y z
        found = np.tile(np.eye(4), (len(runs.variable), 1, 1))
        found[runs.variable, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
        found[runs.variable, :3, 3] = rows[:, 9:]
        return runs.filled(found)
