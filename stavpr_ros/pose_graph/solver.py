# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The graph as factors of GTSAM: iSAM2 with QR, or all at once."""

from typing import Any

import numpy as np
from stavpr_ros.errors import UnavailableError
from stavpr_ros.pose_graph.closures import ResolvedClosure
from stavpr_ros.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_ros.pose_graph.transforms import inverse

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
        self._isam: Any = None
        self._count = 0
        self._factors: dict[int, int] = {}  # number of a closure: index of its factor

    def restart(self) -> None:
        """Forget everything: the next update builds the graph anew."""
        self._isam, self._count = None, 0
        self._factors = {}

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
        self._add_nodes(graph, values, chain, initial, noise, links)
        first = graph.size()
        for number in added:
            graph.add(self._edge(edges[number]))
        result = self._isam.update(graph, values, removed)
        indices = result.getNewFactorsIndices()
        for i, number in enumerate(added):
            self._factors[number] = indices[first + i]
        self._isam.update()  # once more: the first one moves the points of linearization
        return _matrices(gtsam, self._isam.calculateEstimate(), len(chain))

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
        gtsam = self._gtsam
        base, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._count = 0
        self._add_nodes(base, values, chain, initial, noise, links)
        options = gtsam.LevenbergMarquardtParams()
        options.setLinearSolverType('MULTIFRONTAL_QR')
        options.setMaxIterations(100)
        for kernel in kernels:
            graph = gtsam.NonlinearFactorGraph(base)
            for edge in edges.values():
                graph.add(self._edge(edge, kernel))
            values = gtsam.LevenbergMarquardtOptimizer(graph, values, options).optimize()
        self.restart()
        return _matrices(gtsam, values, len(chain))

    def _add_nodes(
        self, graph: Any, values: Any, chain: KeyframeChain, initial: np.ndarray,
        noise: OdometryNoise, links: dict[int, int],
    ) -> None:  # fmt: skip
        gtsam = self._gtsam
        diagonal = gtsam.noiseModel.Diagonal.Sigmas
        tight = diagonal(np.full(6, ANCHOR))
        loose = diagonal(np.array([LOOSE_ANGLE] * 3 + [LOOSE_POSITION] * 3))
        T, previous, travelled = chain.transforms, chain.previous, chain.travelled
        for node in range(self._count, len(chain)):
            pose = gtsam.Pose3(initial[node])
            values.insert(node, pose)
            before = int(previous[node])
            if before >= 0:
                step = inverse(T[before]) @ T[node]
                distance = max(float(travelled[node] - travelled[before]), 0.05)
                sigmas = np.full(6, noise.rotation * np.sqrt(distance))
                sigmas[3:] = noise.translation * np.sqrt(distance)
                graph.add(
                    gtsam.BetweenFactorPose3(before, node, gtsam.Pose3(step), diagonal(sigmas))
                )
            elif chain.session[node] < 0 or links.get(node) == -1:
                graph.add(gtsam.PriorFactorPose3(node, pose, tight))
            elif node in links:
                link = links[node]
                step = inverse(initial[link]) @ initial[node]
                graph.add(gtsam.BetweenFactorPose3(link, node, gtsam.Pose3(step), loose))
        self._count = len(chain)

    def _edge(self, edge: ResolvedClosure, kernel: float = CAUCHY) -> Any:
        gtsam = self._gtsam
        model = gtsam.noiseModel.Robust.Create(
            gtsam.noiseModel.mEstimator.Cauchy.Create(kernel),
            gtsam.noiseModel.Gaussian.Covariance(edge.covariance),
        )
        measured = gtsam.Pose3(edge.transform)
        return gtsam.BetweenFactorPose3(edge.place, edge.query, measured, model)


def _matrices(gtsam: Any, values: Any, count: int) -> np.ndarray:
    """Return the poses of the keys 0 to count - 1, shape (count, 4, 4)."""
    rows = gtsam.utilities.extractPose3(values)  # the rotation by rows, then x y z
    result = np.zeros((count, 4, 4))
    result[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    result[:, :3, 3] = rows[:, 9:]
    result[:, 3, 3] = 1
    return result
