# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions of a pose graph: which ones closures join, and where each one is in the map."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.clusters import Cluster, ends
from stavpr_slam.pose_graph.keyframes import KeyframeChain


@dataclass(frozen=True)
class Ties:
    """
    How sessions are tied together.

    :param joins: pairs of sessions that closures join, the lower one first.
    :param links: first node of each session that no closure joins to others: the node that it is
        tied to loosely; -1 = it is an anchor, the first session of its robot.
    """

    joins: frozenset[tuple[int, int]] = frozenset()
    links: dict[int, int] = field(default_factory=dict)

    def moved_since(self, before: 'Ties') -> bool:
        """Return whether a session is joined or tied otherwise than before."""
        return self.joins != before.joins or not before.links.items() <= self.links.items()

    def allow(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return whether closures between sessions count, shape (n,), bool."""
        pairs = zip(np.minimum(a, b).tolist(), np.maximum(a, b).tolist(), strict=True)
        return np.array([pair[0] == pair[1] or pair in self.joins for pair in pairs], bool)


def tie(chain: KeyframeChain, accepted: Sequence[Cluster], least: int) -> Ties:
    """
    Tie the sessions of a graph together.

    :param least: closures that join two sessions.
    """
    session, weights = chain.session, defaultdict[tuple[int, int], int](int)
    for cluster, *pair in zip(accepted, *(session[each] for each in ends(accepted)), strict=True):
        weights[int(min(pair)), int(max(pair))] += cluster.weight
    joins = frozenset(pair for pair, w in weights.items() if pair[0] != pair[1] and w >= least)
    reached, links = {each for pair in joins for each in pair if each < 0}, {}
    for node in chain.starts().tolist():
        while more := {each for pair in joins if reached & set(pair) for each in pair} - reached:
            reached |= more
        if session[node] not in reached:
            reached.add(int(session[node]))
            links[node] = chain.before(node)
    return Ties(joins, links)


def extended(chain: KeyframeChain, solved: np.ndarray, ties: Ties) -> np.ndarray:
    """
    Return the last estimate, and for later nodes what the odometry adds to it.

    :param solved: the last estimate, shape (n, 4, 4).
    :returns: shape (N, 4, 4).
    """
    T, known, number = chain.transforms, len(solved), np.arange(len(chain))
    result = T.copy()
    result[:known] = solved
    for session in np.unique(chain.session[known:]).tolist():
        own = number[(chain.session == session) & (number >= known)]
        before = int(chain.previous[own[0]])
        if session >= 0:
            if before < 0:
                moved = _start(chain, int(own[0]), result, ties) @ inverse(T[own[0]])
            else:
                moved = result[before] @ inverse(T[before])
            result[own] = moved @ T[own]
    return result


def placed(chain: KeyframeChain, accepted: Sequence[Cluster], ties: Ties) -> np.ndarray:
    """Return the odometry of all nodes (N, 4, 4), each session where its closures vote for."""
    T, session = chain.transforms, chain.session
    result = T.copy()
    known = {KeyframeChain.FIXED}
    starts = {int(session[node]): int(node) for node in chain.starts()}
    roots = [int(session[node]) for node in ties.links]
    while len(known) <= len(starts):
        joined = [each for pair in ties.joins if known & set(pair) for each in set(pair) - known]
        left = [each for each in roots if each not in known]
        number = min(joined) if joined else left[0]
        votes, own = _votes(chain, accepted, number, known, result), session == number
        node = starts[number]
        if len(votes):
            moved = votes[_medoid(votes, T[own])]
        else:
            moved = _start(chain, node, result, ties) @ inverse(T[node])
        result[own] = moved @ T[own]
        known.add(number)
    return result


def _start(chain: KeyframeChain, node: int, result: np.ndarray, ties: Ties) -> np.ndarray:
    """Return where a session begins that nothing joins: where the last one ended."""
    link = ties.links.get(node, -1)
    return chain.transforms[node] if link < 0 else result[link]


def _votes(
    chain: KeyframeChain, accepted: Sequence[Cluster], number: int, known: set[int],
    result: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the transforms of a session into the map by its closures, shape (n, 4, 4)."""
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
    return np.array(votes)


def _medoid(votes: np.ndarray, transforms: np.ndarray) -> int:
    """Return the transform that moves points as most others do."""
    points = transforms[:: max(1, len(transforms) // 20), :3, 3]
    moved = np.einsum('nij,mj->nmi', votes[:, :3, :3], points) + votes[:, None, :3, 3]
    away = np.linalg.norm(moved[:, None] - moved[None], axis=3).mean(axis=2)
    return int(np.argmin(np.median(away, axis=1)))
