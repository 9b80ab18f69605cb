# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The graph as factors of GTSAM: iSAM2 with QR, or all at once.

Only some nodes are variables: a run of the odometry between two of them is one factor, and the
nodes inside a run follow from its ends.
"""

from typing import Any

import numpy as np
from stavpr_ros.errors import UnavailableError
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_slam.pose_graph.runs import Runs

CAUCHY = 2.5  # whitened deviations from which the influence of a closure falls
WIDE = 40.0  # the same, of a first solution from afar
ANCHOR = 1e-4  # deviation of the pose of the first node, rad and m
LOOSE_ANGLE, LOOSE_POSITION = 3.0, 1e3  # of a session that nothing joins to the others
RELINEARIZE = 0.05


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

    def update(
        self,
        chain: KeyframeChain,
        initial: np.ndarray,
        edges: dict[int, ResolvedClosure],
        noise: OdometryNoise,
        links: dict[int, int],
    ) -> np.ndarray:
        """
        Bring the estimate up to date.

        Nodes after the last edge are where the odometry has them: they wait for the next edge.

        :param initial: of all nodes; the last estimate and what the odometry adds to it, shape
            (N, 4, 4).
        :param edges: the accepted closures by their numbers.
        :param links: first node of each session that no edge joins to others: the node that it is
            tied to loosely; -1 = it is the anchor.
        :returns: transforms of all nodes in the map, shape (N, 4, 4).
        """
        gtsam = self._gtsam
        removed = [self._factors.pop(k) for k in list(self._factors) if k not in edges]
        added = [k for k in edges if k not in self._factors]
        if self._isam is not None and not added and not removed:
            return initial
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if self._isam is None:
            options = gtsam.ISAM2Params()
            options.setFactorization('QR')
            options.setRelinearizeThreshold(RELINEARIZE)
            options.relinearizeSkip = 1
            self._isam = gtsam.ISAM2(options)
        runs = self._divide(chain, noise, edges, links)
        new, replaced = self._add_runs(graph, values, chain, initial, runs, links)
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
        self._isam.update()  # once more: the first one moves the points of linearization
        return self._nodes(self._isam.calculateEstimate(), runs)

    def solve(
        self,
        chain: KeyframeChain,
        initial: np.ndarray,
        edges: dict[int, ResolvedClosure],
        noise: OdometryNoise,
        links: dict[int, int],
        kernels: tuple[float, ...],
    ) -> np.ndarray:
        """
        Return the estimate of all nodes by Levenberg-Marquardt; arguments as in `update`.

        :param kernels: of Cauchy, one solution after the other: a narrow one does not pull edges
            from afar.
        """
        self.restart()
        _, values, runs = self._optimized(chain, initial, edges, noise, links, kernels)
        self.restart()
        return self._nodes(values, runs)

    def residuals(
        self, chain: KeyframeChain, initial: np.ndarray, edges: dict[int, ResolvedClosure],
        others: dict[int, ResolvedClosure], noise: OdometryNoise, links: dict[int, int],
    ) -> tuple[np.ndarray, dict[int, tuple[np.ndarray, np.ndarray]]]:  # fmt: skip
        """
        Return what edges miss the solution by that some of them have by least squares.

        Arguments as in `update`.

        :param edges: of the solution.
        :param others: further ones, with keys that ``edges`` has not.
        :returns: transforms of all nodes, shape (N, 4, 4); for each edge what it misses by in its
            own deviations, shape (6,), and the covariance of the solution there, (6, 6).
        """
        gtsam = self._gtsam
        self.restart()
        self._ends |= {node for edge in others.values() for node in (edge.query, edge.place)}
        # no edge compares sessions that nothing joins: loosely tied, they would be ill-conditioned
        anchors = dict.fromkeys(links, -1)
        graph, values, runs = self._optimized(chain, initial, edges, noise, anchors, (None,))
        marginals, found = gtsam.Marginals(graph, values), {}
        for key, edge in (edges | others).items():
            joint = marginals.jointMarginalCovariance(gtsam.KeyVector([edge.place, edge.query]))
            covariance = joint.fullMatrix()  # in the order of the nodes
            if edge.query < edge.place:
                covariance = np.roll(covariance, 6, axis=(0, 1))
            change, missed = self._edge(edge, None).linearize(values).jacobian()
            found[key] = missed, change @ covariance @ change.T
        self.restart()
        return self._nodes(values, runs), found

    def _optimized(
        self, chain: KeyframeChain, initial: np.ndarray, edges: dict[int, ResolvedClosure],
        noise: OdometryNoise, links: dict[int, int], kernels: tuple[float | None, ...],
    ) -> tuple[Any, Any, Runs]:  # fmt: skip
        """Return the graph, its variables by Levenberg-Marquardt, and the runs."""
        gtsam = self._gtsam
        base, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        runs = self._divide(chain, noise, edges, links)
        self._add_runs(base, values, chain, initial, runs, links)
        options = gtsam.LevenbergMarquardtParams()
        options.setLinearSolverType('MULTIFRONTAL_QR')
        options.setMaxIterations(100)
        for kernel in kernels:
            graph = gtsam.NonlinearFactorGraph(base)
            for edge in edges.values():
                graph.add(self._edge(edge, kernel))
            values = gtsam.LevenbergMarquardtOptimizer(graph, values, options).optimize()
        return graph, values, runs

    def _divide(
        self, chain: KeyframeChain, noise: OdometryNoise, edges: dict[int, ResolvedClosure],
        links: dict[int, int],
    ) -> Runs:  # fmt: skip
        self._ends |= {node for edge in edges.values() for node in (edge.query, edge.place)}
        self._ends |= {node for node in links.values() if node >= 0}
        return Runs.of(chain, noise, self._ends)

    def _add_runs(
        self, graph: Any, values: Any, chain: KeyframeChain, initial: np.ndarray, runs: Runs,
        links: dict[int, int],
    ) -> tuple[list[int], list[int]]:  # fmt: skip
        """Add variables and runs; return where runs begin anew, and the factors they replace."""
        gtsam, new, replaced = self._gtsam, [], []
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
                model = gtsam.noiseModel.Gaussian.Covariance(runs.covariance[node])
                motion = gtsam.Pose3(runs.motion[node])
                factor = gtsam.BetweenFactorPose3(before, node, motion, model)
            elif chain.session[node] < 0 or links.get(node) == -1:
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

    def _edge(self, edge: ResolvedClosure, kernel: float | None = CAUCHY) -> Any:
        gtsam = self._gtsam
        model = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        if kernel is not None:
            estimator = gtsam.noiseModel.mEstimator.Cauchy.Create(kernel)
            model = gtsam.noiseModel.Robust.Create(estimator, model)
        measured = gtsam.Pose3(edge.transform)
        return gtsam.BetweenFactorPose3(edge.place, edge.query, measured, model)

    def _nodes(self, values: Any, runs: Runs) -> np.ndarray:
        """Return all nodes, shape (N, 4, 4), from the values of the variables."""
        rows = self._gtsam.utilities.extractPose3(values)  # the rotation by rows, then x y z
        found = np.tile(np.eye(4), (len(runs.variable), 1, 1))
        found[runs.variable, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
        found[runs.variable, :3, 3] = rows[:, 9:]
        return runs.filled(found)
