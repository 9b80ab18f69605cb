# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which loop closures are right, and how large the errors of the odometry are: by evidence.

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
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.network import Network

# Chosen on KITTI 00 and 08 and a world of the demonstration; docs/slam.md has half and double.
TIGHT = 0.125  # factor on the errors of the odometry that it is trusted by at first
SCALES = TIGHT * 2.0 ** np.arange(6)  # those that evidence can loosen it to: up to 4
PRECISE = TIGHT / 16  # the smallest one of a solution; for measured graphs, by evidence
CERTAIN = math.log(20)  # evidence from which a correction is published
LOOSENED = math.log(100)  # evidence from which the odometry is trusted less
DOUBLED = math.log(20)  # evidence for each doubling of its errors beyond the settings
AGAIN = 0.01  # parameter of graduated non-convexity: residuals of ten deviations count a little
MAX_TRIED = 50  # closures that are tried one by one
DROPPED = 20  # that deviate most and are left out one by one
STRAINED = 100.0  # squared deviations of a part of the odometry that may be a break
GAP = 15.0  # meters that queries and places of an event are apart at most
FAR = 1e9  # meters between two sessions


def events(chain: KeyframeChain, query: np.ndarray, place: np.ndarray) -> np.ndarray:
    """
    Return the number of the event of each closure, shape (n,).

    :param query, place: nodes, (n,).
    """
    at = np.stack(
        [chain.travelled[each] + FAR * chain.session[each] for each in (query, place)], 1
    )
    near = (
        KDTree(at).query_pairs(GAP, np.inf, output_type='ndarray')
        if len(at)
        else np.zeros((0, 2), int)
    )
    graph = coo_matrix((np.ones(len(near)), near.T), (len(at),) * 2)
    numbers: np.ndarray = connected_components(graph, directed=False)[1]
    return numbers


@dataclass(frozen=True, eq=False)
class Decision:
    """
    Which closures are right.

    :param taken: shape (n,), bool.
    :param scales: factors on the errors of the odometry of each robot.
    :param evidence: of the closures that are taken; 0 = none are.
    :param rejected: evidence against a correction that is not published; 0 = there is none.
    :param values: the variables.
    :param agreeing, corrected: the closures, and the variables, of the robust solution, whether
        it is published or not.
    :param strained: node behind the part of the odometry that it bends most; -1 = none.
    :param chance: minus the logarithm of the probability to draw these events.
    """

    taken: np.ndarray
    scales: np.ndarray
    evidence: float
    rejected: float
    values: np.ndarray
    agreeing: np.ndarray
    corrected: np.ndarray
    strained: int = -1
    chance: float = 0.0


class Decider:
    """Decides on the closures of a network."""

    def __init__(
        self, chain: KeyframeChain, network: Network, initial: np.ndarray, measured: bool
    ) -> None:
        self._chain, self._network, self._measured = chain, network, measured
        self._start = network.values(initial)
        count = len(network.query)
        self._events = (
            np.arange(count) if measured else events(chain, network.query, network.place)
        )
        size = np.maximum(np.sort(np.ptp(initial[:, :3, 3], axis=0)), 1.0)
        space = size[1:].prod() * 2 * math.pi
        if network.freedom == 6:
            space = size.prod() * 8 * math.pi**2
        self._room = math.log(space) - network.freedom / 2 * math.log(2 * math.pi)
        self._precise = np.linalg.slogdet(network.information)[1] / 2

    def odometry(self, scales: np.ndarray) -> np.ndarray:
        """Return the information of all factors at factors on the errors of each robot."""
        closures = float(scales.min()) if self._measured else 1.0
        return self._network.odometry(scales[self._chain.robot], closures)

    def representatives(self, taken: np.ndarray) -> np.ndarray:
        """Return the closure in the middle of each event, (m,)."""
        numbers, found = np.flatnonzero(taken), []
        at = self._chain.travelled[self._network.query]
        for event in np.unique(self._events[taken]):
            own = numbers[self._events[numbers] == event]
            found.append(own[np.argsort(at[own], kind='stable')[len(own) // 2]])
        return np.array(found, int)

    def _evidence(self, odometry: np.ndarray, taken: np.ndarray, values: np.ndarray) -> float:
        network, own = self._network, self.representatives(taken)
        weights = np.zeros(len(taken))
        weights[own] = 1.0
        _, squared, determinant = network.solve(odometry, values, weights)
        found = network.log_determinant - determinant - squared / 2
        found += float(self._precise[own].sum()) + len(own) * self._room
        # a session may begin anywhere in the same space
        return found - network.joined(own) * (self._room + network.loose_determinant)

    def _chance(self, taken: np.ndarray) -> float:
        """
        Return minus the logarithm of the probability to draw the events that are taken.

        Events are drawn one by one, each by its number of closures, in any order: of n events of
        one size, k have 1 / binomial(n, k).
        """
        sizes = np.sort(np.bincount(self._events[taken]))[::-1]
        sizes = sizes[sizes > 0]
        rest = len(taken) - np.cumsum(sizes) + sizes
        return max(0.0, float(np.log(rest / sizes).sum()) - math.lgamma(len(sizes) + 1))

    def _improved(
        self, odometry: np.ndarray, taken: np.ndarray, values: np.ndarray, adds: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Add and leave out closures, one by one, where that is evidence.

        A false closure with a large deviation agrees with many paths, and bends the odometry: it
        is less probable than a place anywhere on the map. A right one at the end of a long path is
        far away before others are added.

        :param adds: closures in the order of the drive, unless there are many.
        """
        network, taken = self._network, taken.copy()

        def solved(values: np.ndarray) -> tuple[np.ndarray, float]:
            values, squared, determinant = network.solve(odometry, values, taken * 1.0)
            found = float(self._precise[taken].sum()) + taken.sum() * self._room
            return values, found - determinant - squared / 2

        while True:
            values, before = solved(values)
            rejected, deviating = np.flatnonzero(~taken), np.flatnonzero(taken)
            rejected = rejected[: len(rejected) * (adds and len(rejected) <= MAX_TRIED)]
            rejected = rejected[np.argsort(np.maximum(network.query, network.place)[rejected])]
            deviating = deviating[np.argsort(-network.residuals(odometry, values)[deviating])][
                :DROPPED
            ]
            changed = False
            for number in [*rejected, *deviating]:
                taken[number] = not taken[number]
                try:
                    moved, found = solved(values)
                except np.linalg.LinAlgError:
                    found = -math.inf
                if found > before:
                    values, before, changed = moved, found, True
                else:
                    taken[number] = not taken[number]
            if not changed:
                return taken, values

    def at(self, scales: np.ndarray, near: Decision | None = None) -> Decision:
        """
        Decide with an odometry.

        :param scales: factors on its errors, of each robot.
        :param near: a decision with a tighter one, to begin at where the odometry is too far off,
            and to search thoroughly.
        """
        network = self._network
        odometry = network.odometry(scales[self._chain.robot])
        none, start = np.zeros(len(network.query), bool), self._start
        try:
            try:
                taken, values = network.robust(odometry, start)
            except np.linalg.LinAlgError:
                if near is None:
                    raise
                taken, values = network.robust(odometry, near.corrected, AGAIN)
            evidence = self._evidence(odometry, taken, values) if taken.any() else 0.0
            tried = []
            if taken.any():  # closures beside them may agree by now
                tried.append(network.robust(odometry, values, AGAIN))
            if self._measured and near is not None and scales.min() >= 1:
                tried += [
                    self._improved(odometry, *each, True) for each in (*tried, (none, start))
                ]
            for more, moved in tried:
                found = self._evidence(odometry, more, moved) if more.any() else 0.0
                is_better = found > evidence
                if not self._measured:
                    is_better = more.sum() > taken.sum() and found > evidence - CERTAIN
                if is_better:
                    taken, values, evidence = more, moved, found
        except np.linalg.LinAlgError:
            return Decision(none, scales, 0.0, math.inf, start, none, start)
        joins = network.joined(np.flatnonzero(taken))
        node, squared = network.most_strained(odometry, values)
        strained = node if squared > STRAINED else -1
        if evidence < CERTAIN - joins * (CERTAIN + network.limit):
            return Decision(none, scales, 0.0, -evidence, start, taken, values, strained)
        chance = self._chance(taken)
        return Decision(taken, scales, evidence, 0.0, values, taken, values, strained, chance)

    def decide(self, robots: int) -> Decision:
        """Decide with a tight odometry, or a looser one for which there is evidence."""
        best = self.at(np.full(robots, TIGHT))
        if self._measured:
            best = self._better(best, self.at(np.full(robots, PRECISE)))
        self.tried = [best]
        for scale in SCALES[1 : 4 if self._measured else None]:
            self.tried.append(self.at(np.full(robots, scale), self.tried[-1]))
            best = self._better(best, self.tried[-1])
            if all(each.evidence < best.evidence - LOOSENED for each in self.tried[-2:]):
                break
        for robot in range(robots) if robots > 1 else ():
            for scale in SCALES:
                changed = np.where(np.arange(robots) == robot, scale, best.scales)
                best = self._better(best, self.at(changed))
        return best

    def _better(self, best: Decision, other: Decision) -> Decision:
        """
        Return another decision if there is evidence for its odometry, else the best one.

        Of many events, some agree at random where the odometry explains everything: the number of
        choices counts against both, and so does each doubling of the errors in the settings.
        """

        def gain(decision: Decision) -> float:
            doublings = np.log2(decision.scales.clip(1.0)).sum()
            return decision.evidence - decision.chance - DOUBLED * float(doublings)

        return other if gain(other) - max(gain(best), 0.0) > LOOSENED else best

    def counted(self, taken: np.ndarray, independent: np.ndarray) -> np.ndarray:
        """
        Return which of the closures that are taken count in an estimate, shape (n,), bool.

        :param independent: closures whose errors do not correlate, shape (n,), bool; of other
            events one closure counts.
        """
        if self._measured:
            return taken
        counted = taken & independent
        for number in self.representatives(taken):
            if not (counted & (self._events == self._events[number])).any():
                counted[number] = True
        return counted

    def solved(
        self, scales: np.ndarray, values: np.ndarray, counted: np.ndarray
    ) -> tuple[np.ndarray, float, float]:
        """Estimate the variables with the closures that count, as :meth:`Network.solve`."""
        return self._network.solve(self.odometry(scales), values, counted * 1.0)

    def estimate(
        self, decision: Decision, independent: np.ndarray, searches: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Estimate the variables at the errors of the odometry that the closures show.

        :param independent: as in :meth:`counted`.
        :param searches: leave out closures that are less probable than a place anywhere.
        :returns: the factors on the errors of each robot, the variables, and the closures that
            count, shape (n,), bool.
        """
        if self._measured:
            scales = (decision.scales / TIGHT).clip(max=1.0)
            odometry = self.odometry(scales)
            taken, values = self._network.robust(odometry, decision.values, AGAIN)
            if searches:
                self._precise -= self._network.freedom * math.log(scales.min())
                taken, values = self._improved(odometry, taken, values, False)
            return scales, values, taken
        counted = self.counted(decision.taken, independent)

        def solved(factor: float) -> tuple[float, float, np.ndarray]:
            network = self._network
            values, squared, determinant = self.solved(
                factor * decision.scales, decision.values, counted
            )
            return network.log_determinant - determinant - squared / 2, factor, values

        best, least = solved(1.0), PRECISE / decision.scales.min()
        for change in (0.5, 2.0):
            while best[1] * change >= least and best[1] * change < 64:
                found = solved(best[1] * change)
                if found[0] <= best[0]:
                    break
                best = found
        return best[1] * decision.scales, best[2], counted
