# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions of a pose graph: which ones closures join, and where each one is in the map."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.keyframes import KeyframeChain

JOINS = 8  # closures that join two sessions
AGREEING = 0.25  # part of the closures between sessions that agree at least
SAMPLE = 100  # closures between sessions that vote, and poses that they move, at most
Pair = tuple[int, int]  # numbers of sessions, the lower one first


@dataclass(frozen=True, eq=False)
class Placement:
    """
    Where the sessions are in the map, before it is decided which closures are right.

    :param initial: transforms of all nodes, shape (N, 4, 4): the odometry of each session, moved.
    :param links: first node of each session: the node that it is tied to; -1 = it is an anchor.
    :param pairs: sessions that closures may join.
    """

    initial: np.ndarray
    links: dict[int, int]
    pairs: frozenset[Pair]


def session_pairs(chain: KeyframeChain, closures: ClosureArrays) -> np.ndarray:
    """Return the sessions of the ends of closures, the lower number first, shape (n, 2)."""
    return np.sort(chain.session[np.stack([closures.query, closures.place], axis=1)], axis=1)


def weights(pairs: np.ndarray, queries: np.ndarray) -> dict[Pair, int]:
    """Return at how many queries closures join two sessions."""
    own = np.unique(np.column_stack([pairs, queries])[pairs[:, 0] != pairs[:, 1]], axis=0)
    return dict(Counter((a, b) for a, b, _ in own.tolist()))


def place(chain: KeyframeChain, closures: ClosureArrays, denied: Collection[Pair]) -> Placement:
    """
    Place the sessions, each where closures vote for.

    :param denied: pairs of sessions that do not join.
    """
    T, session = chain.transforms, chain.session
    result, links = T.copy(), {}
    of_pair = session_pairs(chain, closures)
    joined = weights(of_pair, closures.query).items()
    joins = {pair for pair, weight in joined if weight >= JOINS and pair not in denied}
    starts = {int(session[node]): int(node) for node in chain.starts()}
    waiting, known = list(starts), {KeyframeChain.FIXED}
    while waiting:
        number = next(
            (n for n in waiting if any(n in pair and known & {*pair} for pair in joins)),
            waiting[0],
        )
        votes, others = [], []
        for i in np.flatnonzero((of_pair == number).any(axis=1)).tolist():
            if (*of_pair[i].tolist(),) in joins:
                Z = closures.transform[i]
                own, other = int(closures.query[i]), int(closures.place[i])
                if session[own] != number:
                    Z, own, other = inverse(Z), other, own
                if session[other] in known:
                    votes.append(result[other] @ Z @ inverse(T[own]))
                    others.append(other)
        mine, node = session == number, starts[number]
        if votes:
            thin = np.linspace(0, len(votes) - 1, min(SAMPLE, len(votes))).astype(int)
            best = _best(np.array(votes)[thin], T[mine])
            result[mine] = votes[thin[best]] @ T[mine]
            links[node] = others[thin[best]]
        else:
            links[node] = link = chain.before(node)
            if link >= 0:
                result[mine] = result[link] @ inverse(T[node]) @ T[mine]
        waiting.remove(number)
        known.add(number)
    return Placement(result, links, frozenset(joins))


def _best(votes: np.ndarray, transforms: np.ndarray) -> int:
    """Return the transform that moves points as its nearest others do."""
    points = transforms[:: max(1, len(transforms) // 20), :3, 3]
    moved = np.einsum('nij,mj->nmi', votes[:, :3, :3], points) + votes[:, None, :3, 3]
    away = np.linalg.norm(moved[:, None] - moved[None], axis=3).mean(axis=2)
    return int(np.argmin(np.quantile(away, AGREEING, axis=1)))


def extended(chain: KeyframeChain, solved: np.ndarray, links: dict[int, int]) -> np.ndarray:
    """
    Return the last estimate, and for later nodes what the odometry adds to it.

    :param solved: the last estimate, shape (n, 4, 4).
    :param links: as in :class:`Placement`.
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
                before = links.get(int(own[0]), chain.before(int(own[0])))
                start = T[own[0]] if before < 0 else result[before]
            else:
                start = result[before] @ inverse(T[before]) @ T[own[0]]
            result[own] = start @ inverse(T[own[0]]) @ T[own]
    return result
