# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Cycles of two closures and the odometry between their ends: what they miss the identity by.

The covariance of a cycle is that of its closures, and of the odometry along both ways (Mangelson
et al., *Pairwise Consistent Measurement Set Maximization*, ICRA 2018). How far cycles miss also
shows the errors of the odometry.
"""

import numpy as np
from stavpr_ros.mapping.transforms import cross, inverse
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_slam.pose_graph.transforms import adjoints, angles, logarithms

SIGNIFICANT = 1.92  # difference of logarithms of likelihoods: 95 %, one degree of freedom
FEW = 0.537  # most probable squared scale of Student's t with 2 degrees for normal errors
CLOSURE_FACTORS = (0.05, 0.2, 1.0)  # on the covariances of closures that are tried


class Cycles:
    """
    Cycles of closures: their ends and measurements as arrays.

    :param closures: at least one.
    """

    def __init__(self, chain: KeyframeChain, closures: list[ResolvedClosure]) -> None:
        self._chain = chain
        self.query = query = np.array([each.query for each in closures])
        self.place = place = np.array([each.place for each in closures])
        self.query_session, self.place_session = chain.session[query], chain.session[place]
        self.recordings = chain.recording[query], chain.recording[place]
        self.query_at = chain.travelled[query]
        self.Q, self.P = chain.transforms[query], chain.transforms[place]
        self.Z = np.array([each.transform for each in closures])
        self.covariance = np.array([each.covariance for each in closures])
        variances = np.diagonal(self.covariance, axis1=1, axis2=2)
        self.angle_variance = variances[:, :3].max(axis=1)
        # planar motion: the two larger of the three
        self.position_variance = np.sort(variances[:, 3:], axis=1)[:, 1:].mean(axis=1)

    def deviations(self, i: int, noise: OdometryNoise) -> np.ndarray:
        """
        Return the squared deviations of the cycles of closure i with all, shape (n,).

        Mahalanobis's distance of the whole transform: an error of the heading moves the end of a
        way to one side. 0 where there is no cycle: the ends are in different sessions, splits
        apart.
        """
        query, place = self.recordings
        same = np.flatnonzero((query == query[i]) & (place == place[i]))
        squared = np.zeros(len(self.Z))
        squared[same] = _squared(*self._whole(i, same, noise))
        return squared

    def _whole(
        self, i: int, others: np.ndarray, noise: OdometryNoise
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return what cycles with closure i miss by, and its covariance, to first order.

        A turn of the odometry by w at a point r of the cycle moves its end by r x w.

        :param others: closures, shape (n,).
        :returns: in the axes of the query of i, rotation first: shape (n, 6) and (n, 6, 6).
        """
        queries = inverse(self.Q[i]) @ self.Q[others]
        places = inverse(self.P[i]) @ self.P[others]
        error = logarithms(inverse(self.Z[i]) @ places @ self.Z[others] @ inverse(queries))
        along = self._chain.ways(self.place[i], self.place[others])
        driven = self._chain.ways(self.query[i], self.query[others])
        # the way of the places about the query, in its axes
        R, away = self.Z[i, :3, :3], self.Z[i, :3, 3]
        second = along.second - np.sign(along.length)[:, None, None] * _twice(along.moment, away)
        second += np.abs(along.length)[:, None, None] * np.outer(away, away)
        second = R.T @ second @ R + driven.second
        moment = (along.moment - along.length[:, None] * away) @ R
        lever = np.sign(along.length)[:, None] * moment
        lever += np.sign(driven.length)[:, None] * driven.moment
        length = np.abs(along.length) + np.abs(driven.length)
        moved = adjoints(queries)
        covariance = self.covariance[i] + moved @ self.covariance[others] @ moved.swapaxes(1, 2)
        turn, shift, unit = noise.rotation**2, noise.translation**2, np.eye(3)
        levers = turn * cross(lever)
        covariance[:, 3:, :3] += levers
        covariance[:, :3, 3:] += levers.swapaxes(1, 2)
        covariance[:, :3, :3] += (turn * length)[:, None, None] * unit
        reach = turn * np.trace(second, axis1=1, axis2=2) + shift * length
        covariance[:, 3:, 3:] += reach[:, None, None] * unit - turn * second
        # a bias on both ways cancels where the query drives as the place was driven
        bent = np.concatenate(
            [(driven.length - along.length)[:, None, None] * unit, cross(driven.moment - moment)],
            axis=1,
        )
        covariance += noise.bias**2 * (bent @ bent.swapaxes(1, 2))
        return error, covariance

    def _errors(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return what cycles with closure i miss by, and its variances by both closures.

        :returns: position (m) and angle (rad), each of shape (2, n).
        """
        places = inverse(self.P[i]) @ self.P
        queries = inverse(self.Q) @ self.Q[i]
        cycle = inverse(self.Z[i]) @ places @ self.Z @ queries
        lever = (places[:, :3, 3] ** 2).sum(axis=1)
        turned = self.angle_variance[i] + self.angle_variance
        moved = self.position_variance[i] + self.position_variance + lever * turned / 2
        off = np.linalg.norm(cycle[:, :3, 3], axis=1), angles(cycle)
        return np.array(off), np.array([moved, turned])

    def _odometry(self, i: int, noise: OdometryNoise) -> np.ndarray:
        """Return the variances of position and angle by the odometry of the cycles, (2, n)."""
        along = self._chain.ways(self.place[i], self.place)
        driven = self._chain.ways(self.query[i], self.query)
        bent = driven.moment - along.moment @ self.Z[i, :3, :3]
        length = np.abs(along.length) + np.abs(driven.length)
        moved = noise.translation**2 * length + noise.rotation**2 * (along.spread + driven.spread)
        moved += noise.bias**2 * (bent**2).sum(axis=1)
        turned = noise.rotation**2 * length + (noise.bias * (driven.length - along.length)) ** 2
        return np.array([moved, turned])

    def loop_scale(self, noise: OdometryNoise, scales: np.ndarray) -> float:
        """
        Return the factor on the errors of the odometry that most probably left these loops open.

        Few closures, and short loops, have no cycles that :meth:`noise_scale` could use. It is the
        least factor unless the likelihood ratio excludes that one.

        :param scales: rising.
        """
        same = self.query_session == self.place_session
        if not same.any():
            return float(scales[-1])
        off = inverse(self.Z) @ inverse(self.P) @ self.Q
        off = np.array([np.linalg.norm(off[same, :3, 3], axis=1), angles(off[same])])
        measured = np.array([self.position_variance, self.angle_variance])[:, same]
        ways = self._chain.ways(self.query[same], self.place[same])
        length = np.abs(ways.length)
        moved = noise.translation**2 * length + noise.rotation**2 * ways.spread
        moved += noise.bias**2 * (ways.moment**2).sum(axis=1)
        turned = noise.rotation**2 * length + (noise.bias * length) ** 2
        odometry = np.array([moved, turned])
        likelihood = [_likelihood(off, measured + scale**2 * odometry, 4) for scale in scales]
        best = int(np.argmax(likelihood))
        return float(scales[best if likelihood[best] > likelihood[0] + SIGNIFICANT else 0])

    def noise_scale(self, noise: OdometryNoise, scales: np.ndarray) -> float:
        """
        Return the factor on the errors of the odometry that the cycles have most probably.

        Student's t with 2 degrees of freedom: wrong closures have little weight. The covariances
        of the closures may be too large or too small: the most probable of some factors is taken.
        """
        likelihood = np.zeros((len(CLOSURE_FACTORS), len(scales)))
        for i in range(len(self.Z)):
            same = self.query_session == self.query_session[i]
            same &= self.place_session == self.place_session[i]
            driven = np.abs(self.query_at - self.query_at[i])
            same &= (driven > 30) & (driven < 400) & (np.arange(len(same)) > i)
            if same.any():
                off, measured = (each[:, same] for each in self._errors(i))
                odometry = self._odometry(i, noise)[:, same]
                for j, factor in enumerate(CLOSURE_FACTORS):
                    for k, scale in enumerate(scales):
                        variances = factor * measured + scale**2 * odometry
                        likelihood[j, k] += _likelihood(off, FEW * variances, 2)
        return float(scales[np.argmax(likelihood.max(axis=0))])


def _twice(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a b^T + b a^T of vectors (n, 3) and (3,), shape (n, 3, 3)."""
    product = a[:, :, None] * b
    result: np.ndarray = product + product.swapaxes(1, 2)
    return result


def _squared(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return the squares of Mahalanobis's distances, (n,), of errors (n, 6)."""
    solved = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    result: np.ndarray = (errors * solved).sum(axis=1)
    return result


def _likelihood(off: np.ndarray, variances: np.ndarray, freedom: float) -> float:
    """Return the logarithm of that of positions and angles by Student's t, each (2, n)."""
    # errors of the heading dominate: they move a position in one direction
    bent = (freedom + 1) / 2 * np.log1p(off**2 / (freedom * variances))
    return -float((bent + np.log(variances) / 2).sum())
