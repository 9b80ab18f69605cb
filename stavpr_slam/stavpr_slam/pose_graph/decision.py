# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How large the errors of the odometry of drives are, and whether closures are right: by evidence.

Closures are taken that agree with a tight odometry, or with a looser one. Their evidence is the
logarithm of how much more probable they are than by the odometry alone, where each wrong place may
be anywhere on the map. Closures of successive images at successive places are one event, right or
wrong, and count as one closure.
"""

from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.blocks import Blocks, Consensus, NOTHING
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.sessions import Placement

FAR = 1e9  # meters between two sessions


def events(chain: KeyframeChain, query: np.ndarray, place: np.ndarray) -> np.ndarray:
    """
    Return the number of the event of each closure, shape (n,).

    :param query, place: nodes, (n,).
    """
    at = np.stack(
        [chain.travelled[nodes] + FAR * chain.session[nodes] for nodes in (query, place)], 1
    )
    near = KDTree(at).query_pairs(tuning.GAP, np.inf, output_type='ndarray')
    graph = coo_matrix((np.ones(len(near)), near.T), (len(at),) * 2)
    return connected_components(graph, directed=False)[1]


@dataclass(frozen=True, eq=False)
class Decision(Consensus):
    """
    Closures that agree, with factors on the errors of the odometry, and their evidence.

    :param scales: factors on the errors of the odometry of each robot.
    :param blocks: by which it was decided, the last of which has all closures.
    :param evidence: of these closures.
    :param chance: minus the logarithm of the probability to draw these events.
    """

    scales: np.ndarray
    blocks: Blocks
    evidence: float = -math.inf
    chance: float = 0.0

    @property
    def gain(self) -> float:
        """
        Return the evidence that is left beside the number of choices, at least 0.

        Of many events, a few agree at random where the odometry explains everything: their chance
        counts against them, and so does each doubling of the errors in the settings.
        """
        price = tuning.LOOSER * float(np.log2(self.scales.clip(1.0)).sum())
        return max(0.0, self.evidence - self.chance - price)


class Decider:
    """Decides on closures of drives."""

    def __init__(
        self, chain: KeyframeChain, closures: ClosureArrays, placement: Placement
    ) -> None:
        self._graph = self._chain, self._closures, self._placement = chain, closures, placement
        self._events = events(chain, closures.query, closures.place)

    def _representatives(self, chosen: np.ndarray) -> np.ndarray:
        """Return the closure in the middle of each event, (m,)."""
        numbers = np.flatnonzero(chosen)
        at = self._chain.travelled[self._closures.query[numbers]]
        numbers = numbers[np.lexsort((at, self._events[numbers]))]
        _, first, count = np.unique(self._events[numbers], return_index=True, return_counts=True)
        return numbers[first + count // 2]

    def _whole(self, inliers: np.ndarray) -> np.ndarray:
        """Return the inliers of events most closures of which agree, shape (n,), bool."""
        numbers, allowed = self._events, self._placement.allowed
        agree = np.bincount(numbers, inliers) - np.bincount(numbers, allowed & ~inliers)
        return inliers & (agree > 0)[numbers]

    def _chance(self, inliers: np.ndarray) -> float:
        """
        Return minus the logarithm of the probability to draw the events that are taken.

        Events are drawn one by one, each by its number of closures, in any order: of n events of
        one size, k have 1 / binomial(n, k).
        """
        sizes = np.sort(np.unique(self._events[inliers], return_counts=True)[1])[::-1]
        rest = self._placement.allowed.sum() - np.cumsum(sizes) + sizes
        return max(0.0, float(np.log(rest / sizes).sum()) - math.lgamma(len(sizes) + 1))

    def at(self, scales: np.ndarray) -> Decision:
        """
        Decide with an odometry.

        :param scales: factors on its errors, of each robot.
        """
        blocks = Blocks(*self._graph, NOTHING, scales)
        try:
            consensus = blocks.consensus()
            network, inliers = blocks.network, self._whole(consensus.inliers)
            counted = np.isin(blocks.own, self._representatives(inliers))
            information = network.odometry(scales[self._chain.robot])
            values, evidence = network.fit(information, counted, network.values(consensus.nodes))
        except np.linalg.LinAlgError:
            none = np.zeros(len(self._closures), bool)
            return Decision(self._placement.initial, none, NOTHING.beliefs, scales, blocks)
        return Decision(
            network.nodes(values), inliers, consensus.beliefs, scales, blocks, evidence,
            self._chance(inliers),
        )  # fmt: skip

    def add(self, last: Decision) -> Decision:
        """Return the last decision, at the same factors and evidence, with new closures."""
        blocks = Blocks(*self._graph, last, last.scales)
        return replace(last, **vars(blocks.consensus()), blocks=blocks)

    def search(self) -> tuple[Decision, list[Decision]]:
        """
        Decide with a tight odometry, or a looser one for which there is evidence.

        :returns: the best decision, and the ones with equal factors.
        """

        def better(best: Decision, other: Decision) -> Decision:
            return other if other.gain - best.gain > tuning.LOOSER else best

        robots = len(self._chain.robots)
        best = self.at(np.full(robots, tuning.TIGHT))
        trials = [best]
        for scale in tuning.SCALES[1:]:
            trials.append(self.at(np.full(robots, scale)))
            best = better(best, trials[-1])
            if all(trial.gain < best.gain - tuning.LOOSER for trial in trials[-2:]):
                break
        for is_own in np.eye(robots, dtype=bool) if robots > 1 else ():
            for scale in tuning.SCALES:
                best = better(best, self.at(np.where(is_own, scale, best.scales)))
        return best, trials

    def estimate(
        self, decision: Decision, scales: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Estimate the nodes at the errors of the odometry that the closures show.

        All independent closures count, and of other events one closure.

        :param scales: factors as estimated before; None = they are searched.
        :returns: the factors on the errors of each robot, the nodes, and the closures that count,
            shape (n,), bool.
        """
        accepted = decision.inliers
        if not accepted.any():
            return decision.scales, self._placement.initial, accepted
        network = decision.blocks.network
        counted, middle = accepted & self._closures.is_independent, self._representatives(accepted)
        counted[middle[~np.isin(self._events[middle], self._events[counted])]] = True
        own, start = counted[decision.blocks.own], network.values(decision.nodes)

        def fit(factor: float) -> tuple[float, float, np.ndarray]:
            information = network.odometry(factor * decision.scales[self._chain.robot])
            try:
                values, evidence = network.fit(information, own, start)
            except np.linalg.LinAlgError:
                return -math.inf, factor, start
            return evidence, factor, values

        best = fit(1.0 if scales is None else float(scales[0] / decision.scales[0]))
        least = tuning.PRECISE / decision.scales.min()
        for change in (0.5, 2.0) if scales is None else ():
            while least <= best[1] * change < 64:
                trial = fit(best[1] * change)
                if trial[0] <= best[0]:
                    break
                best = trial
        return best[1] * decision.scales, network.nodes(best[2]), counted
