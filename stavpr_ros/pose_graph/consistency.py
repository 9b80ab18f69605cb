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

from dataclasses import dataclass, field

import numpy as np
from stavpr_ros.pose_graph.closures import ResolvedClosure
from stavpr_ros.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_ros.pose_graph.transforms import angles, inverse

LIMIT = 9.0  # squared deviations
CLOSURE_FACTORS = (0.05, 0.2, 1.0)  # on the covariances of closures that are tried


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
    break_distance: float = 50.0


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


class Cycles:
    """
    Cycles of closures: their ends and measurements as arrays.

    :param closures: at least one.
    """

    def __init__(self, chain: KeyframeChain, closures: list[ResolvedClosure]) -> None:
        query = np.array([each.query for each in closures])
        place = np.array([each.place for each in closures])
        self.query_session, self.place_session = chain.session[query], chain.session[place]
        self.query_at, self.place_at = chain.travelled[query], chain.travelled[place]
        self.Q, self.P = chain.transforms[query], chain.transforms[place]
        self.Z = np.array([each.transform for each in closures])
        variances = np.array([np.diag(each.covariance) for each in closures])
        self.angle_variance = variances[:, :3].max(axis=1)
        # planar motion: the two larger of the three
        self.position_variance = np.sort(variances[:, 3:], axis=1)[:, 1:].mean(axis=1)

    def deviations(self, i: int, noise: OdometryNoise) -> np.ndarray:
        """
        Return the squared deviations of the cycles of closure i with all, shape (n,).

        0 where there is no cycle: the ends are in different sessions.
        """
        position, angle, variance, angle_variance = self._errors(i, noise)
        squared = np.maximum(position**2 / variance, angle**2 / angle_variance)
        same = self.query_session == self.query_session[i]
        same &= self.place_session == self.place_session[i]
        return np.where(same, squared, 0.0)

    def _errors(
        self, i: int, noise: OdometryNoise
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return position and angle that cycles with closure i miss by, and their variances."""
        places = inverse(self.P[i]) @ self.P
        queries = inverse(self.Q) @ self.Q[i]
        cycle = inverse(self.Z[i]) @ places @ self.Z @ queries
        along = np.abs(self.place_at - self.place_at[i])
        driven = np.abs(self.query_at - self.query_at[i])
        lever = (places[:, :3, 3] ** 2).sum(axis=1)
        variance = (
            self.position_variance[i]
            + self.position_variance
            + lever * (self.angle_variance[i] + self.angle_variance) / 2
            + noise.position_variance(along)
            + noise.position_variance(driven)
        )
        angle_variance = (
            self.angle_variance[i]
            + self.angle_variance
            + noise.angle_variance(along)
            + noise.angle_variance(driven)
        )
        position = np.linalg.norm(cycle[:, :3, 3], axis=1)
        return position, angles(cycle), variance, angle_variance

    def loop_scale(self, noise: OdometryNoise, scales: np.ndarray) -> float:
        """
        Return the factor on the errors of the odometry that most probably left these loops open.

        Few closures, and short loops, have no cycles that :meth:`noise_scale` could use.
        """
        same = self.query_session == self.place_session
        if not same.any():
            return float(scales[-1])
        off = inverse(self.Z) @ inverse(self.P) @ self.Q
        position, angle = np.linalg.norm(off[same, :3, 3], axis=1), angles(off[same])
        driven = np.abs(self.query_at - self.place_at)[same]
        likelihood = np.zeros(len(scales))
        for k, scale in enumerate(scales):
            own = OdometryNoise(noise.translation * scale, noise.rotation * scale)
            for error, of, dof in (
                (position, self.position_variance[same] + own.position_variance(driven), 2),
                (angle, self.angle_variance[same] + own.angle_variance(driven), 1),
            ):
                heavy = (4 + dof) / 2 * np.log1p(error**2 / (4 * of))
                likelihood[k] -= (heavy + dof / 2 * np.log(of)).sum()
        return float(scales[np.argmax(likelihood)])

    def noise_scale(self, noise: OdometryNoise, scales: np.ndarray) -> float:
        """
        Return the factor on the errors of the odometry that the cycles have most probably.

        Student's t with 4 degrees of freedom: few wrong closures do not decide. The covariances of
        the closures may be too large or too small: the most probable of some factors is taken.
        """
        likelihood = np.zeros((len(CLOSURE_FACTORS), len(scales)))
        for i in range(len(self.Z)):
            same = self.query_session == self.query_session[i]
            same &= self.place_session == self.place_session[i]
            driven = np.abs(self.query_at - self.query_at[i])
            same &= (driven > 30) & (driven < 400) & (np.arange(len(same)) > i)
            if not same.any():
                continue
            still = OdometryNoise(0.0, 0.0)
            position, angle, measured, measured_angle = (
                values[same] for values in self._errors(i, still)
            )
            along = np.abs(self.place_at - self.place_at[i])[same]
            for k, scale in enumerate(scales):
                own = OdometryNoise(noise.translation * scale, noise.rotation * scale)
                moved = own.position_variance(along) + own.position_variance(driven[same])
                turned = own.angle_variance(along) + own.angle_variance(driven[same])
                for j, factor in enumerate(CLOSURE_FACTORS):
                    for error, of, dof in (
                        (position, factor * measured + moved, 2),
                        (angle, factor * measured_angle + turned, 1),
                    ):
                        heavy = (4 + dof) / 2 * np.log1p(error**2 / (4 * of))
                        likelihood[j, k] -= (heavy + dof / 2 * np.log(of)).sum()
        return float(scales[np.argmax(likelihood.max(axis=0))])


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
    """The contradictions between clusters, kept as the clusters grow, and the accepted ones."""

    def __init__(self, settings: ConsistencySettings) -> None:
        self._settings = settings
        self._conflicts = np.zeros((64, 64), bool)

    @property
    def conflicts(self) -> np.ndarray:
        """Return which clusters contradict each other, (m, m), bool, m >= n."""
        return self._conflicts

    def update(
        self,
        clusters: list[Cluster],
        changed: set[int],
        chain: KeyframeChain,
        noise: OdometryNoise,
    ) -> np.ndarray:
        """
        Return which clusters are accepted, shape (n,), bool.

        :param changed: numbers of the clusters that are new or have grown.
        """
        n = len(clusters)
        if n > len(self._conflicts):
            larger = np.zeros((2 * n, 2 * n), bool)
            larger[: len(self._conflicts), : len(self._conflicts)] = self._conflicts
            self._conflicts = larger
        if n == 0:
            return np.zeros(0, bool)
        cycles = Cycles(chain, [cluster.representative for cluster in clusters])
        for i in changed:
            row = cycles.deviations(i, noise) > LIMIT
            self._conflicts[i, :n] = self._conflicts[:n, i] = row
        weights = np.array([cluster.weight for cluster in clusters])
        return largest_consistent(
            self._conflicts[:n, :n], weights, weights >= self._settings.support
        )


def largest_consistent(
    conflicts: np.ndarray, weights: np.ndarray, candidates: np.ndarray
) -> np.ndarray:
    """
    Return a set without conflicts and of large weight.

    While there are conflicts, the candidate is removed whose opponents weigh most in relation to
    its own weight; the removed ones without conflicts are added again, heavy ones first.

    :param conflicts: symmetric, shape (n, n), bool.
    :param weights: shape (n,).
    :param candidates: shape (n,), bool.
    :returns: shape (n,), bool.
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
