# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Breaks of the odometry: closures prove that it missed a motion, as the robot was carried."""

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.decision import Decision
from stavpr_slam.pose_graph.keyframes import KeyframeChain


def find(chain: KeyframeChain, trials: list[Decision], closures: ClosureArrays) -> list[int]:
    """Return the nodes behind breaks for which closures vote, the most on both sides first."""
    votes = dict[int, int]()
    for trial in trials:
        for before, behind in _agreeing(chain, trial.nodes, trial.inliers, closures):
            support = min(len(before), len(behind))
            if support >= tuning.SUPPORT:
                node = _between(chain, closures.query, before, behind)
                votes[node] = max(votes.get(node, 0), support)
    return sorted(votes, key=lambda node: -votes[node])


def _agreeing(
    chain: KeyframeChain, nodes: np.ndarray, accepted: np.ndarray, closures: ClosureArrays
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return closures before a break, and those rejected by a solution that agree behind it."""
    query, place, result = closures.query, closures.place, []
    for session in np.unique(chain.session[query]).tolist():
        here = chain.session[query] == session
        own = np.flatnonzero(~accepted & here)
        own = own[:: len(own) // tuning.COMPARED + 1]
        votes = nodes[place[own]] @ closures.transform[own] @ inverse(nodes[query[own]])
        points = nodes[query[own], :3, 3].T
        at = votes[:, :3, :3] @ points + votes[:, :3, 3:]
        wide = np.linalg.eigvalsh(closures.covariance[own, 3:, 3:])[:, -1] ** 0.5
        away = np.linalg.norm(at - np.einsum('nin->in', at), axis=1)
        agree = (away < tuning.SPREAD * (1 + np.maximum.outer(wide, wide))).astype(np.float32)

        def most(among: np.ndarray, agree: np.ndarray = agree) -> np.ndarray:
            """Return the rejected closures that agree with most others among them."""
            return (agree[np.argmax(agree @ among * among)] > 0) & among

        free = np.ones(len(own), bool)
        for _ in range(tuning.SETS if len(own) else 0):
            members = most(free)
            best, start = own[members], query[own[members]].min(initial=len(chain))
            before = np.flatnonzero(accepted & here & (query < start))
            if not len(before):
                before = own[most(query[own] < start)]
            result.append((before, best))
            free &= ~members
    return result


def _between(
    chain: KeyframeChain, query: np.ndarray, before: np.ndarray, behind: np.ndarray
) -> int:
    """Return the node behind the longest pause between closures, else in the middle."""
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
