# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Cycles of two closures and the odometry between their ends: their distance from the identity.

The covariance of a cycle is that of its closures, and of the odometry along both paths (Mangelson
et al., *Pairwise Consistent Measurement Set Maximization*, ICRA 2018). The deviations of many
cycles also show how large the errors of the odometry are.
"""

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.path_errors import path_errors
from stavpr_slam.pose_graph.transforms import adjoints, logarithms

LIMIT = 16.0  # squared deviations: 99.9 % for motion in a plane, of three dimensions
FEW = 0.537  # most probable squared scale of Student's t with 2 degrees for normal errors
CLOSURE_FACTORS = (0.05, 0.2, 1.0)  # on the covariances of closures that are tried
SIGNIFICANT = 1.92  # difference of logarithms of likelihoods: 95 %, one degree of freedom
NEAR, FAR = 30.0, 400.0  # meters that the query travels between two closures of such a cycle


class Cycles:
    """
    Cycles of closures: their ends and measurements as arrays.

    :param closures: at least one.
    """

    def __init__(self, chain: KeyframeChain, closures: list[ResolvedClosure]) -> None:
        self._chain = chain
        self.query = np.array([each.query for each in closures])
        self.place = np.array([each.place for each in closures])
        self.Z = np.array([each.transform for each in closures])
        self.covariance = np.array([each.covariance for each in closures])

    def _same(self, i: int, sessions: np.ndarray) -> np.ndarray:
        """Return the closures between the same two sessions as closure i."""
        query, place = sessions[self.query], sessions[self.place]
        return np.flatnonzero((query == query[i]) & (place == place[i]))

    def deviations(self, i: int, scale: float) -> np.ndarray:
        """
        Return the squared Mahalanobis distances of the cycles of closure i with all, (n,).

        0 where there is no cycle: the ends are in different sessions, splits apart.

        :param scale: factor on the errors of the odometry.
        """
        same = self._same(i, self._chain.recording)
        error, measured, odometry = self._cycles(i, same)
        squared = np.zeros(len(self.Z))
        solved = np.linalg.solve(measured + scale**2 * odometry, error[:, :, None])[:, :, 0]
        squared[same] = (error * solved).sum(axis=1)
        return squared

    def _cycles(self, i: int, others: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return the logarithms of cycles with closure i, and their covariances, to first order.

        :param others: closures, shape (n,).
        :returns: in the axes of the query of i, rotation first, (n, 6); covariances by the
            closures and by the odometry, (n, 6, 6) each.
        """
        T = self._chain.transforms
        query, place = np.full(len(others), self.query[i]), np.full(len(others), self.place[i])
        queries = inverse(T[query]) @ T[self.query[others]]
        places = inverse(T[place]) @ T[self.place[others]]
        back = inverse(self.Z[i])
        error = logarithms(back @ places @ self.Z[others] @ inverse(queries))
        moved = adjoints(queries)
        measured = self.covariance[i] + moved @ self.covariance[others] @ moved.swapaxes(1, 2)
        driven, bent = path_errors(self._chain, query, self.query[others])
        along, turned = path_errors(self._chain, place, self.place[others])
        change = adjoints(back[None])
        # a bias on both paths cancels where the query drives as the place was driven
        bent = bent - change @ turned
        odometry = driven + change @ along @ change.swapaxes(1, 2) + bent @ bent.swapaxes(1, 2)
        return error, measured, odometry

    def noise_scale(self, scales: np.ndarray) -> float:
        """
        Return the factor on the errors of the odometry that the cycles have most probably.

        Student's t with 2 degrees of freedom: wrong closures have little weight. The covariances
        of the closures may be too large or too small: the most probable of some factors is taken.
        """
        at = self._chain.travelled[self.query]
        rows = []
        for i in range(len(self.Z)):
            same = self._same(i, self._chain.session)
            driven = np.abs(at[same] - at[i])
            same = same[(driven > NEAR) & (driven < FAR) & (same > i)]
            if len(same):
                error, *covariances = self._cycles(i, same)
                off = [np.linalg.norm(error[:, 3:], axis=1), np.linalg.norm(error[:, :3], axis=1)]
                rows.append(np.array([off, *(_planar(each) for each in covariances)]))
        if not rows:
            return float(scales[-1])
        off, measured, odometry = np.concatenate(rows, axis=2)
        likelihood = [
            max(_likelihood(off, FEW * (factor * measured + scale**2 * odometry), 2)
                for factor in CLOSURE_FACTORS)
            for scale in scales
        ]  # fmt: skip
        return float(scales[np.argmax(likelihood)])

    def loop_scale(self, scales: np.ndarray) -> float:
        """
        Return the factor on the errors of the odometry that most probably left these loops open.

        Few closures, and short loops, have no cycles that :meth:`noise_scale` could use. It is the
        least factor unless the likelihood ratio excludes that one.

        :param scales: rising.
        """
        session, T = self._chain.session, self._chain.transforms
        same = session[self.query] == session[self.place]
        if not same.any():
            return float(scales[-1])
        query, place = self.query[same], self.place[same]
        error = logarithms(inverse(self.Z[same]) @ inverse(T[place]) @ T[query])
        spread, bent = path_errors(self._chain, query, place)
        off = np.array([np.linalg.norm(error[:, i : i + 3], axis=1) for i in (3, 0)])
        measured = _planar(self.covariance[same])
        odometry = _planar(spread + bent @ bent.swapaxes(1, 2))
        likelihood = [_likelihood(off, measured + scale**2 * odometry, 4) for scale in scales]
        best = int(np.argmax(likelihood))
        return float(scales[best if likelihood[best] > likelihood[0] + SIGNIFICANT else 0])


def _planar(covariances: np.ndarray) -> np.ndarray:
    """Return the variances of position and angle in a plane of covariances (n, 6, 6), (2, n)."""
    turn, shift = (np.linalg.eigvalsh(covariances[:, i : i + 3, i : i + 3]) for i in (0, 3))
    return np.array([shift[:, 1:].sum(axis=1), turn[:, 2]])


def _likelihood(off: np.ndarray, variances: np.ndarray, freedom: float) -> float:
    """Return the logarithm of that of deviations by Student's t, each (2, n)."""
    tails = (freedom + 1) / 2 * np.log1p(off**2 / (freedom * variances))
    return -float((tails + np.log(variances) / 2).sum())
