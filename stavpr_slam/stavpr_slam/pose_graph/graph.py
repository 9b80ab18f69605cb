# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: odometry and loop closures in, a corrected trajectory out."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph import breaks
from stavpr_slam.pose_graph.closures import between_nodes, Closure, ClosureArrays
from stavpr_slam.pose_graph.decision import Decider, Decision, TIGHT
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.network import Network
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.sessions import extended, JOINS, Pair, place, session_pairs, weights
from stavpr_slam.pose_graph.transforms import body_covariance

MAX_PENDING = 1000  # closures that wait for their odometry
GROWN = 1.1  # factor on the number of closures from which scales and breaks are searched anew
MAX_BREAKS = 4  # that are searched


@dataclass(frozen=True)
class GraphSettings:
    """
    Settings of a :class:`PoseGraph`.

    :param noise: errors of the odometry where its messages have none; closures show the factor.
    :param measured: each closure is a measurement that is right or wrong on its own, and the
        errors of the odometry are as given: graphs of other programs.
    """

    keyframes: ChainSettings = field(default_factory=ChainSettings)
    noise: OdometryNoise = field(default_factory=OdometryNoise)
    measured: bool = False


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
    """

    def __init__(self, settings: GraphSettings | None = None) -> None:
        self.settings = settings or GraphSettings()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.chain = KeyframeChain(self.settings.keyframes, self.settings.noise)
        self._pending: list[Closure] = []
        self._known: list[Closure] = []  # those between nodes
        self._closures: ClosureArrays = between_nodes([])  # of them
        self._solved_closures = 0  # of them, in the last solution
        self._searched_at = 0, 0  # closures, and rejected ones, of the last search
        self._links: dict[int, int] = {}
        self._pairs = frozenset[Pair]()  # of sessions that are joined
        self._decision: Decision | None = None
        self._taken = np.zeros(0, bool)
        self._solutions: list[tuple[np.ndarray, np.ndarray, int]] = []
        self._counted = np.zeros(0, int)  # numbers of the edges of the solution
        self.scales = np.zeros(0)
        self.solved = np.zeros((0, 4, 4))
        self.counts: Counter[str] = Counter()

    @property
    def scale(self) -> float:
        """Return the factor on the errors of the odometry that closures have shown, the worst."""
        return float(self.scales.max(initial=TIGHT))

    @property
    def refused(self) -> float:
        """Return the evidence against a correction that is not published; 0 = there is none."""
        return self._decision.rejected if self._decision else 0.0

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
            self._pending.append(closure.checked())
        except InputError:
            self.counts['invalid'] += 1
            raise
        if len(self._pending) > MAX_PENDING:
            self._resolve()
        if len(self._pending) > MAX_PENDING:
            del self._pending[0]
            self.counts['unknown stamp'] += 1

    def _resolve(self) -> None:
        """Find the nodes of the closures that wait."""
        waiting, found = [], []
        for closure in self._pending:
            resolved = self._resolved(closure)
            if resolved is not None:
                self._known.append(closure)
                found.append(resolved)
                continue
            ahead = self.chain.is_ahead
            if ahead(closure.query_stamp, closure.query_robot) or (
                not closure.map_id and ahead(closure.place_stamp, closure.place_robot)
            ):
                waiting.append(closure)
            else:
                self.counts['unknown stamp'] += 1
        self._pending = waiting
        both = np.concatenate([self._closures, between_nodes(found)])
        self._closures = both.view(np.recarray)

    def _resolved(self, closure: Closure) -> tuple[Any, ...] | None:
        query = self.chain.find(closure.query_stamp, closure.query_robot)
        place = self._place(closure)
        if query is None or place is None or query[0] == place[0]:
            return None
        (i, to_query), (j, to_place) = query, place
        measured = matrices(closure.pose)
        # the frame of the pose moves with the query: its covariance in these axes changes by
        # the short motion between image and keyframe, which is left out
        return (
            i, j, to_place @ measured @ inverse(to_query),
            body_covariance(closure.covariance, measured), closure.is_independent,
        )  # fmt: skip

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
            if final or len(self._known) != self._solved_closures:
                self._update(final)
            else:
                self.solved = extended(self.chain, self.solved, self._links)
        except (np.linalg.LinAlgError, FloatingPointError):
            failed = len(self._known) - self._solved_closures
            if not failed:
                raise
            self.counts['failed'] += failed
            del self._known[self._solved_closures :]
            self._closures = self._closures[: self._solved_closures]
            self._update(final)
        self._solved_closures = len(self._known)
        return self.solved

    def _update(self, final: bool) -> None:
        """Decide on all closures anew, and estimate."""
        known, rejected = self._searched_at
        if (
            final or len(self._known) > GROWN * known
            or self.rejected > max(GROWN * rejected, breaks.SUPPORT)
        ):  # fmt: skip
            for node in self.chain.splits[::-1]:
                self._split(breaks.Break(node, 0), False)
            self._decide(True)
            for _ in range(0 if self.settings.measured else MAX_BREAKS):
                if not self._search_break():
                    break
            self._searched_at = len(self._known), self.rejected
        elif not self._follow():
            self._decide(False)

    def _follow(self) -> bool:
        """Add new closures to the estimate if all agree with it; return whether they do."""
        chain, known = self.chain, len(self._taken)
        if not len(self._counted) or len(self._links) < len(chain.starts()):
            return False
        pairs = session_pairs(chain, self._closures[known:]).tolist()
        if any(a != b and (a, b) not in self._pairs for a, b in pairs):
            return False
        initial = extended(chain, self.solved, self._links)
        number = np.arange(len(self._closures))
        numbers = np.concatenate([np.flatnonzero(self._taken), number[known:]])
        used = self._closures[numbers]
        network = Network(chain, initial, used, self._links)
        decider = Decider(chain, network, initial, self.settings.measured)
        residuals = network.residuals(decider.odometry(self.scales), network.values(initial))
        if (residuals[self.accepted :] > network.limit).any():
            return False
        counted = decider.counted(np.ones(len(used), bool), used.is_independent)
        values, _, _ = decider.solved(self.scales, network.values(initial), counted)
        self._taken = np.append(self._taken, number[known:] >= known)
        self._counted = numbers[counted]
        self.solved = network.nodes(values)
        return True

    def _split(self, found: breaks.Break, begins: bool) -> None:
        if begins:
            self.chain.split(found.node, found.stamp)
        else:
            self.chain.merge_session(found.node)
        for number, closure in enumerate(self._known):
            resolved = self._resolved(closure)
            if resolved is not None:
                self._closures[number] = resolved

    def _search_break(self) -> bool:
        """Begin a session where closures prove that the robot was carried."""
        before = self._decision
        assert before is not None
        found: list[breaks.Break] = []
        for number, (solved, agreeing, node) in enumerate(self._solutions):
            if any(np.array_equal(agreeing, other) for _, other, _ in self._solutions[:number]):
                continue
            candidates = [breaks.find(self.chain, solved, agreeing, self._closures)]
            if node >= 0:
                candidates.append(
                    breaks.strained(self.chain, agreeing, self._closures.query, node)
                )
            for each in candidates:
                if each and all(abs(each.node - other.node) > breaks.GAP for other in found):
                    found.append(each)
        for each in found[:MAX_BREAKS]:
            self._split(each, True)
            self._decide(True)
            after = self._decision
            assert after is not None
            gain = after.evidence - after.chance - before.evidence + before.chance
            more = int(after.taken.sum()) - int(before.taken.sum())
            if more >= breaks.GAIN or gain > breaks.EVIDENCE:
                return True
            self._split(each, False)
        if found:
            self._decide(True)
        return False

    def _decide(self, searches: bool) -> None:
        """
        Decide on the closures, and estimate all nodes.

        :param searches: the errors of the odometry as well.
        """
        chain, denied = self.chain, set[Pair]()
        while True:
            placement = place(chain, self._closures, denied)
            of_pair = session_pairs(chain, self._closures)
            allowed = np.array(
                [a == b or (a, b) in placement.pairs for a, b in of_pair.tolist()], bool
            )
            used = self._closures[allowed]
            network = Network(chain, placement.initial, used, placement.links)
            decider = Decider(chain, network, placement.initial, self.settings.measured)
            if searches or self._decision is None:
                decision = decider.decide(len(chain.robots))
            else:
                decision = decider.at(self._decision.scales)
            taken = used[decision.taken]
            joined = weights(session_pairs(chain, taken), taken.query)
            few = {pair for pair in placement.pairs if joined.get(pair, 0) < JOINS}
            if not few:
                break
            denied |= few
        self._decision, self._links, self._pairs = decision, placement.links, placement.pairs
        self._taken = allowed.copy()
        self._taken[allowed] = decision.taken
        self._solutions = []
        for each in decider.tried if searches else ():
            agreeing = allowed.copy()
            agreeing[allowed] = each.agreeing
            self._solutions.append((network.nodes(each.corrected), agreeing, each.strained))
        self.scales, values = decision.scales, decision.values
        self._counted = np.zeros(0, int)
        if decision.taken.any():
            found = decider.estimate(decision, used.is_independent, searches)
            self.scales, values, counted = found
            self._counted = np.flatnonzero(allowed)[counted]
            if self.settings.measured:
                self._taken[allowed] = counted
        self.solved = network.nodes(values)

    # results

    @property
    def edges(self) -> list[GraphEdge]:
        """Return all closures between nodes."""
        ends = self._closures.query, self._closures.place, self._taken
        return [GraphEdge(*row) for row in zip(*(each.tolist() for each in ends), strict=False)]

    @property
    def accepted(self) -> int:
        """Return the number of accepted closures."""
        return int(self._taken.sum())

    @property
    def rejected(self) -> int:
        """Return the number of rejected closures."""
        return len(self._taken) - self.accepted

    @property
    def used(self) -> ClosureArrays:
        """Return the edges of the solution, see :func:`between_nodes`."""
        return self._closures[self._counted]

    @property
    def splits(self) -> int:
        """Return the number of breaks that closures prove."""
        return len(self.chain.splits)

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
