# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sessions of a pose graph: which ones closures join, and where each one is in the map."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.keyframes import KeyframeChain

Pair = tuple[int, int]  # numbers of sessions, the lower one first


@dataclass(frozen=True, eq=False)
class Placement:
    """
    Places of the sessions in the map, before it is decided which closures are right.

    :param initial: transforms of all nodes, shape (N, 4, 4): the odometry of each session, moved.
    :param links: first node of each session: the node that it is tied to; -1 = it is an anchor.
    :param pairs: sessions that closures may join.
    :param allowed: closures within a session, or of such a pair, shape (n,), bool.
    :param joins: numbers of the closures that place a session, one each.
    """

    initial: np.ndarray
    links: dict[int, int]
    pairs: frozenset[Pair]
    allowed: np.ndarray
    joins: list[int]


def session_pairs(chain: KeyframeChain, closures: ClosureArrays) -> np.ndarray:
    """Return the sessions of the ends of closures, the lower number first, shape (n, 2)."""
    return np.sort(chain.session[np.stack([closures.query, closures.place], axis=1)], axis=1)


def weights(chain: KeyframeChain, closures: ClosureArrays) -> dict[Pair, int]:
    """Return at how many queries closures join two sessions."""
    rows = np.column_stack([session_pairs(chain, closures), closures.query])
    own = np.unique(rows[rows[:, 0] != rows[:, 1]], axis=0)
    return dict(Counter((a, b) for a, b, _ in own.tolist()))


def place(chain: KeyframeChain, closures: ClosureArrays, denied: Collection[Pair]) -> Placement:
    """
    Place the sessions where closures vote for.

    :param denied: pairs of sessions that do not join.
    """
    T, session, Z = chain.transforms, chain.session, closures.transform
    result, links, chosen = T.copy(), {}, list[int]()
    counts = weights(chain, closures).items()
    joins = {pair for pair, weight in counts if weight >= tuning.JOINS and pair not in denied}
    pairs = session_pairs(chain, closures).tolist()
    allowed = np.array([a == b or (a, b) in joins for a, b in pairs], bool)
    starts = {int(session[node]): int(node) for node in chain.starts()}
    waiting, placed = list(starts), {KeyframeChain.FIXED}
    while waiting:
        number = next(
            (n for n in waiting if any(n in pair and placed & {*pair} for pair in joins)),
            waiting[0],
        )
        mine, is_placed, node = session == number, np.isin(session, [*placed]), starts[number]
        ahead = np.flatnonzero(allowed & mine[closures.query] & is_placed[closures.place])
        back = np.flatnonzero(allowed & mine[closures.place] & is_placed[closures.query])
        others = np.concatenate([closures.place[ahead], closures.query[back]])
        if len(others):
            own = np.concatenate([closures.query[ahead], closures.place[back]])
            thin = np.linspace(0, len(own) - 1, min(tuning.SAMPLE, len(own))).astype(int)
            motions = np.concatenate([Z[ahead], inverse(Z[back])])[thin]
            votes = result[others[thin]] @ motions @ inverse(T[own[thin]])
            best = _best(votes, T[mine])
            result[mine], links[node] = votes[best] @ T[mine], int(others[thin[best]])
            chosen.append(int(np.append(ahead, back)[thin[best]]))
        else:
            links[node] = link = chain.before(node)
            if link >= 0:
                result[mine] = result[link] @ inverse(T[node]) @ T[mine]
        waiting.remove(number)
        placed.add(number)
    return Placement(result, links, frozenset(joins), allowed, chosen)


def _best(votes: np.ndarray, transforms: np.ndarray) -> int:
    """Return the transform that moves points as its nearest others do."""
    points = transforms[:: max(1, len(transforms) // 20), :3, 3]
    votes_of_points = np.einsum('nij,mj->nmi', votes[:, :3, :3], points) + votes[:, None, :3, 3]
    away = np.linalg.norm(votes_of_points[:, None] - votes_of_points[None], axis=3).mean(axis=2)
    return int(np.argmin(np.quantile(away, tuning.AGREEING, axis=1)))


def weak_pairs(chain: KeyframeChain, closures: ClosureArrays, placement: Placement) -> set[Pair]:
    """Return the pairs of sessions that too few closures join, of those that are right."""
    counts = weights(chain, closures)
    return {pair for pair in placement.pairs if counts.get(pair, 0) < tuning.JOINS}


def extend(chain: KeyframeChain, solved: np.ndarray, placement: Placement) -> np.ndarray:
    """
    Return the last estimate, and for later nodes what the odometry adds to it.

    :param solved: the last estimate, shape (n, 4, 4).
    :returns: shape (N, 4, 4).
    """
    T, count, initial = chain.transforms, len(solved), placement.initial
    result = np.concatenate([solved, T[count:]])
    later = np.arange(len(chain)) >= count
    for session in np.unique(chain.session[count:]):
        own = np.flatnonzero((chain.session == session) & later)
        first, before = int(own[0]), int(chain.previous[own[0]])
        if session == KeyframeChain.FIXED:
            continue
        if before >= 0:
            result[own] = result[before] @ inverse(T[before]) @ T[own]
        elif 0 <= (link := placement.links.get(first, -1)) < first:
            result[own] = result[link] @ inverse(initial[link]) @ initial[own]
        elif (before := chain.before(first)) >= 0:
            result[own] = result[before] @ inverse(T[first]) @ T[own]
    return result
