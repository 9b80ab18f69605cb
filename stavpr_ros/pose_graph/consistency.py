# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which closures agree with each other: pairwise consistency (PCM) of clusters.

Two closures and the odometry between their ends form a cycle; its transform is the identity up to
the errors of closures and odometry (Mangelson et al., *Pairwise Consistent Measurement Set
Maximization*, ICRA 2018). Closures of successive images that agree are a cluster of at most
:attr:`ConsistencySettings.span` meters; a closure that no neighbor confirms is rejected. Of the
clusters, a set without contradictions and of large weight is accepted.
"""

from dataclasses import dataclass, field

import numpy as np
from stavpr_ros.pose_graph.closures import ResolvedClosure
from stavpr_ros.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_ros.pose_graph.transforms import angles, inverse

LIMIT = 9.0  # squared deviations
SIGNIFICANT = 1.92  # difference of logarithms of likelihoods: 95 %, one degree of freedom
STARTS = 100  # rejected clusters that the search begins with as well
CLOSURE_FACTORS = (0.05, 0.2, 1.0)  # on the covariances of closures that are tried


@dataclass(frozen=True)
class ConsistencySettings:
    """
    How closures confirm each other.

    :param gap: meters that the query travels at most between two closures of a cluster.
    :param span: meters that the query travels at most in a cluster.
    :param support: least closures of a cluster.
    :param join_support: least closures that join two sessions.
    :param break_support, break_distance: closures, and meters that the query travels, in each of
        two runs that contradict each other, which prove that the odometry has a break between.
    """

    gap: float = 15.0
    span: float = 20.0
    support: int = 3
    join_support: int = 8
    break_support: int = 32
    break_distance: float = 40.0


@dataclass(eq=False)
class Cluster:
    """
    Closures that agree, in the order of the query; ``center`` agrees best with the others.

    :param weight: sum of those of closures at different positions of the query.
    """

    members: list[ResolvedClosure] = field(default_factory=list)
    center: int = 0
    weight: float = 0.0

    @property
    def representative(self) -> ResolvedClosure:
        """Return the closure that stands for the cluster."""
        return self.members[self.center]


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
        variances = np.array([np.diag(each.covariance) for each in closures])
        self.angle_variance = variances[:, :3].max(axis=1)
        # planar motion: the two larger of the three
        self.position_variance = np.sort(variances[:, 3:], axis=1)[:, 1:].mean(axis=1)

    def deviations(self, i: int, noise: OdometryNoise) -> np.ndarray:
        """
        Return the squared deviations of the cycles of closure i with all, shape (n,).

        0 where there is no cycle: the ends are in different sessions, splits apart.
        """
        off, measured = self._errors(i)
        squared = (off**2 / (measured + self._odometry(i, noise))).max(axis=0)
        query, place = self.recordings
        same = (query == query[i]) & (place == place[i])
        return np.where(same, squared, 0.0)

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
        # a bias on both ways cancels where the query drives as the place was driven
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
        likelihood = [_likelihood(off, measured + scale**2 * odometry) for scale in scales]
        best = int(np.argmax(likelihood))
        return float(scales[best if likelihood[best] > likelihood[0] + SIGNIFICANT else 0])

    def noise_scale(self, noise: OdometryNoise, scales: np.ndarray) -> float:
        """
        Return the factor on the errors of the odometry that the cycles have most probably.

        Student's t with 4 degrees of freedom: few wrong closures do not decide. The covariances of
        the closures may be too large or too small: the most probable of some factors is taken.
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
                        likelihood[j, k] += _likelihood(off, variances)
        return float(scales[np.argmax(likelihood.max(axis=0))])


def _likelihood(off: np.ndarray, variances: np.ndarray) -> float:
    """Return the logarithm of that of positions and angles by Student's t, each (2, n)."""
    # errors of the heading dominate: they move a position in one direction
    return -float((2.5 * np.log1p(off**2 / (4 * variances)) + np.log(variances) / 2).sum())


def grow(
    clusters: list[Cluster],
    closure: ResolvedClosure,
    chain: KeyframeChain,
    noise: OdometryNoise,
    settings: ConsistencySettings,
) -> Cluster:
    """Add a closure to the cluster that it agrees with, or begin another; return it."""
    for cluster in reversed(clusters):
        last, first = cluster.members[-1], cluster.members[0]
        if closure.at - first.at > settings.gap + settings.span:
            break  # the clusters before are older
        if abs(closure.at - last.at) > settings.gap or closure.at - first.at > settings.span:
            continue
        if chain.session[closure.query] != chain.session[last.query]:
            continue
        if chain.session[closure.place] != chain.session[last.place]:
            continue
        if Cycles(chain, [last, closure]).deviations(0, noise)[1] > LIMIT:
            continue
        cluster.weight += closure.weight * (abs(closure.at - last.at) > 0.3)
        cluster.members.append(closure)
        cycles = Cycles(chain, cluster.members)
        squared = [cycles.deviations(i, noise).sum() for i in range(len(cluster.members))]
        cluster.center = int(np.argmin(squared))
        return cluster
    clusters.append(Cluster([closure], weight=closure.weight))
    return clusters[-1]


class ConsistentSet:
    """The contradictions between clusters, kept as the clusters grow."""

    def __init__(self, settings: ConsistencySettings) -> None:
        self._settings = settings
        self._contradictions = np.zeros((64, 64), bool)  # as if there were no splits

    def update(
        self,
        clusters: list[Cluster],
        changed: set[int],
        chain: KeyframeChain,
        noise: OdometryNoise,
    ) -> None:
        """
        Compare clusters.

        :param changed: numbers of the clusters that are new or have grown.
        """
        n, known = len(clusters), self._contradictions
        if n > len(known):
            self._contradictions = np.zeros((2 * n, 2 * n), bool)
            self._contradictions[: len(known), : len(known)] = known
        if n:
            cycles = Cycles(chain, [cluster.representative for cluster in clusters])
            for i in changed:
                row = cycles.deviations(i, noise) > LIMIT
                self._contradictions[i, :n] = self._contradictions[:n, i] = row

    def conflicts(self, clusters: list[Cluster], session: np.ndarray) -> np.ndarray:
        """
        Return which clusters contradict each other, shape (n, n), bool.

        :param session: of each node; only closures between the same two sessions can.
        """
        edges, n = [cluster.representative for cluster in clusters], len(clusters)
        query = session[[edge.query for edge in edges]]
        place = session[[edge.place for edge in edges]]
        same = (query[:, None] == query) & (place[:, None] == place)
        return self._contradictions[:n, :n] & same

    def accepted(self, clusters: list[Cluster], session: np.ndarray) -> tuple[np.ndarray, float]:
        """Return which clusters are accepted, shape (n,), bool, and their weight."""
        if not clusters:
            return np.zeros(0, bool), 0.0
        weights = np.array([cluster.weight for cluster in clusters])
        chosen = largest_consistent(
            self.conflicts(clusters, session), weights, weights >= self._settings.support
        )
        return chosen, float(weights[chosen].sum())


def largest_consistent(
    conflicts: np.ndarray, weights: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """
    Return a set without conflicts and of large weight.

    Removing those that are most opposed ends in a set that one change may not improve: it is done
    again with each rejected candidate in the set, heavy ones first, and the largest set counts.

    :param conflicts: symmetric, shape (n, n), bool.
    :param weights: shape (n,).
    :param candidates: shape (n,), bool.
    :returns: shape (n,), bool.
    """
    chosen = _without_conflicts(conflicts, weights, candidates)
    rejected = np.flatnonzero(candidates & ~chosen)
    for i in rejected[np.argsort(-weights[rejected], kind='stable')][:STARTS]:
        if not chosen[i]:
            other = _without_conflicts(conflicts, weights, candidates & ~conflicts[i])
            if weights[other].sum() > weights[chosen].sum():
                chosen = other
    return chosen


def _without_conflicts(
    conflicts: np.ndarray, weights: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """
    Return a set without conflicts, shape (n,), bool.

    While there are conflicts, the candidate is removed whose opponents weigh most in relation to
    its own weight; the removed ones without conflicts are added again, heavy ones first.
    """
    chosen = candidates.copy()
    opposed = conflicts @ (weights * chosen).astype(float)
    removed = []
    while True:
        against = np.where(chosen, opposed / np.maximum(weights, 1), 0.0)
        worst = int(np.argmax(against))
        if against[worst] <= 0:
            break
        chosen[worst] = False
        removed.append(worst)
        opposed -= conflicts[worst] * float(weights[worst])
        opposed[np.abs(opposed) < 1e-6] = 0.0
    for i in sorted(removed, key=lambda k: -weights[k]):
        chosen[i] = not (conflicts[i] & chosen).any()
    return chosen
