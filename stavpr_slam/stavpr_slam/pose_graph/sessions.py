# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions of a pose graph: which ones closures join, and where each one is in the map."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.consistency import Cluster
from stavpr_slam.pose_graph.odometry import KeyframeChain


@dataclass(frozen=True)
class Ties:
    """
    How sessions hang together.

    :param joins: pairs of sessions that closures join.
    :param links: first node of each session that no closure joins to others: the node that it is
        tied to loosely; -1 = it is the anchor.
    """

    joins: frozenset[tuple[int, int]] = frozenset()
    links: dict[int, int] = field(default_factory=dict)

    def moved_since(self, before: 'Ties') -> bool:
        """Return whether a session is joined or tied otherwise than before."""
        return self.joins != before.joins or not before.links.items() <= self.links.items()

    def allows(self, a: int, b: int) -> bool:
        """Return whether closures between two sessions count."""
        return a == b or (min(a, b), max(a, b)) in self.joins


def session_pairs(
    chain: KeyframeChain, clusters: Sequence[Cluster]
) -> tuple[list[int], list[int]]:
    """Return the sessions of the queries and of the places of clusters."""
    ends = [(cluster.representative.query, cluster.representative.place) for cluster in clusters]
    query, place = chain.session[np.array(ends, int).reshape(-1, 2)].T.tolist()
    return query, place


def tie(chain: KeyframeChain, accepted: Sequence[Cluster], least: int) -> Ties:
    """
    Tie the sessions of a graph together.

    :param least: closures that join two sessions.
    """
    session = chain.session
    weights: dict[tuple[int, int], float] = defaultdict(float)
    for a, b, cluster in zip(*session_pairs(chain, accepted), accepted, strict=True):
        weights[min(a, b), max(a, b)] += cluster.weight
    joins = frozenset(pair for pair, w in weights.items() if pair[0] != pair[1] and w >= least)
    anchor = KeyframeChain.FIXED if any(a < 0 for a, _ in joins) else 0
    reached, links = {anchor}, {}
    starts = np.flatnonzero((chain.previous < 0) & (session >= 0)).tolist()
    starts.sort(key=lambda node: (session[node] != 0, node))
    left = [int(session[node]) for node in starts]
    start_of = dict(zip(left, starts, strict=True))
    if anchor == 0:
        links[start_of[0]] = -1
    while True:
        reached |= _connected(reached, joins)
        left = [number for number in left if number not in reached]
        if not left:
            return Ties(joins, links)
        node = start_of[left[0]]
        links[node] = _before(chain, node)
        reached.add(left[0])


def _connected(reached: set[int], joins: frozenset[tuple[int, int]]) -> set[int]:
    found = set(reached)
    while True:
        more = {s for pair in joins if found & set(pair) for s in pair} - found
        if not more:
            return found
        found |= more


def _before(chain: KeyframeChain, node: int) -> int:
    """Return the keyframe before a node in the order of arrival; -1 = none."""
    earlier = np.flatnonzero(chain.session[:node] >= 0)
    return int(earlier[-1]) if len(earlier) else -1


def extended(chain: KeyframeChain, solved: np.ndarray, ties: Ties) -> np.ndarray:
    """
    Return the last estimate, and for later nodes what the odometry adds to it.

    :param solved: the last estimate, shape (n, 4, 4).
    :returns: shape (N, 4, 4).
    """
    T, known = chain.transforms, len(solved)
    result = np.empty((len(chain), 4, 4))
    result[:known] = solved
    for node in range(known, len(chain)):
        before = int(chain.previous[node])
        if before >= 0:
            result[node] = result[before] @ inverse(T[before]) @ T[node]
        else:
            result[node] = _start(chain, node, result, ties)
    return result


def placed(chain: KeyframeChain, accepted: Sequence[Cluster], ties: Ties) -> np.ndarray:
    """Return the odometry of all nodes (N, 4, 4), each session where its closures vote for."""
    T, session = chain.transforms, chain.session
    result = np.empty((len(chain), 4, 4))
    known: set[int] = set()
    for number in _order(chain, ties):
        own = session == number
        if number == KeyframeChain.FIXED:
            result[own] = T[own]
        else:
            result[own] = _voted(chain, accepted, number, known, result, ties) @ T[own]
        known.add(number)
    return result


def _order(chain: KeyframeChain, ties: Ties) -> list[int]:
    """Return the sessions, each after one that it is joined or tied to."""
    order: list[int] = []
    roots = [int(chain.session[node]) for node in ties.links]
    if any(a < 0 for a, _ in ties.joins):
        roots.insert(0, KeyframeChain.FIXED)
    for root in roots:
        order.append(root)
        i = len(order) - 1
        while i < len(order):
            order += sorted(
                s for pair in ties.joins if order[i] in pair for s in pair if s not in order
            )
            i += 1
    numbers = [int(s) for s in np.unique(chain.session)]
    return order + [number for number in numbers if number not in order]


def _start(chain: KeyframeChain, node: int, result: np.ndarray, ties: Ties) -> np.ndarray:
    """Return where a session begins that nothing joins: where the last one ended."""
    if chain.session[node] < 0:
        return chain.transforms[node]
    link = ties.links.get(node, -1)
    return chain.transforms[node] if link < 0 else result[link]


def _voted(
    chain: KeyframeChain, accepted: Sequence[Cluster], number: int, known: set[int],
    result: np.ndarray, ties: Ties,
) -> np.ndarray:  # fmt: skip
    """Return the transform of a session into the map that its closures agree on best."""
    votes = []
    for cluster in accepted:
        edge = cluster.representative
        q, p = int(chain.session[edge.query]), int(chain.session[edge.place])
        if q == number and p in known and p != number:
            pose = result[edge.place] @ edge.transform
            votes.append(pose @ inverse(chain.transforms[edge.query]))
        elif p == number and q in known and q != number:
            pose = result[edge.query] @ inverse(edge.transform)
            votes.append(pose @ inverse(chain.transforms[edge.place]))
    if votes:
        return votes[_medoid(np.array(votes), chain.transforms[chain.session == number])]
    node = int(np.flatnonzero(chain.session == number)[0])
    turned: np.ndarray = _start(chain, node, result, ties) @ inverse(chain.transforms[node])
    return turned


def _medoid(votes: np.ndarray, transforms: np.ndarray) -> int:
    """Return the transform that moves points as most others do."""
    points = transforms[:: max(1, len(transforms) // 20), :3, 3]
    moved = np.einsum('nij,mj->nmi', votes[:, :3, :3], points) + votes[:, None, :3, 3]
    away = np.linalg.norm(moved[:, None] - moved[None], axis=3).mean(axis=2)
    return int(np.argmin(np.median(away, axis=1)))
