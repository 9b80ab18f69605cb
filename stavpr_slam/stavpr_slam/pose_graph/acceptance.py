# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures are accepted, and the errors of the odometry by which they are compared."""

from collections.abc import Collection, Mapping

import numpy as np
from stavpr_slam.pose_graph.breaks import Break, candidates, locate, neighbors
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.clusters import Cluster, ConsistencySettings, ends, grow
from stavpr_slam.pose_graph.consistency import ConsistentSet
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.joint import CERTAIN, NodeErrors, predicted, REFUTED, refuted
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.sessions import Ties

SCALES = np.geomspace(0.05, 2.0, 16)  # factors on the errors of the odometry that are tried
LEAST_CLUSTERS = 6  # that these are estimated from
SAMPLE, CYCLES = 120, 60  # clusters at most for that: compared, and whose cycles are used
CAUTION = 1.5  # factor on the estimated errors of the odometry where closures are compared
SAME = 0.7, 1.4  # a factor that changes by less is the same
MORE = 1.3  # factor on the number of clusters from which errors and breaks are estimated anew
FEW = 100  # clusters up to which breaks are searched with each closure, then the less often
GROWN = 1.05  # factor on the number of clusters from which all are compared together anew


class Acceptance:
    """
    The clusters of closures, and which of them are accepted.

    ``scale`` is the factor on the errors of the odometry, estimated if ``adapt``; ``chosen``:
    clusters that agree pairwise and with all others together; ``confirmed``: numbers of lighter
    clusters that these confirm.
    """

    def __init__(self, chain: KeyframeChain, settings: ConsistencySettings, adapt: bool) -> None:
        self._chain, self._settings, self._adapt = chain, settings, adapt
        self._consistent = ConsistentSet(settings.support)
        self._scaled_at = 0
        # breaks that ended: first nodes, and the weight of all closures then
        self._denied: list[tuple[int, int]] = []
        self.scale = 1.0
        self._loop_scale = np.inf  # until there are clusters enough
        self.restart()

    def restart(self) -> None:
        """Forget the closures, not the errors of the odometry."""
        self.clusters: list[Cluster] = []
        self.chosen = np.zeros(0, bool)
        self.confirmed: set[int] = set()
        self._refuted: set[int] = set()  # numbers of clusters
        self._changed: set[int] = set()
        self._compared_at, self._searched_at, self._waits = 0, 0, False

    @property
    def cautious_scale(self) -> float:
        """Return the factor by which closures are compared."""
        return min(1.0, self.scale * CAUTION)

    @property
    def solution_scale(self) -> float:
        """Return the factor of the solution: the first loops say how far odometry is trusted."""
        return float(min(self.scale, self._loop_scale))

    @property
    def is_precise(self) -> bool:
        """Return whether even the least errors of the odometry explain the first loops."""
        return bool(self._loop_scale == SCALES[0])

    @property
    def has_changed(self) -> bool:
        """Return whether closures wait to be compared."""
        return bool(self._changed)

    @property
    def taken(self) -> np.ndarray:
        """Return whether each cluster is accepted, shape (n,), bool."""
        taken = np.zeros(len(self.clusters), bool)
        taken[: len(self.chosen)] = self.chosen
        taken[list(self.confirmed)] = True
        return taken

    @property
    def accepted(self) -> list[Cluster]:
        """Return the accepted clusters."""
        return [self.clusters[i] for i in np.flatnonzero(self.taken)]

    def add(self, closure: ResolvedClosure) -> None:
        """Add a closure to a cluster; it waits to be compared."""
        cluster = grow(self.clusters, closure, self._chain, self.cautious_scale, self._settings)
        self._changed.add(self.clusters.index(cluster))

    def compare(self) -> None:
        """Compare the clusters that have changed."""
        self._consistent.update(self.clusters, self._changed, self._chain, self.cautious_scale)
        self._changed = set()
        self._choose()

    def compare_all(self) -> None:
        """Compare all clusters."""
        self._changed = set(range(len(self.clusters)))
        self.compare()

    def _choose(self) -> None:
        self.chosen, _ = self._consistent.accepted(
            self.clusters, self._chain.session, self._refuted
        )
        self.confirmed -= set(np.flatnonzero(self.chosen).tolist())

    def _weight(self, session: np.ndarray, without: Collection[int] = ()) -> int:
        """Return the weight of a consistent set; sessions of the nodes, shape (N,)."""
        return self._consistent.accepted(self.clusters, session, without)[1]

    def ended_break(self) -> int | None:
        """Return the first node behind a break that closures do not prove any more."""
        for node in self._chain.splits:
            rejoined = self._chain.rejoined(node)
            if not self._is_proved(self._weight(self._chain.session), self._weight(rejoined)):
                return node
            # many that it lets agree may be refuted by all together
            without = self._weight(rejoined, self._refuted)
            if not self._is_proved(self._total(self.chosen), without):
                self._denied.append((node, self._total()))
                return node
        return None

    def new_break(self, changes: Mapping[int, float]) -> Break | None:
        """
        Return the break that lets most rejected closures agree; None = none is proved.

        :param changes: see :func:`locate`.
        """
        chain, settings = self._chain, self._settings
        least, best, sides = self._weight(chain.session), 0, None
        due = self._searched_at + (len(self.clusters) / FEW) ** 2
        if self._total() - least < settings.break_gain or self._total() < due:
            return None
        self._searched_at = self._total()
        for node in candidates(chain, self.clusters, settings.support):
            if any(
                abs(chain.travelled[node] - chain.travelled[ended]) < settings.break_distance
                and self._total() < MORE * total
                for ended, total in self._denied
            ):
                continue
            chosen, weight = self._consistent.accepted(self.clusters, chain.parted(node))
            if weight > best and self._is_proved(weight, least):
                agreeing = [self.clusters[i] for i in np.flatnonzero(chosen)]
                found = neighbors(chain, agreeing, node, settings)
                if found:
                    best, sides = weight, found
        if sides is None:
            return None
        return locate(chain, self.clusters, sides, self.cautious_scale, settings, changes)

    def _total(self, which: np.ndarray | None = None) -> int:
        weights = np.array([cluster.weight for cluster in self.clusters], int)
        return int(weights.sum() if which is None else weights[which].sum())

    def _is_proved(self, weight: int, without: int) -> bool:
        """Return whether a break is proved, by the weights that agree with and without it."""
        return weight - without >= self._settings.break_gain

    def adapt(self) -> bool:
        """
        Estimate the errors of the odometry anew if there are many more closures.

        :returns: whether they have changed.
        """
        weights = np.array([cluster.weight for cluster in self.clusters])
        candidates = np.flatnonzero(weights >= self._settings.support)
        if not self._adapt:
            return False
        if len(candidates) < max(LEAST_CLUSTERS, MORE * self._scaled_at):
            return not self._scaled_at and self._estimate_from_loops()
        self._scaled_at, self._loop_scale = len(candidates), np.inf
        self._refuted = set()  # those that refuted them may be rejected by now
        return self._estimate(candidates)

    def _estimate(self, candidates: np.ndarray) -> bool:
        """
        Estimate the errors of the odometry, independent of the closures accepted until now.

        Large errors let wrong closures agree, which make the estimate too large: it is repeated
        with the closures that agree at the smaller errors.
        """
        before, scale, previous = self.scale, 1.0, np.inf
        sample = [self.clusters[i] for i in _spread(candidates, SAMPLE)]
        everything, session = range(len(sample)), self._chain.session
        while scale < previous:
            consistent = ConsistentSet(self._settings.support)
            consistent.update(sample, everything, self._chain, min(1.0, scale * CAUTION))
            agreeing, _ = consistent.accepted(sample, session)
            previous, chosen = scale, np.flatnonzero(agreeing)
            if len(chosen) >= LEAST_CLUSTERS:
                own = [sample[i].representative for i in _spread(chosen, CYCLES)]
                scale = Cycles(self._chain, own).noise_scale(SCALES)
        if SAME[0] < scale / before < SAME[1]:
            self._choose()
            return False
        self.scale = scale
        self.compare_all()
        return True

    def _estimate_from_loops(self) -> bool:
        edges = [each for cluster in self.accepted for each in cluster.independent]
        if not edges:
            return False
        before, self._loop_scale = self._loop_scale, Cycles(self._chain, edges).loop_scale(SCALES)
        return not SAME[0] < self._loop_scale / before < SAME[1]

    def refute(self, initial: np.ndarray, ties: Ties, final: bool) -> bool:
        """
        Reject clusters that all others together refute; return whether there are any.

        :param initial: transforms of all nodes in the map, shape (N, 4, 4).
        :param final: else it waits until there are more clusters.
        """
        if not (final or len(self.clusters) > GROWN * self._compared_at):
            return False
        self._compared_at, self._waits = len(self.clusters), True
        whole, edges = np.flatnonzero(self.chosen & self._allowed(ties)), self._edges
        weights = np.array([cluster.weight for cluster in self.clusters])
        nodes = self._nodes(initial, ties)
        left = refuted(nodes, [edges[i] for i in whole], weights[whole])
        if left:
            self._refuted |= set(whole[left].tolist())
            self._compared_at = 0
            self._choose()
        return bool(left)

    def confirm(self, solved: np.ndarray, ties: Ties) -> bool:
        """
        Accept light clusters that the others confirm, and refuted ones that agree with them now.

        :param solved: transforms of all nodes in the map, shape (N, 4, 4).
        :returns: whether others are accepted than before.
        """
        if not self._waits:
            return False
        self._waits = False
        weights = np.array([cluster.weight for cluster in self.clusters])
        allowed, edges, before = self._allowed(ties), self._edges, self.taken
        whole = np.flatnonzero(self.chosen & allowed)
        light = np.flatnonzero((weights < self._settings.support) & allowed)
        left = np.array(sorted(self._refuted), int)
        tried = np.concatenate([light, left])
        squared, odds = predicted(
            self._nodes(solved, ties), [edges[i] for i in tried], [edges[i] for i in whole]
        )
        self.confirmed = set(light[odds[: len(light)] > CERTAIN].tolist())
        self._refuted -= set(left[squared[len(light) :] <= REFUTED].tolist())
        self._choose()
        return not np.array_equal(before, self.taken)

    @property
    def _edges(self) -> list[ResolvedClosure]:
        return [cluster.representative for cluster in self.clusters]

    def _allowed(self, ties: Ties) -> np.ndarray:
        return ties.allow(*(self._chain.session[each] for each in ends(self.clusters)))

    def _nodes(self, transforms: np.ndarray, ties: Ties) -> NodeErrors:
        anchors = {int(self._chain.session[node]) for node in ties.links}
        return NodeErrors(self._chain, transforms, self.cautious_scale, anchors)


def _spread(numbers: np.ndarray, most: int) -> list[int]:
    """Return at most so many of the numbers, in equal steps."""
    steps = np.unique(np.linspace(0, len(numbers) - 1, most).astype(int))
    found: list[int] = numbers[steps].tolist()
    return found
