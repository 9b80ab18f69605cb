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

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.odometry import KeyframeChain, OdometryNoise

LIMIT = 16.0  # squared deviations: 99.9 % for motion in a plane, of three dimensions
STARTS = 100  # rejected clusters that the search begins with as well


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
        places = chain.travelled[[last.place, closure.place]]
        if abs(places[1] - places[0]) > settings.gap:
            continue  # over a long way, much would agree
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
        Compare the clusters that have closures enough.

        :param changed: numbers of the clusters that are new or have grown.
        """
        n, known = len(clusters), self._contradictions
        if n > len(known):
            self._contradictions = np.zeros((2 * n, 2 * n), bool)
            self._contradictions[: len(known), : len(known)] = known
        able = [i for i in range(n) if clusters[i].weight >= self._settings.support]
        if able:
            cycles = Cycles(chain, [clusters[i].representative for i in able])
            for number, i in enumerate(able):
                if i in changed:
                    row = cycles.deviations(number, noise) > LIMIT
                    self._contradictions[i, able] = self._contradictions[able, i] = row

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

    def accepted(
        self, clusters: list[Cluster], session: np.ndarray, without: Collection[int] = ()
    ) -> tuple[np.ndarray, float]:
        """
        Return which clusters are accepted, shape (n,), bool, and their weight.

        :param without: numbers of clusters that are not.
        """
        if not clusters:
            return np.zeros(0, bool), 0.0
        weights = np.array([cluster.weight for cluster in clusters])
        candidates = weights >= self._settings.support
        candidates[list(without)] = False
        chosen = largest_consistent(self.conflicts(clusters, session), weights, candidates)
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
