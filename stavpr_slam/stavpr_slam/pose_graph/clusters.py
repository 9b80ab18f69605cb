# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Clusters: closures of successive images that agree with each other and the odometry."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.cycles import Cycles, LIMIT
from stavpr_slam.pose_graph.keyframes import KeyframeChain

STEP = 0.3  # meters between closures that confirm each other


@dataclass(frozen=True)
class ConsistencySettings:
    """
    How closures confirm each other.

    :param gap: meters that the query travels at most between two closures of a cluster.
    :param span: meters that the query travels at most in a cluster.
    :param support: least closures of a cluster that others are compared with.
    :param join_support: least closures that join two sessions.
    :param break_support, break_distance: closures, and meters that the query travels, in each of
        two runs that contradict each other, which prove that the odometry has a break between.
    :param break_gain: closures more that agree if there is a break.
    """

    gap: float = 15.0
    span: float = 20.0
    support: int = 3
    join_support: int = 8
    break_support: int = 32
    break_distance: float = 40.0
    break_gain: int = 24


@dataclass(eq=False)
class Cluster:
    """
    Closures that agree, in the order of the query; ``center`` agrees best with the others.

    :param weight: number of closures at different positions of the query.
    """

    members: list[ResolvedClosure] = field(default_factory=list)
    center: int = 0
    weight: int = 1

    @property
    def representative(self) -> ResolvedClosure:
        """Return the closure that represents the cluster."""
        return self.members[self.center]

    @property
    def independent(self) -> list[ResolvedClosure]:
        """Return the closures whose errors do not correlate; at least the best one."""
        return [each for each in self.members if each.is_independent] or [self.representative]


def ends(clusters: Sequence[Cluster]) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes of the queries and of the places of the representatives, (n,) each."""
    found = [(each.representative.query, each.representative.place) for each in clusters]
    query, place = np.array(found, int).reshape(-1, 2).T
    return query, place


def grow(
    clusters: list[Cluster],
    closure: ResolvedClosure,
    chain: KeyframeChain,
    scale: float,
    settings: ConsistencySettings,
) -> Cluster:
    """
    Add a closure to the cluster that it agrees with, or begin another; return it.

    :param scale: factor on the errors of the odometry.
    """
    for cluster in reversed(clusters):
        last, first = cluster.members[-1], cluster.members[0]
        if closure.at - first.at > settings.gap + settings.span:
            break  # the clusters before are older
        if abs(closure.at - last.at) > settings.gap or closure.at - first.at > settings.span:
            continue
        nodes = [last.query, closure.query, last.place, closure.place]
        session, travelled = chain.session[nodes], chain.travelled[nodes]
        if session[0] != session[1] or session[2] != session[3]:
            continue
        if abs(travelled[3] - travelled[2]) > settings.gap:
            continue  # over a long path, much would agree
        if Cycles(chain, [last, closure]).deviations(0, scale)[1] > LIMIT:
            continue
        cluster.weight += bool(abs(closure.at - last.at) > STEP)
        cluster.members.append(closure)
        cycles = Cycles(chain, cluster.members)
        squared = [cycles.deviations(i, scale).sum() for i in range(len(cluster.members))]
        cluster.center = int(np.argmin(squared))
        return cluster
    clusters.append(Cluster([closure]))
    return clusters[-1]
