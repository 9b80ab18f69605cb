# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph: odometry and loop closures in, a corrected trajectory out."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from stavpr_ros.errors import InputError
from stavpr_ros.pose_graph.closures import Closure, ResolvedClosure
from stavpr_ros.pose_graph.consistency import (
    Cluster,
    ConsistencySettings,
    ConsistentSet,
    Cycles,
    grow,
    largest_consistent,
)
from stavpr_ros.pose_graph.odometry import ChainSettings, KeyframeChain, OdometryNoise
from stavpr_ros.pose_graph.solver import CAUCHY, Solver, WIDE
from stavpr_ros.pose_graph.transforms import body_covariance, inverse, matrices, to_poses

MAX_PENDING = 1000  # closures that wait for their odometry
SCALES = np.geomspace(0.05, 2.0, 16)  # factors on the errors of the odometry that are tried
CAUTION = 1.5  # factor on the estimated errors of the odometry where closures are compared
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


class PoseGraph:
    """
    Keyframes of the odometry and the loop closures between them.

    Add odometry and closures in any order of arrival, and update now and then. ``counts`` has the
    closures by what became of them; ``problems`` the latest reasons of rejected input.

    :raises UnavailableError: GTSAM is not installed.
    """

    def __init__(self, settings: GraphSettings | None = None) -> None:
        self.settings = settings or GraphSettings()
        self._solver = Solver()
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.chain = KeyframeChain(self.settings.keyframes)
        self._consistent = ConsistentSet(self.settings.consistency)
        self._solver.restart()
        self._pending: list[Closure] = []
        self._resolved = 0
        self._clusters: list[Cluster] = []
        self._accepted = np.zeros(0, bool)
        self._changed: set[int] = set()
        self._links: dict[int, int] = {}
        self._joins: frozenset[tuple[int, int]] = frozenset()
        self._edges: dict[int, ResolvedClosure] = {}
        self._scaled_at = 0
        self.scale = 1.0
        self.solved = np.zeros((0, 4, 4))
        self.splits = 0
        self.counts: Counter[str] = Counter()

    @property
    def noise(self) -> OdometryNoise:
        """Return the errors of the odometry as estimated."""
        own = self.settings.noise
        return OdometryNoise(own.translation * self.scale, own.rotation * self.scale)

    @property
    def _cautious_noise(self) -> OdometryNoise:
        own, scale = self.settings.noise, min(1.0, self.scale * CAUTION)
        return OdometryNoise(own.translation * scale, own.rotation * scale)

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
        self._pending.append(closure)
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
            # the frame of the pose moves with the query: its covariance in these axes changes by
            # the small way between image and keyframe, which is left out
            covariance = body_covariance(closure.covariance, measured)
            resolved = ResolvedClosure(
                i, j, to_place @ measured @ inverse(to_query), covariance,
                float(self.chain.travelled[i] + np.linalg.norm(to_query[:3, 3])),
                self._resolved, closure.is_independent,
            )  # fmt: skip
            self._resolved += 1
            cluster = grow(
                self._clusters, resolved, self.chain, self._cautious_noise,
                self.settings.consistency,
            )  # fmt: skip
            self._changed.add(self._clusters.index(cluster))
        self._pending = waiting

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
        if self._changed:
            self._decide()
        joins, links = self._join()
        moved = joins != self._joins or not self._links.items() <= links.items()
        initial = self._place_all(joins, links) if moved else self._extended(links)
        edges = self._select(joins)
        if not moved and (far := self._far(edges, initial)):
            # such edges would have no influence on the robust solution
            moved = True
            self._solver.restart()
            session = self.chain.session
            if any(session[edge.query] != session[edge.place] for edge in far):
                initial = self._place_all(joins, links)
        if final or moved:
            kernels = (WIDE, CAUCHY) if moved else (CAUCHY,)
            initial = self._solver.solve(self.chain, initial, edges, self.noise, links, kernels)
        if not final:
            initial = self._solver.update(self.chain, initial, edges, self.noise, links)
        self.solved, self._joins, self._links, self._edges = initial, joins, links, edges
        return self.solved

    def _decide(self) -> None:
        """Accept and reject clusters; begin a session where they prove a break."""
        noise = self._cautious_noise
        self._accepted = self._consistent.update(self._clusters, self._changed, self.chain, noise)
        self._changed = set()
        everything = set(range(len(self._clusters)))
        if (node := self._break()) is not None:
            self.chain.split(node)
            self.splits += 1
            self._solver.restart()
            self._accepted = self._consistent.update(self._clusters, everything, self.chain, noise)
        accepted = int(self._accepted.sum())
        if self.settings.adapt and accepted >= max(6, 1.3 * self._scaled_at):
            self._scaled_at = accepted
            chosen = np.flatnonzero(self._accepted)
            chosen = chosen[np.unique(np.linspace(0, accepted - 1, 60).astype(int))]
            cycles = Cycles(self.chain, [self._clusters[i].representative for i in chosen])
            scale = cycles.noise_scale(self.settings.noise, SCALES)
            if not 0.7 < scale / self.scale < 1.4:
                self.scale = scale
                self._solver.restart()
                self._accepted = self._consistent.update(
                    self._clusters, everything, self.chain, self._cautious_noise
                )

    def _break(self) -> int | None:
        """Return the keyframe at which rejected closures prove that the odometry has a break."""
        settings = self.settings.consistency
        for session in range(self.chain.sessions):
            own = [
                (cluster.members[0].at, i)
                for i, cluster in enumerate(self._clusters)
                if self.chain.session[cluster.members[0].query] == session
                and cluster.weight >= settings.support
            ]
            order = [i for _, i in sorted(own)]
            accepted = [k for k, i in enumerate(order) if self._accepted[i]]
            if not accepted:
                continue
            for run, first, last in (
                (order[accepted[-1] + 1 :], order[accepted[-1]], None),
                (order[: accepted[0]], None, order[accepted[0]]),
            ):
                agreeing = self._agreeing(run)
                if not agreeing:
                    continue
                between = run[run.index(agreeing[0]) : run.index(agreeing[-1]) + 1]
                if len(between) > 1.2 * len(agreeing):
                    continue
                weight = sum(self._clusters[i].weight for i in agreeing)
                start = self._clusters[agreeing[0]].members[0]
                end = self._clusters[agreeing[-1]].members[-1]
                far = end.at - start.at >= settings.break_distance
                if weight < settings.break_support or not far:
                    continue
                if first is not None:
                    return self._break_between(self._clusters[first].members[-1], start)
                assert last is not None
                return self._break_between(end, self._clusters[last].members[0])
        return None

    def _agreeing(self, run: list[int]) -> list[int]:
        """Return the clusters of a run that agree with each other."""
        if not run:
            return []
        cycles = Cycles(self.chain, [self._clusters[i].representative for i in run])
        noise = self._cautious_noise
        conflicts = np.array([cycles.deviations(k, noise) for k in range(len(run))]) > 9.0
        weights = np.array([self._clusters[i].weight for i in run])
        chosen = largest_consistent(conflicts, weights, np.ones(len(run), bool))
        return [i for i, taken in zip(run, chosen, strict=True) if taken]

    def _break_between(self, last: ResolvedClosure, first: ResolvedClosure) -> int:
        """Return the keyframe after the longest pause between two, or the one in the middle."""
        nodes = np.arange(last.query + 1, first.query + 1)
        nodes = nodes[self.chain.session[nodes] == self.chain.session[first.query]]
        if not len(nodes):
            return first.query
        pauses = self.chain.stamps[nodes] - self.chain.stamps[self.chain.previous[nodes]]
        longest = int(np.argmax(pauses))
        usual = float(np.median(pauses))
        return int(nodes[longest if pauses[longest] > 4 * usual else len(nodes) // 2])

    def _join(self) -> tuple[frozenset[tuple[int, int]], dict[int, int]]:
        """Return the pairs of sessions that closures join, and the loose ties of the others."""
        session = self.chain.session
        weights: Counter[tuple[int, int]] = Counter()
        for i in np.flatnonzero(self._accepted):
            cluster = self._clusters[i]
            ends = session[cluster.representative.query], session[cluster.representative.place]
            a, b = sorted(map(int, ends))
            weights[a, b] += cluster.weight
        least = self.settings.consistency.join_support
        joins = frozenset(pair for pair, w in weights.items() if pair[0] != pair[1] and w >= least)
        anchor = KeyframeChain.FIXED if any(a < 0 for a, _ in joins) else 0
        reached, links = {anchor}, {}
        starts = np.flatnonzero((self.chain.previous < 0) & (session >= 0)).tolist()
        starts.sort(key=lambda node: (session[node] != 0, node))
        left = [int(session[node]) for node in starts]
        start_of = dict(zip(left, starts, strict=True))
        if anchor == 0:
            links[start_of[0]] = -1
        while True:
            reached |= self._connected(reached, joins)
            left = [number for number in left if number not in reached]
            if not left:
                return joins, links
            node = start_of[left[0]]
            links[node] = self._before(node)
            reached.add(left[0])

    @staticmethod
    def _connected(reached: set[int], joins: frozenset[tuple[int, int]]) -> set[int]:
        found = set(reached)
        while True:
            more = {s for pair in joins if found & set(pair) for s in pair} - found
            if not more:
                return found
            found |= more

    def _before(self, node: int) -> int:
        """Return the keyframe before a node in the order of arrival; -1 = none."""
        session = self.chain.session
        while node > 0:
            node -= 1
            if session[node] >= 0:
                return node
        return -1

    def _extended(self, links: dict[int, int]) -> np.ndarray:
        """Return the last estimate, and for later nodes what the odometry adds to it."""
        T, previous, known = self.chain.transforms, self.chain.previous, len(self.solved)
        result = np.empty((len(self.chain), 4, 4))
        result[:known] = self.solved
        for node in range(known, len(self.chain)):
            before = int(previous[node])
            if before >= 0:
                result[node] = result[before] @ inverse(T[before]) @ T[node]
            else:
                result[node] = self._start(node, result, links)
        return result

    def _place_all(self, joins: frozenset[tuple[int, int]], links: dict[int, int]) -> np.ndarray:
        """Return the odometry of all nodes, each session moved to where its closures vote for."""
        T, session = self.chain.transforms, self.chain.session
        result = np.empty((len(self.chain), 4, 4))
        self._solver.restart()
        placed: set[int] = set()
        for number in self._order(joins, links):
            own = session == number
            if number == KeyframeChain.FIXED:
                result[own] = T[own]
            else:
                result[own] = self._voted(number, placed, result, links) @ T[own]
            placed.add(number)
        return result

    def _order(self, joins: frozenset[tuple[int, int]], links: dict[int, int]) -> list[int]:
        """Return the sessions, each after one that it is joined or tied to."""
        session = self.chain.session
        order: list[int] = []
        roots = [int(session[node]) for node in links]
        if any(a < 0 for a, _ in joins):
            roots.insert(0, KeyframeChain.FIXED)
        for root in roots:
            order.append(root)
            i = len(order) - 1
            while i < len(order):
                order += sorted(
                    s for pair in joins if order[i] in pair for s in pair if s not in order
                )
                i += 1
        numbers = [int(s) for s in np.unique(session)]
        return order + [number for number in numbers if number not in order]

    def _start(self, node: int, result: np.ndarray, links: dict[int, int]) -> np.ndarray:
        """Return where a session begins that nothing joins: where the last one ended."""
        if self.chain.session[node] < 0:
            return self.chain.transforms[node]
        link = links.get(node, -1)
        return self.chain.transforms[node] if link < 0 else result[link]

    def _voted(
        self, number: int, placed: set[int], result: np.ndarray, links: dict[int, int]
    ) -> np.ndarray:
        """Return the transform of a session into the map that its closures agree on best."""
        chain, votes = self.chain, []
        for i in np.flatnonzero(self._accepted):
            edge = self._clusters[i].representative
            q, p = int(chain.session[edge.query]), int(chain.session[edge.place])
            if q == number and p in placed and p != number:
                pose = result[edge.place] @ edge.transform
                votes.append(pose @ inverse(chain.transforms[edge.query]))
            elif p == number and q in placed and q != number:
                pose = result[edge.query] @ inverse(edge.transform)
                votes.append(pose @ inverse(chain.transforms[edge.place]))
        if votes:
            return votes[_medoid(np.array(votes), chain.transforms[chain.session == number])]
        node = int(np.flatnonzero(chain.session == number)[0])
        at = self._start(node, result, links)
        turned: np.ndarray = at @ inverse(chain.transforms[node])
        return turned

    def _select(self, joins: frozenset[tuple[int, int]]) -> dict[int, ResolvedClosure]:
        """Return the edges of the solution by their numbers."""
        session = self.chain.session
        chosen: dict[int, ResolvedClosure] = {}
        for i in np.flatnonzero(self._accepted):
            cluster = self._clusters[i]
            edge = cluster.representative
            a, b = sorted((int(session[edge.query]), int(session[edge.place])))
            if a == b or (a, b) in joins:
                chosen |= {each.number: each for each in independent(cluster)}
        return chosen

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
        return [
            GraphEdge(each.query, each.place, bool(taken))
            for cluster, taken in zip(self._clusters, self._accepted, strict=False)
            for each in cluster.members
        ]

    @property
    def accepted(self) -> int:
        """Return the number of accepted closures."""
        pairs = zip(self._clusters, self._accepted, strict=False)
        return sum(len(cluster.members) for cluster, taken in pairs if taken)

    @property
    def rejected(self) -> int:
        """Return the number of rejected closures."""
        return self._resolved - self.accepted

    @property
    def used(self) -> dict[int, ResolvedClosure]:
        """Return the edges of the solution by their numbers."""
        return self._edges

    @property
    def pending(self) -> int:
        """Return the number of closures that wait for their odometry."""
        return len(self._pending)

    def at(self, stamp: int) -> np.ndarray | None:
        """Return the corrected pose at a stamp (ns), shape (7,); None = unknown."""
        found = self.chain.find(stamp)
        if found is None or found[0] >= len(self.solved):
            return None
        return to_poses(self.solved[found[0]] @ found[1])

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


def independent(cluster: Cluster) -> list[ResolvedClosure]:
    """Return the closures of a cluster whose errors do not correlate; at least the best one."""
    marked = [each for each in cluster.members if each.is_independent]
    return marked or [cluster.representative]


def _medoid(votes: np.ndarray, transforms: np.ndarray) -> int:
    """Return the transform that moves points as most others do."""
    points = transforms[:: max(1, len(transforms) // 20), :3, 3]
    moved = np.einsum('nij,mj->nmi', votes[:, :3, :3], points) + votes[:, None, :3, 3]
    away = np.linalg.norm(moved[:, None] - moved[None], axis=3).mean(axis=2)
    return int(np.argmin(np.median(away, axis=1)))
