# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: odometry and loop closures in, a corrected trajectory out."""

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph.acceptance import Acceptance
from stavpr_slam.pose_graph.closures import Closure, ResolvedClosure
from stavpr_slam.pose_graph.clusters import ConsistencySettings, ends
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.sessions import extended, placed, tie, Ties
from stavpr_slam.pose_graph.solver import Problem, Solver
from stavpr_slam.pose_graph.transforms import body_covariance

MAX_PENDING = 1000  # closures that wait for their odometry
ROUNDS = 50  # of comparing all clusters together at most


@dataclass(frozen=True)
class GraphSettings:
    """
    Settings of a :class:`PoseGraph`.

    :param noise: errors of the odometry where its messages have none; their factor is estimated
        if ``adapt``.
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
        self.chain = KeyframeChain(self.settings.keyframes, self.settings.noise)
        self._acceptance = Acceptance(self.chain, self.settings.consistency, self.settings.adapt)
        self._solver.restart()
        self._pending: list[Closure] = []
        self._known: list[Closure] = []  # those between nodes
        self._solved_closures = 0  # of them, in the last solution
        self._changes: dict[int, float] = {}  # of images by their stamps
        self._ties = Ties()
        self._edges: dict[int, ResolvedClosure] = {}
        self.solved = np.zeros((0, 4, 4))
        self.counts: Counter[str] = Counter()

    @property
    def scale(self) -> float:
        """Return the factor on the errors of the odometry that the closures have shown."""
        return self._acceptance.scale

    def add_odometry(
        self, stamp: int, pose: np.ndarray, robot: str = '', covariance: np.ndarray | None = None
    ) -> bool:
        """
        Add an odometry; return whether it became a keyframe.

        :param stamp: ns.
        :param pose: shape (7,).
        :param covariance: of the message, (6, 6), see :meth:`KeyframeChain.add`.
        :raises InputError: it is not finite; it is counted and left out.
        """
        try:
            return self.chain.add(stamp, pose, robot, covariance)
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
            query = self.chain.find(closure.query_stamp, closure.query_robot)
            place = self._place(closure)
            if query is None or place is None:
                ahead = self.chain.is_ahead
                if ahead(closure.query_stamp, closure.query_robot) or (
                    not closure.map_id and ahead(closure.place_stamp, closure.place_robot)
                ):
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
            # the short motion between image and keyframe, which is left out
            covariance = body_covariance(closure.covariance, measured)
            resolved = ResolvedClosure(
                i, j, to_place @ measured @ inverse(to_query), covariance,
                float(self.chain.travelled[i] + np.linalg.norm(to_query[:3, 3])),
                len(self._known), (closure.query_stamp + newest) // 2, closure.is_independent,
            )  # fmt: skip
            self._known.append(closure)
            self._acceptance.add(resolved)
        self._pending = waiting

    def _place(self, closure: Closure) -> tuple[int, np.ndarray] | None:
        if not closure.map_id:
            return self.chain.find(closure.place_stamp, closure.place_robot)
        assert closure.place_pose is not None
        node = self.chain.fixed(closure.map_id, closure.place_stamp, closure.place_pose)
        return node, np.eye(4)

    def update(self, final: bool = False) -> np.ndarray:
        """
        Accept and reject closures, and solve.

        New closures with which that fails are left out and counted.

        :param final: solve all at once, to convergence.
        :returns: transforms of all nodes in the map, shape (N, 4, 4).
        """
        self._resolve()
        if not len(self.chain):
            return self.solved
        try:
            self._update(final)
            self._solved_closures = len(self._known)
        except (RuntimeError, np.linalg.LinAlgError, FloatingPointError):
            # GTSAM raises RuntimeError for a system that it cannot solve
            failed = len(self._known) - self._solved_closures
            if not failed:
                raise
            self.counts['failed'] += failed
            del self._known[self._solved_closures :]
            self._rebuild()
            self._update(final)
        return self.solved

    def _update(self, final: bool) -> None:
        if self._acceptance.has_changed:
            self._decide()
        ties, initial = self._arranged()
        for _ in range(ROUNDS):
            if not self._acceptance.refute(initial, ties, final):
                break
            ended = self._acceptance.ended_break()
            if ended is not None:
                self._merge_session(ended)  # only refuted closures proved it
            ties, initial = self._arranged()
        self._solve(ties, initial, final)
        if self._acceptance.confirm(self.solved, ties):
            self._solve(ties, self.solved, final)

    def _decide(self) -> None:
        """Accept and reject clusters; begin a session where they prove a break."""
        self._acceptance.compare()
        ended = self._acceptance.ended_break()
        if ended is not None:
            self._merge_session(ended)  # later closures are against it
            return
        found = self._acceptance.new_break(self._changes)
        if found:
            # closures on both sides of a break are no clusters any more
            self.chain.split(found.node, found.stamp)
            self._rebuild()
        if self._acceptance.adapt():
            self._solver.restart()

    def _merge_session(self, node: int) -> None:
        self.chain.merge_session(node)
        self._rebuild()

    def _rebuild(self) -> None:
        """Find the nodes and clusters of all closures again."""
        self._solver.restart()
        waiting, self._pending = self._pending, self._known
        self._known, self._edges = [], {}
        self._acceptance.restart()
        self._resolve()
        self._pending = waiting
        self._acceptance.compare_all()

    def _arranged(self) -> tuple[Ties, np.ndarray]:
        """Tie the sessions by the accepted closures; return initial transforms of all nodes."""
        accepted = self._acceptance.accepted
        ties = tie(self.chain, accepted, self.settings.consistency.join_support)
        if ties.moved_since(self._ties):
            return ties, placed(self.chain, accepted, ties)
        return ties, extended(self.chain, self.solved, ties)

    def _solve(self, ties: Ties, initial: np.ndarray, final: bool) -> None:
        """
        Estimate all nodes by the accepted closures.

        Where even the least errors of the odometry explain the first loops, the closures measure
        them less precisely than the odometry, and would add their own errors.
        """
        chain, accepted = self.chain, self._acceptance.accepted
        query, place = (chain.session[each] for each in ends(accepted))
        allowed = ties.allow(query, place)
        allowed &= (query != place) | (not self._acceptance.is_precise)
        edges = {
            each.number: each
            for cluster, counts in zip(accepted, allowed, strict=True) if counts
            for each in cluster.independent
        }  # fmt: skip
        moved = ties.moved_since(self._ties)
        problem = Problem(chain, initial, edges, self._acceptance.solution_scale, ties.links)
        if final or moved:
            self.solved = self._solver.solve(problem)
            problem = replace(problem, initial=self.solved)
        if not final:
            self.solved = self._solver.update(problem)
        self._ties, self._edges = ties, edges

    # results

    @property
    def edges(self) -> list[GraphEdge]:
        """Return all closures between nodes."""
        found = self._acceptance
        return [
            GraphEdge(each.query, each.place, bool(taken))
            for cluster, taken in zip(found.clusters, found.taken, strict=True)
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
    def splits(self) -> int:
        """Return the number of breaks that closures prove."""
        return len(self.chain.splits)

    @property
    def widest_break(self) -> float:
        """Return the longest distance without accepted closures around a break, m; 0 = none."""
        chain, widest = self.chain, 0.0
        queries = np.array([edge.query for edge in self.edges if edge.accepted], int)
        for node in chain.splits:
            own = queries[chain.recording[queries] == chain.recording[node]]
            behind = own >= node
            at = chain.travelled[own]
            if behind.any() and not behind.all():
                widest = max(widest, float(at[behind].min() - at[~behind].max()))
        return widest

    @property
    def pending(self) -> int:
        """Return the number of closures that wait for their odometry."""
        return len(self._pending)

    def at(
        self, stamp: int, odometry: np.ndarray | None = None, robot: str = ''
    ) -> np.ndarray | None:
        """
        Return the corrected pose at a stamp (ns), shape (7,); None = unknown.

        :param odometry: at the stamp, shape (7,); without it, that between keyframes is
            interpolated.
        """
        found = self.chain.find(stamp, robot)
        if found is None or found[0] >= len(self.solved):
            return None
        node, motion = found
        if odometry is not None:
            motion = inverse(self.chain.transforms[node]) @ matrices(odometry)
        return to_poses(self.solved[node] @ motion)

    def map_to_odom(self, robot: str = '') -> np.ndarray:
        """Return the transform from the newest odometry's frame to the map, shape (7,)."""
        node = self.chain.newest(robot)
        while node >= len(self.solved):
            node = int(self.chain.previous[node])
        if node < 0:
            return np.array([0, 0, 0, 0, 0, 0, 1.0])
        return to_poses(self.solved[node] @ inverse(self.chain.transforms[node]))
