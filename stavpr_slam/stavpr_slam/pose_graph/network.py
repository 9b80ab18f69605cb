# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The graph as factors, solved by least squares.

Few nodes are variables: a run of the odometry between two of them is one factor, and the
nodes inside a run follow from its ends. Drives in a plane have poses in the plane.
"""

from collections.abc import Mapping
import math

import numpy as np
from scipy.stats import chi2
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.runs import Runs
from stavpr_slam.pose_graph.sessions import session_pairs
from stavpr_slam.pose_graph.solver import Solver

ANCHOR = 1e-4  # deviation of the pose of the first node, rad and m
LOOSE_ANGLE, LOOSE_POSITION = 3.0, 1e3  # of a session that nothing joins to the others
PLANAR = [3, 4, 2]  # x, y and yaw of a twist
FLAT = 1e-6  # m and rad out of the plane that are none


def freedom_of(chain: KeyframeChain) -> int:
    """Return the freedom of poses: 3 where the odometry is in the plane, 6 elsewhere."""
    z, tilt = chain.transforms[:, 2, 3], chain.transforms[:, 2, :2]
    return 3 if np.ptp(z) < FLAT and np.abs(tilt).max() < FLAT else 6


def room(nodes: np.ndarray, freedom: int) -> float:
    """
    Return the logarithm of the poses of a map, by a normal density's constant.

    :param nodes: transforms, (N, 4, 4).
    :param freedom: of poses, 3 or 6.
    """
    size = np.maximum(np.sort(np.ptp(nodes[:, :3, 3], axis=0)), 1.0)
    space = size[1:].prod() * 2 * math.pi if freedom == 3 else size.prod() * 8 * math.pi**2
    return math.log(space) - freedom / 2 * math.log(2 * math.pi)


class Network:
    """
    The variables, odometry and closures of a graph.

    Values of the variables are transforms, shape (V, 4, 4).

    :param initial: transforms of all nodes, shape (N, 4, 4).
    :param closures: n closures; ``query`` and ``place`` are their nodes, (n,), and
        ``are_across`` whether they are in two sessions, (n,), bool.
    :param links: first node of each session: the node that it is tied to loosely; -1 = it is an
        anchor.
    :param freedom: of poses, 3 = in the plane, or 6.
    :param space: logarithm of the poses of the map, see :func:`room`.
    """

    def __init__(
        self,
        chain: KeyframeChain,
        initial: np.ndarray,
        closures: ClosureArrays,
        links: Mapping[int, int],
        freedom: int,
        space: float,
    ) -> None:
        self._chain, self._links = chain, links
        self.query, self.place = closures.query, closures.place
        self._pairs = session_pairs(chain, closures)
        self.are_across = self._pairs[:, 0] != self._pairs[:, 1]
        ends = {*self.query.tolist(), *self.place.tolist(), *links.values()}
        self._runs = Runs.of(chain, ends)
        variables = np.flatnonzero(self._runs.variable)
        at = np.array(PLANAR if freedom == 3 else range(6))
        loose = np.array([LOOSE_ANGLE] * 3 + [LOOSE_POSITION] * 3)[at] ** -2.0
        self.freedom, self.room = freedom, space
        self._loose_determinant = float(np.log(loose).sum() / 2)
        self.limit = float(chi2.ppf(tuning.INLIER, freedom))
        self.information = np.linalg.inv(closures.covariance[:, at[:, None], at])

        # a factor for each variable: the odometry before it, a loose link, or an anchor
        before = self._runs.before[variables]
        link = np.array([links.get(node, -1) for node in variables.tolist()])
        self._inside = before >= 0
        motions = self._runs.motion[variables]
        first = ~self._inside
        motions[first] = initial[variables[first]]
        tied = first & (link >= 0)
        motions[tied] = inverse(initial[link[tied]]) @ motions[tied]
        self._fixed = np.where(tied[:, None], loose, ANCHOR**-2.0)[first, :, None] * np.eye(
            len(at)
        )
        number = np.full(len(chain) + 1, -1)
        number[variables] = np.arange(len(variables))
        starts = np.concatenate([np.where(self._inside, before, link), self.place])
        self._solver = Solver(
            number[np.stack([starts, np.concatenate([variables, self.query])], axis=1)],
            np.concatenate([motions, closures.transform]), at,
        )  # fmt: skip
        self.innovations = self._solver.innovations  # at the last variables
        self._variables, self._at = variables, at
        self._covariance = self._runs.covariance[variables[self._inside]][:, at[:, None], at]

    def count_joins(self, numbers: np.ndarray) -> int:
        """Return how many sessions some of the closures join to others."""
        session, pairs = self._chain.session, self._pairs[numbers]
        across = pairs[pairs[:, 0] != pairs[:, 1]]
        anchored = {int(session[node]) for node, link in self._links.items() if link < 0}
        return len({*across.ravel().tolist()} - anchored - {-1})

    def values(self, nodes: np.ndarray) -> np.ndarray:
        """Return the variables of transforms of all nodes (N, 4, 4)."""
        return nodes[self._variables]

    def nodes(self, values: np.ndarray) -> np.ndarray:
        """Return the transforms of all nodes, shape (N, 4, 4)."""
        transforms = np.tile(np.eye(4), (len(self._chain), 1, 1))
        transforms[self._variables] = values
        return self._runs.fill(transforms)

    def odometry(self, scales: np.ndarray, closures: float = 1.0) -> np.ndarray:
        """
        Return the information of all factors; of the odometry, links and anchors they are first.

        :param scales: on the errors of the odometry of each node, shape (N,).
        :param closures: on the errors of the closures.
        """
        d, own = self.freedom, self._variables[self._inside]
        covariances = scales[own, None, None] ** 2 * self._covariance
        result = np.empty((len(self._variables), d, d))
        result[self._inside] = np.linalg.inv(covariances)
        result[~self._inside] = self._fixed
        return np.concatenate([result, self.information / closures**2])

    def residuals(self, odometry: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the squared deviations of the closures, shape (n,)."""
        return self._solver.linearize(values, odometry)[len(values) :]

    def beside_odometry(self, chosen: np.ndarray) -> np.ndarray:
        """Return innovations of closures within sessions beside the odometry as stated alone."""
        spread, at = self._chain.path_errors(self.query[chosen], self.place[chosen]), self._at
        none = np.zeros(len(self.query))
        return self.innovations(none, chosen, spread[:, at[:, None], at])

    def fit(
        self,
        odometry: np.ndarray,
        counted: np.ndarray,
        values: np.ndarray,
        steps: int = tuning.MAX_STEPS,
    ) -> tuple[np.ndarray, float]:
        """
        Estimate the variables by least squares, and return them and the evidence.

        :param counted: closures that count, shape (n,), bool.
        :param steps: of Gauss and Newton, at most.
        :raises LinAlgError: no solution.
        """
        whole = np.concatenate([np.ones(len(values), bool), counted])
        error = float(self._solver.linearize(values, odometry)[whole].sum())
        for _ in range(steps):
            values, determinant = self._solver.step(values, counted * 1.0)
            before, error = error, float(self._solver.linearize(values, odometry)[whole].sum())
            if abs(before - error) < 2 * tuning.CONVERGED:
                break
        own = np.flatnonzero(counted)
        prior = float(np.linalg.slogdet(odometry[whole])[1].sum()) / 2
        evidence = prior - determinant - error / 2 + len(own) * self.room
        # a session may begin anywhere in the same space
        return values, evidence - self.count_joins(own) * (self.room + self._loose_determinant)
