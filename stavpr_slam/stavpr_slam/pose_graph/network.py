# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The graph as factors of GTSAM: solved by least squares, or by graduated non-convexity.

Few nodes are variables: a run of the odometry between two of them is one factor, and the
nodes inside a run follow from its ends. Drives in a plane have poses in the plane.
"""

from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np
from scipy.stats import chi2
from stavpr_ros.errors import UnavailableError
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.runs import Runs

ANCHOR = 1e-4  # deviation of the pose of the first node, rad and m
LOOSE_ANGLE, LOOSE_POSITION = 3.0, 1e3  # of a session that nothing joins to the others
PLANAR = [3, 4, 2]  # x, y and yaw of a twist, in the order of Pose2
FLAT = 1e-6  # m and rad out of the plane that are none
INLIER = 0.99  # part of right closures whose residuals are below the limit
GROWTH = 2.0  # of the parameter of graduated non-convexity
FIRST_STEPS, MAX_STEPS = 4, 25  # of Gauss and Newton: with all closures, and at most
CONVERGED = 1e-3  # change of the error, half the squared deviations, of a solution


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


class Network:
    """
    The variables, odometry and closures of a graph.

    :param initial: transforms of all nodes, shape (N, 4, 4).
    :param closures: n closures; ``query`` and ``place`` are their nodes, (n,).
    :param links: first node of each session: the node that it is tied to loosely; -1 = it is an
        anchor.
    :raises UnavailableError: GTSAM is not installed.
    """

    def __init__(
        self,
        chain: KeyframeChain,
        initial: np.ndarray,
        closures: Sequence[ResolvedClosure],
        links: Mapping[int, int],
    ) -> None:
        self._gtsam, self._chain = load_gtsam(), chain
        self._initial, self._links = initial, links
        self.query = np.array([each.query for each in closures], int)
        self.place = np.array([each.place for each in closures], int)
        ends = {*self.query.tolist(), *self.place.tolist(), *links.values()}
        self._runs = Runs.of(chain, ends)
        self._variables = np.flatnonzero(self._runs.variable).tolist()
        T = chain.transforms
        self._is_planar = bool(np.ptp(T[:, 2, 3]) < FLAT and np.abs(T[:, 2, :2]).max() < FLAT)
        self.freedom = 3 if self._is_planar else 6
        loose = np.array([LOOSE_ANGLE] * 3 + [LOOSE_POSITION] * 3)
        self._loose = np.diag((loose[PLANAR] if self._is_planar else loose) ** -2.0)
        self.loose_determinant = float(np.linalg.slogdet(self._loose)[1] / 2)
        self.limit = float(chi2.ppf(INLIER, self.freedom))
        covariance = np.array([each.covariance for each in closures]).reshape(-1, 6, 6)
        self._measured = [self._pose(each.transform) for each in closures]
        self.information = np.linalg.inv(self._own(covariance))
        self._factors = [self._closure(i, 1.0) for i in range(len(closures))]
        inside = np.flatnonzero(self._runs.variable & (self._runs.before >= 0)).tolist()
        self._motions = {i: self._pose(self._runs.motion[i]) for i in inside}

    def joined(self, numbers: np.ndarray) -> int:
        """Return how many sessions some of the closures join to others."""
        session = self._chain.session
        ends = session[self.query[numbers]], session[self.place[numbers]]
        across = ends[0] != ends[1]
        anchored = {int(session[node]) for node, link in self._links.items() if link < 0}
        return len({*ends[0][across].tolist(), *ends[1][across].tolist()} - anchored - {-1})

    def _own(self, covariances: np.ndarray) -> np.ndarray:
        """Return covariances (n, 6, 6) in the order of the variables."""
        return covariances[:, PLANAR][:, :, PLANAR] if self._is_planar else covariances

    def _pose(self, transform: np.ndarray) -> Any:
        if self._is_planar:
            (c, _), (s, _) = transform[:2, :2]
            return self._gtsam.Pose2(*transform[:2, 3], np.arctan2(s, c))
        return self._gtsam.Pose3(transform)

    def _between(self, start: int, end: int, pose: Any, information: np.ndarray) -> Any:
        kind = 'BetweenFactorPose2' if self._is_planar else 'BetweenFactorPose3'
        model = self._gtsam.noiseModel.Gaussian.Information(information)
        return getattr(self._gtsam, kind)(start, end, pose, model)

    def values(self, nodes: np.ndarray) -> Any:
        """Return the variables of transforms of all nodes (N, 4, 4)."""
        values = self._gtsam.Values()
        for node in self._variables:
            values.insert(node, self._pose(nodes[node]))
        return values

    def _ends(self, values: Any) -> np.ndarray:
        """Return the transforms of the variables, of all nodes the identity, (N, 4, 4)."""
        found, at = np.tile(np.eye(4), (len(self._chain), 1, 1)), self._runs.variable
        if self._is_planar:
            x, y, yaw = self._gtsam.utilities.extractPose2(values).T
            c, s = np.cos(yaw), np.sin(yaw)
            found[at, :2, :2] = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
            found[at, 0, 3], found[at, 1, 3] = x, y
            found[:, 2, 3] = self._chain.transforms[0, 2, 3]
            return found
        rows = self._gtsam.utilities.extractPose3(values)  # the rotation by rows, then x y z
        found[at, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
        found[at, :3, 3] = rows[:, 9:]
        return found

    def nodes(self, values: Any) -> np.ndarray:
        """Return the transforms of all nodes, shape (N, 4, 4)."""
        return self._runs.filled(self._ends(values))

    def odometry(self, scales: np.ndarray) -> Any:
        """
        Return the factors of the odometry and of the anchors.

        :param scales: on the errors of the odometry of each node, shape (N,).
        """
        gtsam, runs, initial = self._gtsam, self._runs, self._initial
        graph, d = gtsam.NonlinearFactorGraph(), self.freedom
        own = np.array(list(self._motions), int)
        covariances = self._own(scales[own, None, None] ** 2 * runs.covariance[own])
        informations = dict(zip(self._motions, np.linalg.inv(covariances), strict=True))
        tight = gtsam.noiseModel.Isotropic.Sigma(d, ANCHOR)
        prior = gtsam.PriorFactorPose2 if self._is_planar else gtsam.PriorFactorPose3
        self.log_determinant = -float(np.linalg.slogdet(covariances)[1].sum()) / 2
        for node in self._variables:
            before, link = int(runs.before[node]), self._links.get(node, -1)
            if before >= 0:
                graph.add(self._between(before, node, self._motions[node], informations[node]))
            elif link < 0:
                self.log_determinant -= d * math.log(ANCHOR)
                graph.add(prior(node, self._pose(initial[node]), tight))
            else:
                self.log_determinant += self.loose_determinant
                step = self._pose(inverse(initial[link]) @ initial[node])
                graph.add(self._between(link, node, step, self._loose))
        return graph

    def _closure(self, i: int, weight: float) -> Any:
        return self._between(
            int(self.place[i]), int(self.query[i]), self._measured[i],
            weight * self.information[i],
        )  # fmt: skip

    def _with(self, odometry: Any, weights: np.ndarray) -> Any:
        graph = self._gtsam.NonlinearFactorGraph(odometry)
        for i in np.flatnonzero(weights > 1e-4).tolist():
            whole = weights[i] == 1
            graph.add(self._factors[i] if whole else self._closure(i, float(weights[i])))
        return graph

    def residuals(self, values: Any) -> np.ndarray:
        """Return the squared deviations of the closures, shape (n,)."""
        return np.array([2 * each.error(values) for each in self._factors])

    def most_strained(self, odometry: Any, values: Any) -> tuple[int, float]:
        """Return the node behind the part of the odometry that deviates most, and how much."""
        squared = [2 * odometry.at(i).error(values) for i in range(odometry.size())]
        worst = int(np.argmax(squared))
        return self._variables[worst], squared[worst]

    def _step(self, graph: Any, values: Any) -> Any:
        return values.retract(graph.linearize(values).optimize())

    def robust(self, odometry: Any, values: Any, start: float = 0.0) -> tuple[np.ndarray, Any]:
        """
        Decide which closures are right by graduated non-convexity, truncated least squares.

        As in Yang et al., *Graduated Non-Convexity for Robust Spatial Perception*, RA-L 2020, with
        a step of Gauss and Newton for each parameter; the odometry is right.

        :param start: first parameter, where the variables are a solution already.
        :returns: whether each closure is, shape (n,), and the variables.
        """
        weights, limit = np.ones(len(self.query)), self.limit
        for _ in range(0 if start else FIRST_STEPS):
            values = self._step(self._with(odometry, weights), values)
        squared = self.residuals(values)
        if 2 * squared.max(initial=0.0) <= limit:
            return weights > 0, values
        mu = start or limit / (2 * squared.max() - limit)
        for _ in range(MAX_STEPS):
            surely, never = mu / (mu + 1) * limit, (mu + 1) / mu * limit
            between = np.sqrt(limit * mu * (mu + 1) / squared.clip(surely)) - mu
            weights = np.where(squared >= never, 0.0, np.where(squared <= surely, 1.0, between))
            values = self._step(self._with(odometry, weights), values)
            if mu > 1 and (np.minimum(weights, 1 - weights) < 1e-3).all():
                break
            squared, mu = self.residuals(values), mu * GROWTH
        return weights > 0.5, values

    def solve(self, odometry: Any, values: Any, weights: np.ndarray) -> tuple[Any, float, float]:
        """
        Estimate the variables by least squares.

        :param weights: of the closures, shape (n,).
        :returns: the variables, the squared deviations in all, and the logarithm of the
            determinant of the square root of the information.
        """
        graph = self._with(odometry, weights)
        error = graph.error(values)
        for _ in range(MAX_STEPS):
            before, values = error, self._step(graph, values)
            error = graph.error(values)
            if abs(before - error) < CONVERGED:
                break
        tree = graph.linearize(values).eliminateMultifrontal()
        return values, 2 * error, tree.logDeterminant()
