# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which closures agree: they come in blocks by time, each decided from the last solution.

The odometry goes ahead of the closures. A closure is right if that is 20 times as probable as a
place anywhere on the map, by the errors of the solution at both ends; it is left out where that is
no longer probable. In graphs of other programs the part of all closures that are right counts as
well, and the errors that the file states are right up to a factor, which the closures show.
"""

from dataclasses import dataclass, replace
import math

import numpy as np
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.network import freedom_of, Network, room
from stavpr_slam.pose_graph.sessions import extend, Placement
from stavpr_slam.pose_graph.solver import likelihoods, scale_errors, squares

PASSES = False, True  # over the closures of a block: again for those that agree by now
Inliers = tuple[np.ndarray, np.ndarray]  # which closures agree, (n,), and the variables


@dataclass(frozen=True, eq=False)
class Beliefs:
    """
    Evidence on n closures, and on the errors that the file states.

    :param space: logarithm of the poses of the map, :attr:`Network.room`.
    :param innovations: of each closure when it was compared with a solution at last, see
        :meth:`Solver.innovations`, in errors with the factor of the odometry.
    :param factor: on the errors that the file states.
    :param prior: logarithm of the odds that a closure is right.
    :param search_count: closures of the last search of the factor.
    """

    space: float
    innovations: np.ndarray
    factor: float = 1.0
    prior: float = 0.0
    search_count: int = 0

    def resize(self, space: float, count: int) -> 'Beliefs':
        """Return a copy for a number of closures, of which new ones are improbable."""
        rows = np.zeros((count, self.innovations.shape[1]))
        rows[:, -1] = np.inf
        rows[: len(self.innovations)] = self.innovations[:count]
        return replace(self, space=space, innovations=rows)

    def odds(self, rows: np.ndarray) -> np.ndarray:
        """Return the logarithm of the odds that closures are right, by their innovations."""
        return self.prior + self.space + likelihoods(rows)

    def search_factor(self, rows: np.ndarray, runs: np.ndarray, factors: np.ndarray) -> 'Beliefs':
        """
        Return these with the best factor on all errors, in parts of the last one.

        :param rows: innovations of closures.
        :param runs: numbers of their runs of nodes; all closures of a run count as one.
        """
        weights = weights_in_runs(runs)
        factors = np.array([1.0, *factors])
        densities = np.array([likelihoods(scale_errors(rows, factor)) for factor in factors])
        ratio, prior = np.exp((densities + self.space).clip(-50, 50)), np.array([[0.5]])
        for _ in range(tuning.MAX_STEPS):  # the part of the closures that are right
            right = prior * ratio / (prior * ratio + 1 - prior)
            prior = ((right @ weights)[:, None] + 1) / (weights.sum() + 2)
        evidence = np.log(prior * ratio + 1 - prior) @ weights
        # many false ones nearby fit large errors without being certain, and one fits by chance
        is_certain = evidence >= tuning.CERTAIN * (right @ weights).clip(tuning.JOINS / 2)
        evidence[1:] = np.where(is_certain, evidence - tuning.LOOSER, -np.inf)[1:]
        best = int(np.argmax(evidence))
        return replace(
            self, innovations=scale_errors(self.innovations, factors[best]),
            factor=float(self.factor * factors[best]),
            prior=math.log(prior[best, 0] / (1 - prior[best, 0])),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Consensus:
    """
    Closures that agree with the odometry, at some errors of it.

    :param nodes: transforms in the map, (N, 4, 4).
    :param inliers: which of n closures agree, (n,), bool.
    """

    nodes: np.ndarray
    inliers: np.ndarray
    beliefs: Beliefs


NOTHING = Consensus(np.zeros((0, 4, 4)), np.zeros(0, bool), Beliefs(0.0, np.zeros((0, 0))))
"""Of a graph without odometry."""


def weights_in_runs(runs: np.ndarray) -> np.ndarray:
    """Return weights by which all closures of a run of nodes count as one, (n,)."""
    numbers = np.unique(runs, return_inverse=True)[1]
    return np.asarray(1 / np.bincount(numbers)[numbers])


def are_certain(odds: np.ndarray, runs: np.ndarray) -> bool:
    """Return whether closures are certain together, where a run counts as one, by their odds."""
    return bool(weights_in_runs(runs) @ odds > tuning.CERTAIN)


class Blocks:
    """
    Adds closures to the last ones that agree; ``own`` and ``network`` are of the present block.

    :param last: of the first of the closures; :data:`NOTHING` = all are new.
    :param scales: factors on the errors of the odometry of each robot; None = one on all errors,
        by the closures.
    """

    def __init__(
        self,
        chain: KeyframeChain,
        closures: ClosureArrays,
        placement: Placement,
        last: Consensus = NOTHING,
        scales: np.ndarray | None = None,
    ) -> None:
        self._chain, self._closures, self._placement = chain, closures, placement
        self._scales, self._freedom = scales, freedom_of(chain)
        self._latest = np.maximum(closures.query, closures.place)
        self._runs = self._latest // tuning.LONGEST  # whose closures may be wrong together
        space, width = room(placement.initial, self._freedom), 2 * self._freedom + 1
        if last.beliefs.innovations.shape[1] != width:  # nothing, or the odometry left a plane
            last = replace(NOTHING, beliefs=Beliefs(space, np.zeros((0, width))))
        count, old, self._nodes = len(closures), len(last.inliers), last.nodes
        self._is_old = np.arange(count) < old
        self._accepted = np.zeros(count, bool)
        self._accepted[:old] = last.inliers & placement.allowed[:old]
        self._beliefs = last.beliefs.resize(space, count)
        searched = max(1, tuning.SEARCH * last.beliefs.search_count)
        self._searches = scales is None and count >= searched
        if self._searches:
            self._begin(chain, placement.initial, np.arange(count))
            ends = chain.session[closures.query], chain.session[closures.place]
            inside = np.flatnonzero(ends[0] == ends[1])
            rows, new = self.network.beside_odometry(inside), ~self._is_old[inside]
            self._beliefs.innovations[inside[new]] = rows[new]
            factors = tuning.FACTORS / self._beliefs.factor
            self._beliefs = self._beliefs.search_factor(rows, self._runs[inside], factors)
            self._beliefs = replace(self._beliefs, search_count=count)

    def _begin(self, part: KeyframeChain, nodes: np.ndarray, own: np.ndarray) -> np.ndarray:
        """
        Begin a block with a network, linearized, and return the variables.

        :param own: numbers of all closures up to its end.
        """
        links = {  # a session may be tied to a later one
            node: link if link < len(part) else part.before(node)
            for node, link in self._placement.links.items()
            if node < len(part)
        }
        self.own, self._robot = own, part.robot
        self.network = network = Network(
            part, nodes, self._closures[own], links, self._freedom, self._beliefs.space
        )
        self._limit = tuning.TAILS * network.limit
        self._set_odometry()
        values = network.values(nodes)
        network.residuals(self._odometry, values)
        return values

    def _set_odometry(self) -> None:
        """Set the information of all factors of the network at the present errors."""
        factor = self._beliefs.factor
        stated = np.full(len(self._chain.robots), factor)
        scales = stated if self._scales is None else self._scales
        self._odometry = self.network.odometry(scales[self._robot], factor)

    def consensus(self) -> Consensus:
        """Return all closures that agree."""
        count, seen, is_whole = len(self._chain), self._is_old.copy(), not self._is_old.any()
        step = max(1, count // (tuning.BLOCKS if self._scales is None else tuning.PARTS))
        for end in (*range(len(self._nodes) + step, count, step), count):
            part, is_last = self._chain.until(end), end == count
            self._nodes = extend(part, self._nodes, self._placement)
            usable = self._placement.allowed & (self._latest < end)
            if (usable & ~seen).any() or is_last:
                swaps = is_last and is_whole and self._scales is None
                self._decide(part, np.flatnonzero(usable), ~seen[usable], swaps)
            seen |= usable
        if self._scales is not None and is_whole:  # what a later block has corrected may agree
            self._decide(part, self.own, ~self._accepted[self.own], False)
        return Consensus(self._nodes, self._accepted, self._beliefs)

    def _decide(self, part: KeyframeChain, own: np.ndarray, new: np.ndarray, swaps: bool) -> None:
        """
        Decide on the closures of a block.

        :param own: numbers of all closures up to its end.
        :param new: which of them are new, bool.
        :param swaps: leave out weak ones on trial.
        """
        values, network = self._begin(part, self._nodes, own), self.network
        accepted, joins = self._accepted[own], np.isin(own, self._placement.joins)
        if (joins & ~accepted).any():  # a session begins where most closures place it
            accepted = accepted | joins
            values, _ = network.fit(self._odometry, accepted, values)
            network.residuals(self._odometry, values)
            new = (new | network.are_across) & ~accepted
        for again in PASSES:
            rows = self._beliefs.innovations[own]
            if again:
                new = ~accepted & (squares(rows) <= self._limit) & (self._beliefs.odds(rows) > 0)
            if not new.any():
                break
            rows[new] = network.innovations(accepted, np.flatnonzero(new))
            self._beliefs.innovations[own] = rows
            if self._searches:
                rows, factors = self._beliefs.innovations, tuning.FACTORS[tuning.FACTORS < 1]
                compared, factors = np.isfinite(rows[:, -1]), 1 / factors
                self._beliefs = self._beliefs.search_factor(
                    rows[compared], self._runs[compared], factors
                )
                self._set_odometry()
                rows = self._beliefs.innovations[own]
            odds, fits = self._beliefs.odds(rows), new & (squares(rows) <= self._limit)
            likely = np.flatnonzero(fits & (odds > 0))
            together = again and are_certain(odds[likely], self._runs[own[likely]])
            passes = fits & (odds > (0 if together else tuning.CERTAIN))
            if not passes.any():
                continue
            inliers, values = self._drop_improbable(*self._fit(accepted | passes, values))
            if (inliers == accepted).all():
                break
            accepted = inliers
        if swaps and accepted.any():
            accepted, values = self._swap_weak(accepted, values)
        self._accepted[own], self._nodes = accepted, network.nodes(values)

    def _fit(self, chosen: np.ndarray, values: np.ndarray) -> Inliers:
        """Solve for closures, without those that contradict others."""
        network, odometry = self.network, self._odometry
        values, _ = network.fit(odometry, chosen, values, tuning.FIRST_STEPS)
        inliers = chosen & (network.residuals(odometry, values) <= self._limit)
        values, _ = network.fit(odometry, inliers, values)
        return inliers, values

    def _drop_improbable(self, inliers: np.ndarray, values: np.ndarray) -> Inliers:
        """
        Leave out, one by one, closures that are less probable than a place anywhere.

        A false one may have a small residual: it bends the odometry, and without it is far away.
        """
        network, rows = self.network, self._beliefs.innovations
        while inliers.any():
            weak = np.flatnonzero(inliers)
            weak = weak[np.argsort(self._beliefs.odds(rows[self.own[weak]]))[: tuning.WEAKEST]]
            rows[self.own[weak]] = network.innovations(inliers, weak)
            odds = self._beliefs.odds(rows[self.own[weak]])
            if odds.min() >= 0:
                break
            inliers = inliers & (np.arange(len(inliers)) != weak[np.argmin(odds)])
            values, _ = network.fit(self._odometry, inliers, values)
        return inliers, values

    def _swap_weak(self, accepted: np.ndarray, values: np.ndarray) -> Inliers:
        """Leave out a weak closure and those beside it, for others, where that is evidence."""
        network, odometry, numbers = self.network, self._odometry, np.arange(len(accepted))
        _, evidence = network.fit(odometry, accepted, values)
        odds = self._beliefs.odds(self._beliefs.innovations[self.own])
        for weak in np.argsort(np.where(accepted, odds, np.inf))[: tuning.WEAKEST]:
            away = np.abs([ends - ends[weak] for ends in (network.query, network.place)])
            others = away.max(axis=0) >= tuning.LONGEST
            trial = accepted & others
            new = numbers[others & ~accepted]
            new = new[np.argsort(-odds[new])[: tuning.PLAUSIBLE]]
            if not accepted[weak] or not len(new):
                continue
            trial_values, _ = network.fit(odometry, trial, values)
            rows = network.innovations(trial, new)
            fits = (squares(rows) <= self._limit) & (self._beliefs.odds(rows) > 0)
            trial |= np.isin(numbers, new[fits])
            trial, trial_values = self._fit(trial, trial_values)
            trial_values, trial_evidence = network.fit(odometry, trial, trial_values)
            if trial_evidence > evidence:
                accepted, values, evidence = trial, trial_values, trial_evidence
        return accepted, values
