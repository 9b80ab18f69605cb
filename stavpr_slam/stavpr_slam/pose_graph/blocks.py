# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Graphs of other programs: closures come in blocks by time, each decided from the last solution.

The odometry goes ahead of the closures, and each closure is an event of its own. One is right if
that is more probable than a place anywhere on the map, by the errors of the solution at both ends
and the part of all closures that are right: certain ones first, then those that agree with them.
The errors that the file states are right up to a factor, which the closures show.
"""

from dataclasses import dataclass
import math

import numpy as np
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.network import Network
from stavpr_slam.pose_graph.sessions import extended, few, Pair, place, Placement
from stavpr_slam.pose_graph.solution import Solution
from stavpr_slam.pose_graph.solver import likelihoods, scaled, squares

PASSES = False, True  # over the closures of a block: again for rejected ones that agree by now
Found = tuple[np.ndarray, np.ndarray]  # which closures agree, (n,), and the variables


class Beliefs:
    """
    What is known of n closures, and of the errors that the file states.

    :param space: logarithm of the poses of the map, see :attr:`Network.room`.
    :param innovations: of each closure when it was compared with a solution at last, see
        :meth:`Solver.innovations`, in errors with the factor of the odometry.
    """

    def __init__(self, space: float, innovations: np.ndarray) -> None:
        self.space, self.innovations = space, innovations
        self.factor = 1.0  # on the errors that the file states
        self.prior = 0.0  # logarithm of the odds that a closure is right
        self.searched = 0  # closures of the last search

    def grown(self, space: float, count: int) -> 'Beliefs':
        """Return a copy for a number of closures, and another map."""
        result, known = Beliefs(space, unknown(count, self.innovations.shape[1])), self.innovations
        result.innovations[: len(known)] = known[:count]
        result.factor, result.prior, result.searched = self.factor, self.prior, self.searched
        return result

    def odds(self, rows: np.ndarray) -> np.ndarray:
        """Return the logarithm of the odds that closures are right, by their innovations."""
        return self.prior + self.space + likelihoods(rows)

    def show(self, rows: np.ndarray, factors: np.ndarray) -> None:
        """Search the factor on all errors, in parts of the last one."""
        tried = [1.0, *factors]
        densities = np.array([likelihoods(scaled(rows, factor)) for factor in tried])
        factor = float(tried[self._best(densities)])
        self.innovations = scaled(self.innovations, factor)
        self.factor *= factor

    def _best(self, densities: np.ndarray) -> int:
        """Return the best of k alternatives, the first of which needs no evidence, (k, n)."""
        ratio, prior = np.exp((densities + self.space).clip(-50, 50)), np.array([[0.5]])
        for _ in range(tuning.MAX_STEPS):  # the part of the closures that are right
            right = prior * ratio / (prior * ratio + 1 - prior)
            prior = (right.sum(axis=1, keepdims=True) + 1) / (ratio.shape[1] + 2)
        evidence = np.log(prior * ratio + 1 - prior).sum(axis=1)
        # many false ones nearby fit large errors, but without being certain
        is_certain = evidence >= tuning.CERTAIN * right.sum(axis=1)
        evidence[1:] = np.where(is_certain, evidence - tuning.LOOSER, -np.inf)[1:]
        best = int(np.argmax(evidence))
        self.prior = math.log(prior[best, 0] / (1 - prior[best, 0]))
        return best


@dataclass(frozen=True, eq=False)
class MeasuredSolution(Solution):
    """The nodes of a graph of another program, and what is known of its closures."""

    beliefs: Beliefs


def unknown(count: int, width: int) -> np.ndarray:
    """Return innovations of closures that were not compared yet: none is probable."""
    result = np.zeros((count, width))
    result[:, -1] = np.inf
    return result


def added(chain: KeyframeChain, closures: ClosureArrays, last: Solution) -> Solution:
    """
    Add new closures to the last solution, in blocks by time.

    :param last: of the first of the closures; :data:`NOTHING` = all are new.
    """
    denied = set[Pair]()
    while True:
        found = _Blocks(chain, closures, last, place(chain, closures, denied)).solution()
        pairs = few(chain, closures[found.accepted], found.placement)
        if not pairs:
            return found
        denied |= pairs


class _Blocks:
    """Adds closures in blocks."""

    def __init__(
        self, chain: KeyframeChain, closures: ClosureArrays, last: Solution, placement: Placement
    ) -> None:
        self._chain, self._closures, self._placement = chain, closures, placement
        self._latest = np.maximum(closures.query, closures.place)
        count, self._known, self._nodes = len(closures), len(last.accepted), last.nodes
        self._taken = np.zeros(count, bool)
        self._taken[: self._known] = last.accepted & placement.allowed[: self._known]
        network = Network(chain, placement.initial, closures, placement.links)
        before = Beliefs(network.room, unknown(0, 2 * network.freedom + 1))
        if isinstance(last, MeasuredSolution):
            before = last.beliefs
        self._beliefs = before.grown(network.room, count)
        self._searches = count > 0 and count >= tuning.SEARCH * before.searched
        if self._searches:
            alone = self._apart(np.arange(count))
            alone = alone[
                chain.session[closures.query[alone]] == chain.session[closures.place[alone]]
            ]
            network.residuals(self._information(network), network.values(placement.initial))
            rows = network.beside_odometry(alone)
            new = alone >= self._known
            self._beliefs.innovations[alone[new]] = rows[new]
            self._beliefs.show(rows, tuning.FACTORS / self._beliefs.factor)
            self._beliefs.searched = count

    def _information(self, network: Network) -> np.ndarray:
        factor = self._beliefs.factor
        return network.odometry(np.full(len(self._chain), factor), factor)

    def _apart(self, numbers: np.ndarray) -> np.ndarray:
        """Return closures of which neighboring nodes have one: groups may be wrong together."""
        found = np.unique(self._latest[numbers] // tuning.LONGEST, return_index=True)[1]
        return np.asarray(numbers[found])

    def solution(self) -> Solution:
        """Return the solution with all closures."""
        count, seen = len(self._chain), np.arange(len(self._taken)) < self._known
        step, is_whole = max(1, count // tuning.BLOCKS), not self._known
        for end in (*range(len(self._nodes) + step, count, step), count):
            part = self._chain.until(end)
            self._nodes = extended(part, self._nodes, self._placement)
            came = self._placement.allowed & (self._latest < end)
            if (came & ~seen).any() or (is_whole and end == count):
                self._decide(part, np.flatnonzero(came), ~seen[came], is_whole and end == count)
            seen |= came
        scales = np.full(len(self._chain.robots), self._beliefs.factor)
        return MeasuredSolution(
            self._nodes, self._taken, self._taken, scales, self._placement, self._beliefs
        )

    def _decide(self, part: KeyframeChain, own: np.ndarray, new: np.ndarray, swaps: bool) -> None:
        """
        Decide on the closures of a block.

        :param own: numbers of all closures up to its end.
        :param new: those of them that are new, bool.
        :param swaps: leave out weak ones on trial.
        """
        beliefs = self._beliefs
        network = Network(part, self._nodes, self._closures[own], self._placement.links)
        network.limit, network.room = network.limit * tuning.TAILS, beliefs.space
        values, taken = network.values(self._nodes), self._taken[own]
        information = self._information(network)
        away = network.residuals(information, values)
        for again in PASSES:
            rows = beliefs.innovations[own]
            if again:
                near = away < network.limit
                fits = squares(rows) <= network.limit
                new = ~taken & (near | (fits & (beliefs.odds(rows) > 0)))
            if not new.any():
                break
            rows[new] = network.innovations(taken, np.flatnonzero(new))
            beliefs.innovations[own] = rows
            if self._searches:
                compared = self._apart(np.flatnonzero(np.isfinite(beliefs.innovations[:, -1])))
                factors = tuning.FACTORS[tuning.FACTORS < 1]
                beliefs.show(beliefs.innovations[compared], 1 / factors)
                information, rows = self._information(network), beliefs.innovations[own]
            passes = new & (squares(rows) <= network.limit)
            passes &= beliefs.odds(rows) > (0 if again else tuning.CERTAIN)
            passes |= new & network.joining(taken)
            if not passes.any():
                continue
            agree, values = self._consistent(network, information, values, taken | passes)
            agree, values = self._certain(network, information, values, agree, own)
            away = network.residuals(information, values)
            if (agree == taken).all():
                break
            taken = agree
        if swaps and taken.any():
            taken, values = self._swapped(network, information, values, taken, own)
        self._taken[own], self._nodes = taken, network.nodes(values)

    def _consistent(
        self, network: Network, information: np.ndarray, values: np.ndarray, among: np.ndarray
    ) -> Found:
        """Solve for closures, without those that contradict others."""
        moved, _, _ = network.solve(information, values, among * 1.0)
        agree = among & (network.residuals(information, moved) <= network.limit)
        if (agree != among).any():
            moved, _, _ = network.solve(information, moved, agree * 1.0)
        return agree, moved

    def _certain(
        self, network: Network, information: np.ndarray, values: np.ndarray, agree: np.ndarray,
        own: np.ndarray,
    ) -> Found:  # fmt: skip
        """
        Leave out, one by one, closures that are less probable than a place anywhere.

        A false one may have a small residual: it bends the odometry, and without it is far away.
        """
        beliefs = self._beliefs
        while agree.any():
            chosen = np.flatnonzero(agree)
            odds = beliefs.odds(beliefs.innovations[own[chosen]])
            chosen = chosen[np.argsort(odds)[: tuning.WEAKEST]]
            network.residuals(information, values)
            rows = beliefs.innovations[own[chosen]] = network.innovations(agree, chosen)
            odds = beliefs.odds(rows)
            if odds.min() >= 0:
                break
            agree = agree & (np.arange(len(agree)) != chosen[np.argmin(odds)])
            values, _, _ = network.solve(information, values, agree * 1.0)
        return agree, values

    def _swapped(
        self, network: Network, information: np.ndarray, values: np.ndarray, taken: np.ndarray,
        own: np.ndarray,
    ) -> Found:  # fmt: skip
        """Leave out a weak closure and those beside it, for others, where that is evidence."""
        beliefs, numbers = self._beliefs, np.arange(len(taken))
        _, evidence = network.fit(information, taken, values)
        odds = beliefs.odds(beliefs.innovations[own])
        for weak in np.argsort(np.where(taken, odds, np.inf))[: tuning.WEAKEST]:
            away = np.abs([each - each[weak] for each in (network.query, network.place)])
            others = away.max(axis=0) >= tuning.LONGEST
            trial = taken & others
            new = numbers[others & ~taken]
            new = new[np.argsort(-odds[new])[: tuning.PLAUSIBLE]]
            if not taken[weak] or not len(new):
                continue
            moved, _, _ = network.solve(information, values, trial * 1.0)
            network.residuals(information, moved)
            rows = network.innovations(trial, new)
            fits = (squares(rows) <= network.limit) & (beliefs.odds(rows) > 0)
            trial |= np.isin(numbers, new[fits])
            trial, moved = self._consistent(network, information, moved, trial)
            moved, found = network.fit(information, trial, moved)
            if found > evidence:
                taken, values, evidence = trial, moved, found
        return taken, values
