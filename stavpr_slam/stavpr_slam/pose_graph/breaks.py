# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where closures prove that the odometry missed a motion: the robot was carried."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import deviations, ResolvedClosure
from stavpr_slam.pose_graph.keyframes import KeyframeChain

GAIN = 24  # closures more that agree if there is a break, or
EVIDENCE = 10.0  # so much more evidence
SUPPORT, DISTANCE = 32, 40.0  # closures on each side of a break, and meters that they are along
NEAR = 2.0  # meters, and deviations of two closures, that agreeing ones are apart
STOPPED = math.log(10)  # evidence of a stop: elsewhere, one image in ten is of a stop
PAUSE = 4.0  # times the usual time between keyframes: the robot was carried then
CLEAR = 4.0  # a closure belongs to the side that it deviates from so many times less
WRONG_SIDE = 0.1  # cost of a closure on the wrong side of a break, in logarithms of a change
GAP = 15.0  # meters before and behind the closures at a break where it may be


@dataclass(frozen=True)
class Break:
    """
    A motion that the odometry missed.

    :param node: first keyframe after it.
    :param stamp: from which odometry and images are after it, ns.
    """

    node: int
    stamp: int


def find(
    chain: KeyframeChain,
    solved: np.ndarray,
    taken: np.ndarray,
    closures: Sequence[ResolvedClosure],
    changes: Mapping[int, float],
) -> Break | None:
    """
    Return the break that lets most rejected closures agree; None = none.

    :param solved: transforms of all nodes by the robust solution, (N, 4, 4).
    :param taken: whether each closure agrees with it, shape (n,).
    :param changes: see :func:`_locate`.
    """
    query, place = (
        np.array([getattr(each, end) for each in closures], int) for end in ('query', 'place')
    )
    best, before = np.zeros(0, int), np.zeros(0, int)
    for session in np.unique(chain.session[query]).tolist():
        here = chain.session[query] == session
        own = np.flatnonzero(~taken & here)
        rows = [closures[i] for i in own.tolist()]
        if len(own) < SUPPORT:
            continue
        Z = np.array([each.transform for each in rows])
        moved = solved[place[own]] @ Z @ inverse(solved[query[own]])
        points = solved[query[own], :3, 3].T
        at = moved[:, :3, :3] @ points + moved[:, :3, 3:]
        wide = [np.linalg.eigvalsh(each.covariance[3:, 3:])[-1] ** 0.5 for each in rows]
        away = np.linalg.norm(at - np.einsum('nin->in', at), axis=1)
        agree = (away < NEAR * (1 + np.maximum.outer(wide, wide))).astype(np.float32)

        def most(among: np.ndarray, agree: np.ndarray = agree) -> np.ndarray:
            """Return the rejected closures among some that agree with most of them."""
            result: np.ndarray = (agree[np.argmax(agree @ among * among)] > 0) & among
            return result

        for node in np.unique(query[own])[:: SUPPORT // 4].tolist():
            # a closure across the break: its place is not behind, or of another session
            across = (chain.session[place[own]] != session) | (place[own] < node)
            members = most((query[own] >= node) & across)
            if members.sum() > len(best):
                best = own[members]
                before = np.flatnonzero(taken & here & (query < query[best].min()))
                if not len(before):
                    before = own[most(query[own] < query[best].min())]
    return _between(chain, closures, before, best, solved, changes)


def strained(
    chain: KeyframeChain, solved: np.ndarray, taken: np.ndarray,
    closures: Sequence[ResolvedClosure], node: int, changes: Mapping[int, float],
) -> Break | None:  # fmt: skip
    """
    Return the break between the closures beside a node that the solution bends the odometry at.

    Parameters as of :func:`find`.
    """
    query = np.array([each.query for each in closures], int)
    own = taken & (chain.session[query] == chain.session[node])
    before, behind = np.flatnonzero(own & (query < node)), np.flatnonzero(own & (query >= node))
    return _between(chain, closures, before, behind, solved, changes)


def _between(
    chain: KeyframeChain, closures: Sequence[ResolvedClosure], before: np.ndarray,
    behind: np.ndarray, solved: np.ndarray, changes: Mapping[int, float],
) -> Break | None:  # fmt: skip
    query = np.array([each.query for each in closures], int)
    for side in (before, behind):
        if len(side) < SUPPORT or np.ptp(chain.travelled[query[side]]) < DISTANCE:
            return None
    ends = before[np.argmax(query[before])], behind[np.argmin(query[behind])]
    return _locate(chain, solved, closures, (int(ends[0]), int(ends[1])), changes)


def _locate(
    chain: KeyframeChain,
    solved: np.ndarray,
    closures: Sequence[ResolvedClosure],
    ends: tuple[int, int],
    changes: Mapping[int, float],
) -> Break:
    """
    Return the break between closures: at a pause, else where it is most probable.

    There, the images change much, the odometry stops, as a robot that is carried does not drive,
    and few closures are on the wrong side. Changes are known in windows of closures only. Windows
    at the break have images of both sides, so that some closures are on the wrong side. Without
    any evidence, the break is in the middle.
    """
    last, first = (closures[i] for i in ends)
    session = chain.session[first.query]
    nodes = np.arange(last.query + 1, first.query + 1)
    nodes = nodes[chain.session[nodes] == session]
    pauses = chain.stamps[nodes] - chain.stamps[chain.previous[nodes]]
    if len(nodes) and pauses.max() > PAUSE * np.median(pauses):
        node = int(nodes[np.argmax(pauses)])
        return Break(node, int(chain.stamps[node]))
    low, high = last.at - GAP, first.at + GAP
    own = np.flatnonzero((chain.session == session) & (chain.travelled >= low))
    own = own[chain.travelled[own] <= high]
    stamps = chain.stamps[own]
    changed = {t: c for t, c in changes.items() if stamps[0] < t <= stamps[-1] and c > 0}
    usual = float(np.median(list(changed.values()))) if changed else 1.0
    evidence = dict.fromkeys(changed, 0.0)
    least = np.median(np.diff(stamps)) / 2 if len(own) > 1 else math.inf
    for time, middle in chain.stood[own[1:]].tolist():
        if time >= least:
            during = [t for t in changed if 0 < t - middle + time / 2 <= time] or [middle]
            evidence |= dict.fromkeys(during, STOPPED)
    if not evidence:
        node = int(nodes[len(nodes) // 2]) if len(nodes) else first.query
        return Break(node, int(chain.stamps[node]))
    near = [
        each
        for each in closures
        if stamps[0] <= each.stamp <= stamps[-1] and chain.session[each.query] == session
    ]
    T = chain.transforms
    at_ends = [solved[each.place] @ each.transform for each in (last, first)]
    moved = [
        pose @ inverse(T[end.query]) for pose, end in zip(at_ends, (last, first), strict=True)
    ]
    old, new = (deviations(solved, near, each @ T) for each in moved)
    at = np.array([each.stamp for each in near])

    def probable(stamp: int) -> float:
        wrong = np.where(at >= stamp, CLEAR * old < new, CLEAR * new < old).sum()
        change = math.log(changed.get(stamp, usual) / usual)
        return change + evidence[stamp] - WRONG_SIDE * float(wrong)

    stamp = max(evidence, key=probable)
    return Break(int(own[np.searchsorted(stamps, stamp)]), stamp)
