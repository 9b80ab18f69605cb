# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which clusters agree with each other: pairwise consistency (PCM).

Two closures and the odometry between their ends form a cycle, see :mod:`cycles`. Of the clusters,
a set without contradictions and of large weight is accepted.
"""

from collections.abc import Collection, Sequence

import numpy as np
from stavpr_slam.pose_graph.clusters import Cluster, ends
from stavpr_slam.pose_graph.cycles import Cycles, LIMIT
from stavpr_slam.pose_graph.keyframes import KeyframeChain


class ConsistentSet:
    """
    The contradictions between clusters, kept as the clusters grow.

    :param support: least weight of clusters that are compared.
    """

    def __init__(self, support: int) -> None:
        self._support = support
        self._contradictions = np.zeros((64, 64), bool)  # as if there were no splits

    def update(
        self, clusters: list[Cluster], changed: Collection[int], chain: KeyframeChain, scale: float
    ) -> None:
        """
        Compare the clusters that have closures enough.

        :param changed: numbers of the clusters that are new or have grown.
        :param scale: factor on the errors of the odometry.
        """
        n, known = len(clusters), self._contradictions
        if n > len(known):
            self._contradictions = np.zeros((2 * n, 2 * n), bool)
            self._contradictions[: len(known), : len(known)] = known
        able = [i for i in range(n) if clusters[i].weight >= self._support]
        if able:
            cycles = Cycles(chain, [clusters[i].representative for i in able])
            for number, i in enumerate(able):
                if i in changed:
                    row = cycles.deviations(number, scale) > LIMIT
                    self._contradictions[i, able] = self._contradictions[able, i] = row

    def conflicts(self, clusters: Sequence[Cluster], session: np.ndarray) -> np.ndarray:
        """
        Return which clusters contradict each other, shape (n, n), bool.

        :param session: of each node; only closures between the same two sessions can.
        """
        query, place = (session[nodes] for nodes in ends(clusters))
        same = (query[:, None] == query) & (place[:, None] == place)
        return self._contradictions[: len(query), : len(query)] & same

    def accepted(
        self, clusters: Sequence[Cluster], session: np.ndarray, without: Collection[int] = ()
    ) -> tuple[np.ndarray, int]:
        """
        Return which clusters are accepted, shape (n,), bool, and their weight.

        :param without: numbers of clusters that are not.
        """
        weights = np.array([cluster.weight for cluster in clusters], int)
        candidates = weights >= self._support
        candidates[list(without)] = False
        chosen = largest_consistent(self.conflicts(clusters, session), weights, candidates)
        return chosen, int(weights[chosen].sum())


def largest_consistent(
    conflicts: np.ndarray, weights: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """
    Return a set without conflicts and of large weight.

    While there are conflicts, the candidate is removed whose opponents weigh most in relation to
    its own weight; the removed ones without conflicts are added again, heavy ones first.

    :param conflicts: symmetric, shape (n, n), bool.
    :param weights: shape (n,), int.
    :param candidates: shape (n,), bool.
    :returns: shape (n,), bool.
    """
    chosen = candidates.copy()
    opposed = conflicts @ (weights * chosen)
    removed = []
    while (against := np.where(chosen, opposed / weights, 0.0)).any():
        worst = int(np.argmax(against))
        chosen[worst] = False
        removed.append(worst)
        opposed -= conflicts[worst] * weights[worst]
    for i in sorted(removed, key=lambda k: -weights[k]):
        chosen[i] = not (conflicts[i] & chosen).any()
    return chosen
