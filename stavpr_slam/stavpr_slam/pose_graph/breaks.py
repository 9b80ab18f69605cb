# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Breaks of the odometry: closures prove that it missed a motion, as the robot was carried."""

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.keyframes import KeyframeChain


def find(
    chain: KeyframeChain, solved: np.ndarray, accepted: np.ndarray, closures: ClosureArrays
) -> list[int]:
    """
    Return the breaks that let most rejected closures agree, and then most of the rest.

    :param solved: transforms of all nodes by the robust solution, (N, 4, 4).
    :param accepted: whether each closure agrees with it, shape (n,).
    """
    query, place = closures.query, closures.place
    candidates: list[tuple[int, int | None]] = []
    for session in np.unique(chain.session[query]).tolist():
        here = chain.session[query] == session
        own = np.flatnonzero(~accepted & here)
        own = own[:: len(own) // tuning.COMPARED + 1]
        if len(own) < tuning.SUPPORT:
            continue
        votes = solved[place[own]] @ closures.transform[own] @ inverse(solved[query[own]])
        points = solved[query[own], :3, 3].T
        at = votes[:, :3, :3] @ points + votes[:, :3, 3:]
        wide = np.linalg.eigvalsh(closures.covariance[own, 3:, 3:])[:, -1] ** 0.5
        away = np.linalg.norm(at - np.einsum('nin->in', at), axis=1)
        agree = (away < tuning.SPREAD * (1 + np.maximum.outer(wide, wide))).astype(np.float32)

        def most(among: np.ndarray, agree: np.ndarray = agree) -> np.ndarray:
            """Return the rejected closures that agree with most others among them."""
            result: np.ndarray = (agree[np.argmax(agree @ among * among)] > 0) & among
            return result

        free = np.ones(len(own), bool)
        for _ in range(tuning.SETS):
            nodes = np.unique(query[own])[:: tuning.SUPPORT // 4]
            members = max((most((query[own] >= node) & free) for node in nodes), key=np.sum)
            best, start = own[members], query[own[members]].min(initial=len(chain))
            before = np.flatnonzero(accepted & here & (query < start))
            if not len(before):
                before = own[most(query[own] < start)]
            candidates.append((-len(best), _between(chain, query, before, best)))
            free &= ~members
    candidates = sorted(candidates, key=lambda candidate: candidate[0])[: tuning.SETS]
    return [node for _, node in candidates if node is not None]


def find_at_bend(
    chain: KeyframeChain, accepted: np.ndarray, query: np.ndarray, node: int
) -> int | None:
    """Return the break between the closures beside a bend of the odometry, as :func:`find`."""
    if node < 0:
        return None
    own = accepted & (chain.session[query] == chain.session[node])
    before, behind = np.flatnonzero(own & (query < node)), np.flatnonzero(own & (query >= node))
    return _between(chain, query, before, behind)


def _between(
    chain: KeyframeChain, query: np.ndarray, before: np.ndarray, behind: np.ndarray
) -> int | None:
    """Return the node behind the longest pause between closures, else in the middle."""
    if min(len(before), len(behind)) < tuning.SUPPORT:
        return None
    last, first = query[before].max(), query[behind].min()
    at, number = chain.travelled, np.arange(len(chain))
    own = (chain.session == chain.session[first]) & (chain.previous >= 0)
    nodes = np.flatnonzero(own & (at >= at[last] - tuning.GAP) & (at <= at[first] + tuning.GAP))
    pauses = chain.stamps[nodes] - chain.stamps[chain.previous[nodes]]
    node = nodes[np.argmax(pauses)]
    if pauses.max() <= tuning.PAUSE * np.median(pauses):
        nodes = np.flatnonzero(own & (number > last) & (number <= first))
        node = nodes[len(nodes) // 2]
    return int(node)
