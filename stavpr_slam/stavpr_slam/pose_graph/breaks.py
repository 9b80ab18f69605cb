# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where closures prove that the odometry missed a motion: the robot was carried."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
import math

import numpy as np
from stavpr_slam.pose_graph.consistency import Cluster, ConsistencySettings
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.odometry import KeyframeChain, OdometryNoise

STANDING = math.log(
    10
)  # evidence of the odometry that stands: else it does in a tenth of the images
PAUSE = 4.0  # times the usual time between keyframes: the robot was carried then
REACH = 100.0  # meters without closures that a run continues after
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


def find_break(
    chain: KeyframeChain,
    clusters: list[Cluster],
    conflicts: np.ndarray,
    noise: OdometryNoise,
    settings: ConsistencySettings,
    changes: Mapping[int, float],
) -> Break | None:
    """
    Return the break between two long runs of closures that contradict each other; None = none.

    In a run, each cluster agrees with the one before it. Over a short way this is a sharp test,
    while over laps odometry may have drifted as far as a robot is carried.

    :param conflicts: which clusters contradict each other, shape (n, n), bool.
    :param changes: how much the images of stamps (ns) differ from the images before them.
    """
    queries = np.array([cluster.members[0].query for cluster in clusters], int)
    for session in range(chain.sessions):
        own = [
            (clusters[i].members[0].stamp, i)
            for i in np.flatnonzero(chain.session[queries] == session).tolist()
            if clusters[i].weight >= settings.support
        ]
        runs: list[list[int]] = []
        for _, i in sorted(own):
            since = clusters[i].members[0].at - REACH
            agreeing = [
                run for run in runs
                if clusters[run[-1]].members[-1].at >= since and not conflicts[i, run[-1]]
            ]  # fmt: skip
            if agreeing:
                max(agreeing, key=lambda run: clusters[run[-1]].members[-1].at).append(i)
            else:
                runs.append([i])
        long = [run for run in runs if _is_long([clusters[i] for i in run], settings)]
        for before, after in pairwise(long):
            last, first = clusters[before[-1]], clusters[after[0]]
            if conflicts[before[-1], after[0]] and _begin(last) < _begin(first):
                return _locate(chain, clusters, (last, first), noise, settings, changes)
    return None


def _is_long(run: list[Cluster], settings: ConsistencySettings) -> bool:
    way = run[-1].members[-1].at - run[0].members[0].at
    weight = sum(cluster.weight for cluster in run)
    return weight >= settings.break_support and way >= settings.break_distance


def _locate(
    chain: KeyframeChain,
    clusters: list[Cluster],
    ends: tuple[Cluster, Cluster],
    noise: OdometryNoise,
    settings: ConsistencySettings,
    changes: Mapping[int, float],
) -> Break:
    """
    Return the break between clusters: at a pause, else where it is most probable.

    There, the images change much, the odometry stands, as a robot that is carried does not drive,
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
    seen = {t: c for t, c in changes.items() if stamps[0] < t <= stamps[-1] and c > 0}
    usual = float(np.median(list(seen.values()))) if seen else 1.0
    evidence = dict.fromkeys(seen, 0.0)
    least = np.median(np.diff(stamps)) / 2 if len(own) > 1 else math.inf
    for time, middle in chain.stood[own[1:]].tolist():
        if time >= least:
            during = [t for t in seen if 0 < t - middle + time / 2 <= time] or [middle]
            evidence |= dict.fromkeys(during, STANDING)
    if evidence:
        near = [
            each
            for cluster in clusters
            for each in cluster.members
            if stamps[0] <= each.stamp <= stamps[-1] and chain.session[each.query] == session
        ]
        old, new = (
            Cycles(chain, [cluster.representative, *near]).deviations(0, noise)[1:]
            for cluster in ends
        )
        at = np.array([each.stamp for each in near])

        def probable(stamp: int) -> float:
            wrong = np.where(at >= stamp, CLEAR * old < new, CLEAR * new < old).sum()
            change = math.log(seen.get(stamp, usual) / usual)
            return change + evidence[stamp] - WRONG_SIDE * float(wrong)

        stamp = max(evidence, key=probable)
        return Break(int(own[np.searchsorted(stamps, stamp)]), stamp)
    node = int(nodes[len(nodes) // 2]) if len(nodes) else first.query
    return Break(node, int(chain.stamps[node]))


def _begin(cluster: Cluster) -> int:
    return cluster.members[0].stamp
