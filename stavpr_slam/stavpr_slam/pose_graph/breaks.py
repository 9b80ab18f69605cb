# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where closures prove that the odometry missed a motion: the robot was carried."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
import math

import numpy as np
from stavpr_slam.pose_graph.clusters import Cluster, ConsistencySettings
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.keyframes import KeyframeChain

STOPPED = math.log(10)  # evidence of a stop: elsewhere, one image in ten is of a stop
PAUSE = 4.0  # times the usual time between keyframes: the robot was carried then
MOST = 40  # places of a break that are tried
CLEAR = 4.0  # a closure belongs to the side that it deviates from so many times less
WRONG_SIDE = 0.1  # cost of a closure on the wrong side of a break, in logarithms of a change


@dataclass(frozen=True)
class Break:
    """
    A motion that the odometry missed.

    :param node: first keyframe after it.
    :param stamp: from which odometry and images are after it, ns.
    """

    node: int
    stamp: int


def candidates(chain: KeyframeChain, clusters: Sequence[Cluster], least: int) -> list[int]:
    """
    Return nodes that a session could begin at: the first ones of clusters of a weight, in order.

    Of many, :data:`MOST` in equal steps.
    """
    found = sorted({each.members[0].query for each in clusters if each.weight >= least})
    nodes = [b for a, b in pairwise(found) if chain.session[a] == chain.session[b]]
    return [nodes[i] for i in np.unique(np.linspace(0, len(nodes) - 1, MOST).astype(int)) if nodes]


def neighbors(
    chain: KeyframeChain, accepted: Sequence[Cluster], node: int, settings: ConsistencySettings
) -> tuple[Cluster, Cluster] | None:
    """
    Return the last cluster before a break and the first one behind it.

    :param accepted: clusters that agree if there is a break.
    :returns: None without clusters enough on both sides.
    """
    session = chain.session
    own = [each for each in accepted if session[each.members[0].query] == session[node]]
    own.sort(key=lambda each: each.members[0].at)
    sides = (
        [each for each in own if each.members[0].query < node],
        [each for each in own if each.members[0].query >= node],
    )
    for side in sides:
        length = side[-1].members[-1].at - side[0].members[0].at if side else 0.0
        weight = sum(each.weight for each in side)
        if weight < settings.break_support or length < settings.break_distance:
            return None
    return sides[0][-1], sides[1][0]


def locate(
    chain: KeyframeChain,
    clusters: Sequence[Cluster],
    ends: tuple[Cluster, Cluster],
    scale: float,
    settings: ConsistencySettings,
    changes: Mapping[int, float],
) -> Break:
    """
    Return the break between clusters: at a pause, else where it is most probable.

    There, the images change much, the odometry stops, as a robot that is carried does not drive,
    and few closures are on the wrong side. Changes are known in windows of closures only. Windows
    at the break have images of both sides, so that some closures are on the wrong side. Without
    any evidence, the break is in the middle.
    """
    last = max(ends[0].members, key=lambda each: each.at)
    first = min(ends[1].members, key=lambda each: each.at)
    session = chain.session[first.query]
    nodes = np.arange(last.query + 1, first.query + 1)
    nodes = nodes[chain.session[nodes] == session]
    pauses = chain.stamps[nodes] - chain.stamps[chain.previous[nodes]]
    if len(nodes) and pauses.max() > PAUSE * np.median(pauses):
        node = int(nodes[np.argmax(pauses)])
        return Break(node, int(chain.stamps[node]))
    low, high = last.at - settings.gap, first.at + settings.gap
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
    if evidence:
        near = [
            each
            for cluster in clusters
            for each in cluster.members
            if stamps[0] <= each.stamp <= stamps[-1] and chain.session[each.query] == session
        ]
        old, new = (
            Cycles(chain, [cluster.representative, *near]).deviations(0, scale)[1:]
            for cluster in ends
        )
        at = np.array([each.stamp for each in near])

        def probable(stamp: int) -> float:
            wrong = np.where(at >= stamp, CLEAR * old < new, CLEAR * new < old).sum()
            change = math.log(changed.get(stamp, usual) / usual)
            return change + evidence[stamp] - WRONG_SIDE * float(wrong)

        stamp = max(evidence, key=probable)
        return Break(int(own[np.searchsorted(stamps, stamp)]), stamp)
    node = int(nodes[len(nodes) // 2]) if len(nodes) else first.query
    return Break(node, int(chain.stamps[node]))
