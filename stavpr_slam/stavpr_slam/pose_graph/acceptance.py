# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which loop closures are accepted, and the errors of the odometry by which they are compared."""

import math

import numpy as np
from stavpr_slam.pose_graph.breaks import Break, find_break
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.consistency import Cluster, ConsistencySettings, ConsistentSet, grow
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_slam.pose_graph.refutation import Refutation
from stavpr_slam.pose_graph.sessions import Ties

SCALES = np.geomspace(0.05, 2.0, 16)  # factors on the errors of the odometry that are tried
LEAST_CLUSTERS = 6  # that these are estimated from
# A break explains at least this share of the closures that stay rejected: of many wrong ones, some
# agree at random.
UNEXPLAINED = 0.25
SAMPLE, CYCLES = 120, 60  # clusters at most for that: compared, and whose cycles are used
CAUTION = 1.5  # factor on the estimated errors of the odometry where closures are compared
SAME = 0.7, 1.4  # a factor that changes by less is the same
MORE = 1.3  # so many times as many clusters: factor and breaks are decided anew
GROWN = 1.05  # so many times as many accepted clusters: they are tested together anew


class Acceptance:
    """
    The clusters of closures, and which of them are accepted.

    :param noise: errors of the odometry; their factor ``scale`` is estimated if ``adapt``.
    """

    def __init__(
        self, chain: KeyframeChain, noise: OdometryNoise, settings: ConsistencySettings,
        adapt: bool,
    ) -> None:  # fmt: skip
        self._chain, self._noise, self._settings, self._adapt = chain, noise, settings, adapt
        self._consistent = ConsistentSet(settings)
        self._scaled_at = 0
        # breaks that ended: first nodes, and the weight of all closures then
        self._denied: list[tuple[int, float]] = []
        self.uncompared = 0  # times that the graph was too ill-conditioned to compare all
        self.scale = 1.0
        self.loop_scale = math.inf  # until there are clusters enough
        self.restart()

    def restart(self) -> None:
        """Forget the closures, not the errors of the odometry."""
        self.clusters: list[Cluster] = []
        self.chosen = np.zeros(0, bool)
        self._refuted: set[int] = set()  # numbers of clusters
        self._changed: set[int] = set()
        self._tested, self._tested_at = True, 0

    @property
    def noise(self) -> OdometryNoise:
        """Return the errors of the odometry as estimated."""
        return self._noise.scaled(min(self.scale, self.loop_scale))

    @property
    def cautious_noise(self) -> OdometryNoise:
        """Return those by which closures are compared."""
        return self._cautious(self.scale)

    def _cautious(self, scale: float) -> OdometryNoise:
        return self._noise.scaled(min(1.0, scale * CAUTION))

    @property
    def is_precise(self) -> bool:
        """Return whether even the least errors of the odometry explain the first loops."""
        return self.loop_scale == SCALES[0]

    @property
    def has_changed(self) -> bool:
        """Return whether closures wait to be compared."""
        return bool(self._changed)

    @property
    def accepted(self) -> list[Cluster]:
        """Return the accepted clusters."""
        pairs = zip(self.clusters, self.chosen, strict=False)
        return [cluster for cluster, taken in pairs if taken]

    def add(self, closure: ResolvedClosure) -> None:
        """Add a closure to a cluster; it waits to be compared."""
        cluster = grow(self.clusters, closure, self._chain, self.cautious_noise, self._settings)
        self._changed.add(self.clusters.index(cluster))

    def compare(self) -> None:
        """Compare the clusters that have changed."""
        self._consistent.update(self.clusters, self._changed, self._chain, self.cautious_noise)
        self._changed = set()
        self._choose()

    def compare_all(self) -> None:
        """Compare all clusters."""
        self._changed = set(range(len(self.clusters)))
        self.compare()

    def _choose(self) -> None:
        before = self.chosen
        self.chosen, _ = self._consistent.accepted(
            self.clusters, self._chain.session, self._refuted
        )
        same = np.pad(before, (0, len(self.chosen) - len(before)))
        self._tested &= np.array_equal(self.chosen, same)

    def _weight(self, session: np.ndarray) -> float:
        """Return the weight of a consistent set; sessions of the nodes, shape (N,)."""
        return self._consistent.accepted(self.clusters, session)[1]

    def ended_break(self) -> int | None:
        """Return the first node behind a break that closures do not prove any more."""
        for node in self._chain.splits:
            without = self._weight(self._chain.rejoined(node))
            if not self._is_proved(self._weight(self._chain.session), without):
                return node
            # many that it lets agree may be refuted by all together
            if not self._is_proved(sum(cluster.weight for cluster in self.accepted), without):
                self._denied.append((node, self._total))
                return node
        return None

    def new_break(self, changes: dict[int, float]) -> Break | None:
        """Return a break that explains rejected closures; for changes, see `find_break`."""
        chain, settings = self._chain, self._settings
        found = self.clusters and find_break(
            chain, self.clusters, self._consistent.conflicts(self.clusters, chain.session),
            self.cautious_noise, settings, changes,
        )  # fmt: skip
        if not found:
            return None
        for node, total in self._denied:
            way = abs(chain.travelled[found.node] - chain.travelled[node])
            if way < settings.break_distance and self._total < MORE * total:
                return None
        gained, weight = self._weight(chain.parted(found.node)), self._weight(chain.session)
        return found if self._is_proved(gained, weight) else None

    @property
    def _total(self) -> float:
        return sum(cluster.weight for cluster in self.clusters)

    def _is_proved(self, weight: float, without: float) -> bool:
        """Return whether a break is proved, by the weights that agree with and without it."""
        rejected = UNEXPLAINED * (self._total - weight)
        return weight - without >= max(self._settings.break_support / 2, rejected)

    def adapt(self) -> bool:
        """
        Estimate the errors of the odometry anew if there are many more closures.

        :returns: whether they have changed for the solution.
        """
        if not self._adapt:
            return False
        candidates = len(self._candidates())
        if candidates >= max(LEAST_CLUSTERS, MORE * self._scaled_at):
            self._scaled_at, self.loop_scale = candidates, math.inf
            self._refuted = set()  # those that refuted them may be rejected by now
            return self._estimate()
        return not self._scaled_at and self._estimate_from_loops()

    def _estimate(self) -> bool:
        """
        Estimate the errors of the odometry, not from what the last estimate accepts.

        Large errors let wrong closures agree, which make the estimate too large: it is repeated
        with the closures that agree at the smaller errors.
        """
        before, scale, previous = self.scale, 1.0, math.inf
        able = self._candidates()
        sample = able[np.unique(np.linspace(0, len(able) - 1, SAMPLE).astype(int))].tolist()
        clusters = [self.clusters[i] for i in sample if i not in self._refuted]
        everything, session = set(range(len(clusters))), self._chain.session
        while scale < previous:
            consistent = ConsistentSet(self._settings)
            consistent.update(clusters, everything, self._chain, self._cautious(scale))
            agreeing, _ = consistent.accepted(clusters, session)
            previous, chosen = scale, np.flatnonzero(agreeing)
            if len(chosen) >= LEAST_CLUSTERS:
                chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, CYCLES).astype(int))]
                cycles = Cycles(self._chain, [clusters[i].representative for i in chosen])
                scale = cycles.noise_scale(self._noise, SCALES)
        if SAME[0] < scale / before < SAME[1]:
            self._choose()
            return False
        self.scale = scale
        self.compare_all()
        return True

    def _candidates(self) -> np.ndarray:
        """Return the numbers of the clusters that have closures enough, in their order."""
        weights = np.array([cluster.weight for cluster in self.clusters])
        return np.flatnonzero(weights >= self._settings.support)

    def _estimate_from_loops(self) -> bool:
        """Trust the odometry in the solution as far as the first closed loops allow."""
        edges = [each for cluster in self.accepted for each in independent(cluster)]
        if not edges:
            return False
        before = self.loop_scale
        self.loop_scale = Cycles(self._chain, edges).loop_scale(self._noise, SCALES)
        return not SAME[0] < self.loop_scale / before < SAME[1]

    def refute(self, initial: np.ndarray, ties: Ties, final: bool) -> bool:
        """
        Reject clusters that all others together refute; return whether there are any.

        :param initial: transforms of all nodes in the map, shape (N, 4, 4).
        :param final: else it waits until more clusters are accepted.
        """
        accepted = int(self.chosen.sum())
        if self._tested or not (final or accepted >= GROWN * self._tested_at):
            return False
        whole = {
            int(i): (self.clusters[i].representative, self.clusters[i].weight)
            for i in np.flatnonzero(self.chosen)
            if self._counts(self.clusters[i].representative, ties)
        }
        together = Refutation(self._chain, self.cautious_noise, ties.links)
        self._tested, self._tested_at = True, accepted
        try:
            found = together.refuted(initial, whole)
        except RuntimeError:  # of GTSAM, whose text is about variables
            self.uncompared += 1
            return False
        if found:
            self._refuted |= set(found)
            self._tested_at = 0
            self._choose()
            if self._scaled_at:
                self._estimate()
        return bool(found)

    def _counts(self, closure: ResolvedClosure, ties: Ties) -> bool:
        session = self._chain.session
        return ties.allows(int(session[closure.query]), int(session[closure.place]))


def independent(cluster: Cluster) -> list[ResolvedClosure]:
    """Return the closures of a cluster whose errors do not correlate; at least the best one."""
    marked = [each for each in cluster.members if each.is_independent]
    return marked or [cluster.representative]
