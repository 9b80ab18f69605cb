# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: odometry and loop closures in, a corrected trajectory out."""

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph.acceptance import Acceptance, independent
from stavpr_slam.pose_graph.breaks import Break
from stavpr_slam.pose_graph.closures import Closure, ResolvedClosure
from stavpr_slam.pose_graph.consistency import Cluster, ConsistencySettings
from stavpr_slam.pose_graph.odometry import ChainSettings, KeyframeChain, OdometryNoise
from stavpr_slam.pose_graph.sessions import extended, placed, session_pairs, tie, Ties
from stavpr_slam.pose_graph.solver import CAUCHY, Solver, WIDE
from stavpr_slam.pose_graph.transforms import body_covariance

MAX_PENDING = 1000  # closures that wait for their odometry
MEMORY = 100  # latest closures by which keypoints are rated
FAR = 8.0  # whitened deviations of a new edge from which all nodes are solved anew


@dataclass(frozen=True)
class GraphSettings:
    """
    Settings of a :class:`PoseGraph`.

    :param noise: errors of the odometry; their factor is estimated if ``adapt``.
    """

    keyframes: ChainSettings = field(default_factory=ChainSettings)
    noise: OdometryNoise = field(default_factory=OdometryNoise)
    consistency: ConsistencySettings = field(default_factory=ConsistencySettings)
    adapt: bool = True


@dataclass(frozen=True, eq=False)
class GraphEdge:
    """A closure between two nodes, and whether it is accepted."""

    query: int
    place: int
    accepted: bool


class Arranged(NamedTuple):
    """
    What is solved.

    :param ties: of the sessions.
    :param edges: by their numbers.
    :param initial: transforms of all nodes, shape (N, 4, 4).
    :param moved: whether these are not the last estimate.
    """

    ties: Ties
    edges: dict[int, ResolvedClosure]
    initial: np.ndarray
    moved: bool


class PoseGraph:
    """
    Keyframes of the odometry and the loop closures between them.

    Add odometry and closures in any order of arrival, and update now and then. ``counts`` has the
    input that is left out, by its reason.

    :raises UnavailableError: GTSAM is not installed.
    """

    def __init__(self, settings: GraphSettings | None = None) -> None:
        self.settings = settings or GraphSettings()
        self._solver = Solver()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.chain = KeyframeChain(self.settings.keyframes)
        self._acceptance = Acceptance(
            self.chain, self.settings.noise, self.settings.consistency, self.settings.adapt
        )
        self._solver.restart()
        self._pending: list[Closure] = []
        self._known: list[Closure] = []  # those between nodes
        self._changes: dict[int, float] = {}  # of images by their stamps
        self._tried, self._missed = 0, 0.0  # latest closures, and the share not confirmed of them
        self._ties = Ties()
        self._edges: dict[int, ResolvedClosure] = {}
        self.solved = np.zeros((0, 4, 4))
        self.counts: Counter[str] = Counter()

    @property
    def noise(self) -> OdometryNoise:
        """Return the errors of the odometry as estimated."""
        return self._acceptance.noise

    @property
    def scale(self) -> float:
        """Return the factor of these errors that the clusters have."""
        return self._acceptance.scale

    def add_odometry(self, stamp: int, pose: np.ndarray) -> bool:
        """
        Add an odometry; return whether it became a keyframe.

        :param stamp: ns.
        :param pose: shape (7,).
        :raises InputError: it is not finite; it is counted and left out.
        """
        try:
            return self.chain.add(stamp, pose)
        except InputError:
            self.counts['invalid odometry'] += 1
            raise

    def add_closure(self, closure: Closure) -> None:
        """
        Add a loop closure; it waits for the odometry of its stamps.

        :raises InputError: it is not finite; it is counted and left out.
        """
        try:
            closure = closure.checked()
        except InputError:
            self.counts['invalid'] += 1
            raise
        self._changes |= closure.changes
        self._pending.append(replace(closure, changes=closure.changes[-1:]))
        if len(self._pending) > MAX_PENDING:
            del self._pending[0]
            self.counts['unknown stamp'] += 1

    def _resolve(self) -> None:
        """Find the nodes of the closures that wait."""
        waiting = []
        for closure in self._pending:
            query = self.chain.find(closure.query_stamp)
            place = self._place(closure)
            if query is None or place is None:
                ahead = max(closure.query_stamp, closure.place_stamp * (not closure.map_id))
                if self.chain.is_ahead(ahead):
                    waiting.append(closure)
                else:
                    self.counts['unknown stamp'] += 1
                continue
            (i, to_query), (j, to_place) = query, place
            if i == j:
                self.counts['unknown stamp'] += 1
                continue
            measured = matrices(closure.pose)
            newest = closure.changes[0][0] if closure.changes else closure.query_stamp
            # the frame of the pose moves with the query: its covariance in these axes changes by
            # the small way between image and keyframe, which is left out
            covariance = body_covariance(closure.covariance, measured)
            resolved = ResolvedClosure(
                i, j, to_place @ measured @ inverse(to_query), covariance,
                float(self.chain.travelled[i] + np.linalg.norm(to_query[:3, 3])),
                len(self._known), (closure.query_stamp + newest) // 2, closure.is_independent,
                self._weight(closure),
            )  # fmt: skip
            self._known.append(closure)
            self._acceptance.add(resolved)
        self._pending = waiting

    def _weight(self, closure: Closure) -> float:
        """
        Return how far a closure supports others: the share that keypoints miss of right ones.

        That share depends on the light: of the latest closures, where they confirm few.
        """
        if closure.verified is None:
            return 1.0
        self._tried = min(self._tried + 1, MEMORY)
        self._missed += (1 - closure.verified - self._missed) / self._tried
        return 1.0 if closure.verified else self._missed

    def _place(self, closure: Closure) -> tuple[int, np.ndarray] | None:
        if not closure.map_id:
            return self.chain.find(closure.place_stamp)
        assert closure.place_pose is not None
        node = self.chain.fixed(closure.map_id, closure.place_stamp, closure.place_pose)
        return node, np.eye(4)

    def update(self, final: bool = False) -> np.ndarray:
        """
        Accept and reject closures, and solve.

        :param final: solve all at once, to convergence.
        :returns: transforms of all nodes in the map, shape (N, 4, 4).
        """
        self._resolve()
        if not len(self.chain):
            return self.solved
        if self._acceptance.has_changed:
            self._decide()
        ties, edges, initial, moved = self._settle(final)
        if moved:
            self._solver.restart()
        if final or moved:
            kernels = (WIDE, CAUCHY) if moved else (CAUCHY,)
            initial = self._solver.solve(
                self.chain, initial, edges, self.noise, ties.links, kernels
            )
        if not final:
            initial = self._solver.update(self.chain, initial, edges, self.noise, ties.links)
        self.solved, self._ties, self._edges = initial, ties, edges
        return self.solved

    def _decide(self) -> None:
        """Accept and reject clusters; begin a session where they prove a break."""
        self._acceptance.compare()
        ended = self._acceptance.ended_break()
        if ended is not None:
            self._unsplit(ended)  # later closures are against it
            return
        found = self._acceptance.new_break(self._changes)
        if found:
            self._split(found)
        if self._acceptance.adapt():
            self._solver.restart()

    def _settle(self, final: bool) -> Arranged:
        """Reject clusters that all others together refute, and breaks that only they proved."""
        arranged = self._arrange()
        while self._acceptance.refute(arranged.initial, arranged.ties, final):
            self._solver.restart()
            arranged = self._arrange()
        ended = self._acceptance.ended_break()
        if ended is None:
            return arranged
        self._unsplit(ended)
        return self._settle(final)

    def _arrange(self) -> Arranged:
        """Tie the sessions by the accepted closures."""
        accepted = self._acceptance.accepted
        ties = tie(self.chain, accepted, self.settings.consistency.join_support)
        moved = ties.moved_since(self._ties)
        edges = self._select(accepted, ties)
        if moved:
            return Arranged(ties, edges, placed(self.chain, accepted, ties), True)
        initial = extended(self.chain, self.solved, ties)
        far, session = self._far(edges, initial), self.chain.session
        if any(session[edge.query] != session[edge.place] for edge in far):
            initial = placed(self.chain, accepted, ties)
        # such edges would have no influence on the robust solution
        return Arranged(ties, edges, initial, bool(far))

    def _split(self, at: Break) -> None:
        """Begin a session; closures on both sides of a break are no clusters any more."""
        self.chain.split(at.node, at.stamp)
        self._begin_anew()

    def _unsplit(self, node: int) -> None:
        self.chain.unsplit(node)
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Find the nodes and clusters of all closures again."""
        self._solver.restart()
        waiting, self._pending = self._pending, self._known
        self._known, self._edges = [], {}
        self._acceptance.restart()
        self._tried, self._missed = 0, 0.0
        self._resolve()
        self._pending = waiting
        self._acceptance.compare_all()

    def _select(self, accepted: list[Cluster], ties: Ties) -> dict[int, ResolvedClosure]:
        """
        Return the edges of the solution by their numbers.

        Where even the least errors of the odometry explain the first loops, the closures measure
        them less precisely than the odometry, and would add their own errors.
        """
        query, place = session_pairs(self.chain, accepted)
        precise = self._acceptance.is_precise
        return {
            each.number: each
            for cluster, a, b in zip(accepted, query, place, strict=True)
            if ties.allows(a, b) and not (precise and a == b)
            for each in independent(cluster)
        }

    def _far(
        self, edges: dict[int, ResolvedClosure], initial: np.ndarray
    ) -> list[ResolvedClosure]:
        """Return the new edges that are far from the estimate."""
        new = [edge for number, edge in edges.items() if number not in self._edges]
        if not new:
            return []
        query, place = [e.query for e in new], [e.place for e in new]
        error = inverse(np.array([e.transform for e in new]))
        error = error @ inverse(initial[place]) @ initial[query]
        deviation = np.sqrt([np.diag(e.covariance)[3:].max() for e in new])
        far = np.linalg.norm(error[:, :3, 3], axis=1) > FAR * deviation
        return [edge for edge, is_far in zip(new, far, strict=True) if is_far]

    # results

    @property
    def edges(self) -> list[GraphEdge]:
        """Return all closures between nodes."""
        found = self._acceptance
        return [
            GraphEdge(each.query, each.place, bool(taken))
            for cluster, taken in zip(found.clusters, found.chosen, strict=False)
            for each in cluster.members
        ]

    @property
    def accepted(self) -> int:
        """Return the number of accepted closures."""
        return sum(len(cluster.members) for cluster in self._acceptance.accepted)

    @property
    def rejected(self) -> int:
        """Return the number of rejected closures."""
        return len(self._known) - self.accepted

    @property
    def used(self) -> dict[int, ResolvedClosure]:
        """Return the edges of the solution by their numbers."""
        return self._edges

    @property
    def uncompared(self) -> int:
        """Return how often the graph was too ill-conditioned to compare all closures together."""
        return self._acceptance.uncompared

    @property
    def splits(self) -> int:
        """Return the number of breaks that closures prove."""
        return len(self.chain.splits)

    @property
    def pending(self) -> int:
        """Return the number of closures that wait for their odometry."""
        return len(self._pending)

    def at(self, stamp: int, odometry: np.ndarray | None = None) -> np.ndarray | None:
        """
        Return the corrected pose at a stamp (ns), shape (7,); None = unknown.

        :param odometry: at the stamp, shape (7,); without it, that between keyframes is
            interpolated.
        """
        found = self.chain.find(stamp)
        if found is None or found[0] >= len(self.solved):
            return None
        node, motion = found
        if odometry is not None:
            motion = inverse(self.chain.transforms[node]) @ matrices(odometry)
        return to_poses(self.solved[node] @ motion)

    def map_to_odom(self) -> np.ndarray:
        """Return the transform from the newest odometry's frame to the map, shape (7,)."""
        node = self.chain.newest
        if node < 0 or not len(self.solved):
            return np.array([0, 0, 0, 0, 0, 0, 1.0])
        while node >= len(self.solved):
            node = int(self.chain.previous[node])
            if node < 0:
                node = len(self.solved) - 1
        return to_poses(self.solved[node] @ inverse(self.chain.transforms[node]))
