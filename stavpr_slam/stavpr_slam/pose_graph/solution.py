# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Solutions of a pose graph: a decision on all closures, or new ones added to the last."""

from dataclasses import dataclass, replace

import numpy as np
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.decision import Decider, Decision
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.network import Network
from stavpr_slam.pose_graph.sessions import (
    extend,
    Pair,
    place,
    Placement,
    session_pairs,
    weak_pairs,
)
from stavpr_slam.pose_graph.solver import squares


@dataclass(frozen=True, eq=False)
class Solution:
    """
    The nodes by the accepted closures.

    :param nodes: transforms in the map, (N, 4, 4).
    :param accepted, counted: of n closures, which are right, and which count in the solution.
    :param scales: factors on the errors of the odometry of each robot.
    """

    nodes: np.ndarray
    accepted: np.ndarray
    counted: np.ndarray
    scales: np.ndarray
    placement: Placement


@dataclass(frozen=True, eq=False)
class DriveSolution(Solution):
    """
    The nodes of drives.

    :param trials: robust solutions: nodes, closures that agree, and the node behind the bend
        of the odometry; where its errors were searched.
    """

    decision: Decision
    trials: list[tuple[np.ndarray, np.ndarray, int]]


def decide_anew(
    chain: KeyframeChain, closures: ClosureArrays, scales: np.ndarray | None = None
) -> DriveSolution:
    """
    Decide on all closures anew, and estimate all nodes.

    :param scales: factors on the errors of the odometry of each robot, as decided before; None =
        they are searched.
    """
    denied = set[Pair]()
    while True:
        placement = place(chain, closures, denied)
        usable = closures[placement.allowed]
        network = Network(chain, placement.initial, usable, placement.links)
        decider = Decider(chain, network, placement.initial)
        if scales is None:
            decision, trials = decider.decide(len(chain.robots))
        else:
            decision, trials = decider.at(scales), []
        pairs = weak_pairs(chain, usable[decision.accepted], placement)
        if not pairs:
            break
        denied |= pairs
    accepted = counted = decision.accepted
    scales, values = decision.scales, network.values(placement.initial)
    if accepted.any():
        scales, values, counted = decider.estimate(decision, usable.is_independent)

    def among_all(chosen: np.ndarray) -> np.ndarray:
        result = placement.allowed.copy()
        result[placement.allowed] = chosen
        return result

    return DriveSolution(
        network.nodes(values), among_all(accepted), among_all(counted), scales, placement,
        decision,
        [(network.nodes(other.values), among_all(other.inliers), other.bend) for other in trials],
    )  # fmt: skip


def follow(
    chain: KeyframeChain, closures: ClosureArrays, last: DriveSolution
) -> DriveSolution | None:
    """
    Add new closures to the last solution, each of which agrees with it or contradicts it.

    A closure agrees where its deviation is below the limit, by the errors of the solution at both
    ends, with the odometry of the decision as well as of the estimate; it contradicts where it is
    above in both.

    :returns: None where that is not so.
    """
    old, placement = len(last.accepted), last.placement
    if not last.counted.any() or len(placement.links) < len(chain.starts()):
        return None
    pairs = session_pairs(chain, closures[old:]).tolist()
    if any(a != b and (a, b) not in placement.pairs for a, b in pairs):
        return None
    nodes = extend(chain, last.nodes, placement)
    numbers = np.flatnonzero(np.append(last.accepted, np.ones(len(closures) - old, bool)))
    usable, is_old = closures[numbers], numbers < old
    network = Network(chain, nodes, usable, placement.links)
    decider = Decider(chain, network, nodes)
    information, values = decider.information(last.scales), network.values(nodes)
    agree = is_old | (network.residuals(information, values) <= network.limit)
    far = np.flatnonzero(~agree)
    if len(far):
        before = np.append(last.counted[last.accepted], np.zeros((~is_old).sum()))
        agree[far] = squares(network.innovations(before, far)) <= network.limit
        network.residuals(decider.information(last.decision.scales), values)
        if (squares(network.innovations(before, far)) > network.limit)[agree[far]].any():
            return None
    own = decider.thin(agree, usable.is_independent)
    values, _ = network.fit(information, own, values)
    if (network.residuals(information, values)[far][agree[far]] > network.limit).any():
        return None
    accepted, counted = np.zeros((2, len(closures)), bool)
    accepted[numbers[agree]], counted[numbers[own]] = True, True
    return replace(last, nodes=network.nodes(values), accepted=accepted, counted=counted)


NOTHING = Solution(
    np.zeros((0, 4, 4)), np.zeros(0, bool), np.zeros(0, bool), np.zeros(0),
    Placement(np.zeros((0, 4, 4)), {}, frozenset(), np.zeros(0, bool)),
)  # fmt: skip
"""Of a graph without odometry."""
