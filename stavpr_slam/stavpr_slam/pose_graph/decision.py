# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Decide which loop closures are right, and how large the errors of the odometry are: by evidence.

A robust solution at a tight odometry decides over all closures, so that the result does not
depend on their order. Its evidence is the logarithm of how much more probable the closures are
than by the odometry alone, where each wrong place may be anywhere on the map. Closures of
successive images at successive places are one event, right or wrong, and count as one closure.
"""

from dataclasses import dataclass
import math

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.network import Network

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
    numbers: np.ndarray = connected_components(graph, directed=False)[1]
    return numbers


@dataclass(frozen=True, eq=False)
class Decision:
    """
    Closures that agree, with factors on the errors of the odometry, and their evidence.

    :param scales: factors on the errors of the odometry of each robot.
    :param inliers, values: closures of the robust solution, shape (n,), bool, and its variables.
    :param evidence: of these closures.
    :param least: evidence from which the solution is published.
    :param bend: node behind the part of the odometry that it bends most; -1 = none.
    :param chance: minus the logarithm of the probability to draw these events.
    """

    scales: np.ndarray
    inliers: np.ndarray
    values: np.ndarray
    evidence: float
    least: float = 0.0
    bend: int = -1
    chance: float = 0.0

    @property
    def is_published(self) -> bool:
        """Return whether there is evidence for the solution."""
        return self.evidence >= self.least

    @property
    def accepted(self) -> np.ndarray:
        """Return whether each closure is right, shape (n,), bool; without evidence none is."""
        return self.inliers & self.is_published

    @property
    def gain(self) -> float:
        """
        Return the evidence that is left beside the number of choices, at least 0.

        Of many events, a few agree at random where the odometry explains everything: their chance
        counts against them, and so does each doubling of the errors in the settings.
        """
        price = tuning.LOOSER * float(np.log2(self.scales.clip(1.0)).sum())
        return max(0.0, self.evidence - self.chance - price) * self.is_published


class Decider:
    """Decides on the closures of a network."""

    def __init__(self, chain: KeyframeChain, network: Network, initial: np.ndarray) -> None:
        self._chain, self._network = chain, network
        self._start = network.values(initial)
        self._events = events(chain, network.query, network.place)

    def information(self, scales: np.ndarray) -> np.ndarray:
        """Return the information of all factors at factors on the errors of each robot."""
        return self._network.odometry(scales[self._chain.robot])

    def representatives(self, chosen: np.ndarray) -> np.ndarray:
        """Return the closure in the middle of each event, (m,)."""
        numbers = np.flatnonzero(chosen)
        at = self._chain.travelled[self._network.query[numbers]]
        numbers = numbers[np.lexsort((at, self._events[numbers]))]
        _, first, count = np.unique(self._events[numbers], return_index=True, return_counts=True)
        middle: np.ndarray = numbers[first + count // 2]
        return middle

    def thin(self, chosen: np.ndarray, independent: np.ndarray) -> np.ndarray:
        """
        Return which of the closures that are taken count in an estimate, shape (n,), bool.

        :param independent: closures whose errors do not correlate, shape (n,), bool; of other
            events one closure counts.
        """
        result, own = chosen & independent, self.representatives(chosen)
        result[own[~np.isin(self._events[own], self._events[result])]] = True
        return result

    def _evidence(self, information: np.ndarray, inliers: np.ndarray, values: np.ndarray) -> float:
        """Return the evidence of closures, of which one of each event counts."""
        counted = np.zeros_like(inliers)
        counted[self.representatives(inliers)] = True
        return self._network.fit(information, counted, values)[1]

    def _chance(self, inliers: np.ndarray) -> float:
        """
        Return minus the logarithm of the probability to draw the events that are taken.

        Events are drawn one by one, each by its number of closures, in any order: of n events of
        one size, k have 1 / binomial(n, k).
        """
        sizes = np.sort(np.unique(self._events[inliers], return_counts=True)[1])[::-1]
        rest = len(inliers) - np.cumsum(sizes) + sizes
        return max(0.0, float(np.log(rest / sizes).sum()) - math.lgamma(len(sizes) + 1))

    def at(self, scales: np.ndarray) -> Decision:
        """
        Decide with an odometry.

        :param scales: factors on its errors, of each robot.
        """
        network = self._network
        information = self.information(scales)
        none, start = np.zeros(len(network.query), bool), self._start
        try:
            inliers, values = network.robust(information, start)
            evidence = self._evidence(information, inliers, values)
            if inliers.any():  # closures beside them may agree by now
                trial, trial_values = network.robust(information, values, tuning.AGAIN)
                trial_evidence = self._evidence(information, trial, trial_values)
                if trial_evidence > evidence and trial.sum() > inliers.sum():
                    inliers, values, evidence = trial, trial_values, trial_evidence
        except np.linalg.LinAlgError:
            return Decision(scales, none, start, -math.inf)
        joins = network.count_joins(np.flatnonzero(inliers))
        node, deviation = network.most_strained(information, values)
        least = tuning.CERTAIN - joins * (tuning.CERTAIN + network.limit)
        return Decision(
            scales, inliers, values, evidence, least,
            node if deviation > tuning.STRAINED else -1, self._chance(inliers),
        )  # fmt: skip

    def decide(self, robots: int) -> tuple[Decision, list[Decision]]:
        """
        Decide with a tight odometry, or a looser one for which there is evidence.

        :returns: the best decision, and the ones with equal factors.
        """

        def better(best: Decision, other: Decision) -> Decision:
            return other if other.gain - best.gain > tuning.LOOSER else best

        best = self.at(np.full(robots, tuning.TIGHT))
        trials = [best]
        for scale in tuning.SCALES[1:]:
            trials.append(self.at(np.full(robots, scale)))
            best = better(best, trials[-1])
            if best.is_published and all(
                trial.evidence < best.evidence - tuning.LOOSER for trial in trials[-2:]
            ):
                break
        for robot in range(robots) if robots > 1 else ():
            for scale in tuning.SCALES:
                other = np.where(np.arange(robots) == robot, scale, best.scales)
                best = better(best, self.at(other))
        return best, trials

    def estimate(
        self, decision: Decision, independent: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Estimate the variables at the errors of the odometry that the closures show.

        :param independent: as in :meth:`thin`.
        :returns: the factors on the errors of each robot, the variables, and the closures that
            count, shape (n,), bool.
        """
        counted = self.thin(decision.accepted, independent)

        def fit(factor: float) -> tuple[float, float, np.ndarray]:
            information = self.information(factor * decision.scales)
            try:
                values, evidence = self._network.fit(information, counted, decision.values)
            except np.linalg.LinAlgError:
                return -math.inf, factor, decision.values
            return evidence, factor, values

        best, least = fit(1.0), tuning.PRECISE / decision.scales.min()
        for change in (0.5, 2.0):
            while least <= best[1] * change < 64:
                trial = fit(best[1] * change)
                if trial[0] <= best[0]:
                    break
                best = trial
        return best[1] * decision.scales, best[2], counted
