# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: odometry and loop closures in, a corrected trajectory out."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from stavpr_ros.checks import require_shape
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph import breaks, solution, tuning
from stavpr_slam.pose_graph.blocks import NOTHING
from stavpr_slam.pose_graph.closures import between_nodes, Closure, ClosureArrays
from stavpr_slam.pose_graph.decision import Decision, events
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.sessions import extend
from stavpr_slam.pose_graph.transforms import body_covariance

MAX_PENDING = 1000  # closures that wait for their odometry


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
        self._sources: list[Closure] = []  # those between nodes
        self._closures: ClosureArrays = between_nodes([])  # of them
        self._solution = solution.EMPTY
        self._searched = 0  # closures of the last search
        self.counts: Counter[str] = Counter()

    @property
    def solved(self) -> np.ndarray:
        """Return the transforms of the nodes in the map, by the last update, (n, 4, 4)."""
        return self._solution.nodes

    @property
    def scales(self) -> np.ndarray:
        """Return the factor on the errors of the odometry of each robot."""
        return self._solution.scales

    @property
    def scale(self) -> float:
        """Return the factor on the errors of the odometry that closures have shown, the worst."""
        return float(self.scales.max(initial=tuning.TIGHT))

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
        waiting, rows = [], []
        for closure in self._pending:
            row = self._row(closure)
            if row is not None:
                self._sources.append(closure)
                rows.append(row)
                continue
            ahead = self.chain.is_ahead
            if ahead(closure.query_stamp, closure.query_robot) or (
                not closure.map_id and ahead(closure.place_stamp, closure.place_robot)
            ):
                waiting.append(closure)
            else:
                self.counts['unknown stamp'] += 1
        self._pending = waiting
        both = np.concatenate([self._closures, between_nodes(rows)])
        self._closures = both.view(np.recarray)

    def _row(self, closure: Closure) -> tuple[Any, ...] | None:
        query = self.chain.find(closure.query_stamp, closure.query_robot)
        place = self.chain.find(closure.place_stamp, closure.place_robot)
        if closure.map_id and closure.place_pose is not None:
            own = closure.map_id, closure.place_stamp, closure.place_pose
            place = self.chain.fixed(*own), np.eye(4)
        if query is None or place is None or query[0] == place[0]:
            return None
        (i, to_query), (j, to_place) = query, place
        motion = matrices(closure.pose)
        # the frame of the pose moves with the query: its covariance in these axes changes by
        # the short motion between image and keyframe, which is left out
        return (
            i, j, to_place @ motion @ inverse(to_query),
            body_covariance(closure.covariance, motion), closure.is_independent,
        )  # fmt: skip

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
        last = self._solution
        solved = len(last.accepted)
        if not final and len(self._sources) == solved:
            nodes = extend(self.chain, last.nodes, last.placement)
            self._solution = replace(last, nodes=nodes)
            return self.solved
        try:
            self._solution = self._solve(final)
        except np.linalg.LinAlgError:
            self.counts['failed'] += len(self._sources) - solved
            del self._sources[solved:]
            self._closures = self._closures[:solved]
            self._solution = self._solve(final)
        return self.solved

    def _solve(self, final: bool) -> solution.Solution:
        last, graph = self._solution, (self.chain, self._closures)
        if self.settings.measured:
            return solution.solve_measured(*graph, NOTHING if final else last.consensus)
        is_search = final or len(self._sources) > tuning.SEARCH * self._searched
        if isinstance(last.consensus, Decision) and not is_search:
            return solution.add_closures(*graph, last, last.consensus)
        for node in [*self.chain.splits][::-1]:
            self._split(node, False)
        best = solution.solve_drives(*graph)
        while self.splits < tuning.MAX_BREAKS and (better := self._with_break(best)):
            best = better
        self._searched = len(self._sources)
        return replace(best, trials=[])

    def _split(self, node: int, begins: bool) -> None:
        """Begin a session at a node, or end it; closures between it and the one before change."""
        if begins:
            before = int(self.chain.previous[node])
            self.chain.split(node)
        else:
            before = self.chain.before(node)
            self.chain.merge_session(node)
        beside = np.isin((self._closures.query, self._closures.place), (before, node)).any(axis=0)
        for number in np.flatnonzero(beside):
            row = self._row(self._sources[number])
            if row is not None:
                self._closures[number] = row

    def _with_break(self, before: solution.Solution) -> solution.Solution | None:
        """Begin a session where closures prove that the robot was carried; None = nowhere."""
        if (~before.accepted).sum() < tuning.GAIN:
            return None
        graph, robots = (self.chain, self._closures), len(self.chain.robots)
        factors = [np.full(robots, scale) for scale in tuning.SCALES[1:4:2]]
        for node in breaks.find(self.chain, before.trials, self._closures)[: tuning.SETS]:
            self._split(node, True)
            # two factors show whether a search of all is of use
            trials = (solution.solve_drives(*graph, scales) for scales in factors)
            if any(self._proves(before, trial, node) for trial in trials):
                after = solution.solve_drives(*graph)
                if self._proves(before, after, node):
                    return after
            self._split(node, False)
        return None

    def _proves(self, before: solution.Solution, after: solution.Solution, node: int) -> bool:
        """
        Return whether closures prove a break: more of them agree, with as much evidence.

        A break explains any false run behind it: closures on both sides agree, and nearly all that
        agreed before; closures of the largest new event do not count.
        """
        agreed, agree, query = before.accepted, after.accepted, self._closures.query
        sessions = self.chain.session[[self.chain.before(node), node]]
        sides = (self.chain.session[query[agree], None] == sessions).sum(axis=0)
        if sides.min() < tuning.SUPPORT or (agreed & ~agree).sum() >= tuning.GAIN:
            return False
        numbers = events(self.chain, query, self._closures.place)
        sizes = np.bincount(numbers[agree & ~np.isin(numbers, numbers[agreed])])
        more = agree.sum() - agreed.sum() - sizes.max(initial=0)
        return bool(more >= tuning.GAIN and after.gain >= before.gain)

    # results

    @property
    def edges(self) -> list[GraphEdge]:
        """Return all closures between nodes."""
        ends = self._closures.query, self._closures.place, self._solution.accepted
        rows = zip(*(values.tolist() for values in ends), strict=False)
        return [GraphEdge(*row) for row in rows]

    @property
    def accepted(self) -> int:
        """Return the number of accepted closures."""
        return int(self._solution.accepted.sum())

    @property
    def rejected(self) -> int:
        """Return the number of rejected closures."""
        return len(self._solution.accepted) - self.accepted

    @property
    def used(self) -> ClosureArrays:
        """Return the edges of the solution, see :func:`between_nodes`."""
        return self._closures[: len(self._solution.counted)][self._solution.counted]

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
        place = self.chain.find(stamp, robot)
        if place is None or place[0] >= len(self.solved):
            return None
        node, motion = place
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


def optimize(
    stamps: np.ndarray,
    odometry: np.ndarray,
    closures: Sequence[Closure],
    settings: GraphSettings | None = None,
) -> tuple[np.ndarray, PoseGraph]:
    """
    Correct a recorded drive by its loop closures; the same input gives the same result.

    :param stamps: of the odometry, ns, shape (N,).
    :param odometry: poses, shape (N, 7).
    :returns: the corrected poses (N, 7), NaN where the graph has no odometry, and the graph.
    :raises InputError: other shapes.
    """
    require_shape('odometry', odometry, f'{len(stamps)} 7')
    graph = PoseGraph(settings)
    for stamp, pose in zip(stamps.tolist(), odometry, strict=True):
        graph.add_odometry(stamp, pose)
    for closure in closures:
        graph.add_closure(closure)
    graph.update(final=True)
    poses = [graph.at(t, pose) for t, pose in zip(stamps.tolist(), odometry, strict=True)]
    missing = np.full(7, np.nan)
    return np.array([missing if pose is None else pose for pose in poses]), graph
