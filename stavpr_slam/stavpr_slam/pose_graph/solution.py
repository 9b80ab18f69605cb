# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Solutions of a pose graph: all closures decided anew, or new ones added to the last."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from stavpr_slam.pose_graph.blocks import Blocks, Consensus, NOTHING
from stavpr_slam.pose_graph.closures import ClosureArrays
from stavpr_slam.pose_graph.decision import Decider, Decision
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.sessions import Pair, place, Placement, weak_pairs


@dataclass(frozen=True, eq=False)
class Solution:
    """
    The nodes by the accepted closures.

    :param nodes: transforms in the map, (N, 4, 4).
    :param accepted, counted: of n closures, which are right, and which count in the solution.
    :param scales: factors on the errors of the odometry of each robot.
    :param consensus: of which new closures are added; of drives, a decision.
    :param trials: decisions at other factors, where they were searched.
    """

    nodes: np.ndarray
    accepted: np.ndarray
    counted: np.ndarray
    scales: np.ndarray
    placement: Placement
    consensus: Consensus
    trials: list[Decision] = field(default_factory=list)

    @property
    def gain(self) -> float:
        """Return the gain of the decision on drives."""
        return self.consensus.gain if isinstance(self.consensus, Decision) else 0.0


EMPTY = Solution(
    np.zeros((0, 4, 4)), np.zeros(0, bool), np.zeros(0, bool), np.zeros(0),
    Placement(np.zeros((0, 4, 4)), {}, frozenset(), np.zeros(0, bool), []), NOTHING,
)  # fmt: skip
"""Of a graph without odometry."""


def solve_drives(
    chain: KeyframeChain, closures: ClosureArrays, scales: np.ndarray | None = None
) -> Solution:
    """
    Decide on the closures of drives, and estimate all nodes.

    :param scales: factors on the errors of the odometry of each robot; None = they are searched.
    """

    def solution(placement: Placement) -> Solution:
        decider = Decider(chain, closures, placement)
        decision, trials = decider.search() if scales is None else (decider.at(scales), [])
        own, nodes, counted = decider.estimate(decision)
        return Solution(nodes, decision.inliers, counted, own, placement, decision, trials)

    return _joined(chain, closures, solution)


def add_closures(
    chain: KeyframeChain, closures: ClosureArrays, last: Solution, decided: Decision
) -> Solution:
    """Add new closures of drives to the last solution, whose factors and evidence stay."""

    def solution(placement: Placement) -> Solution:
        decider = Decider(chain, closures, placement)
        decision = decider.add(decided)
        scales, nodes, counted = decider.estimate(decision, last.scales)
        return Solution(nodes, decision.inliers, counted, scales, placement, decision)

    return _joined(chain, closures, solution)


def solve_measured(chain: KeyframeChain, closures: ClosureArrays, last: Consensus) -> Solution:
    """
    Decide on the closures of a graph of another program.

    :param last: on the first of the closures; :data:`NOTHING` = all are new.
    """

    def solution(placement: Placement) -> Solution:
        result = Blocks(chain, closures, placement, last).consensus()
        scales = np.full(len(chain.robots), result.beliefs.factor)
        return Solution(result.nodes, result.inliers, result.inliers, scales, placement, result)

    return _joined(chain, closures, solution)


def _joined(
    chain: KeyframeChain, closures: ClosureArrays, solve: Callable[[Placement], Solution]
) -> Solution:
    """Return a solution of which enough right closures join each pair of sessions."""
    denied = set[Pair]()
    while True:
        solution = solve(place(chain, closures, denied))
        pairs = weak_pairs(chain, closures[solution.accepted], solution.placement)
        if not pairs:
            return solution
        denied |= pairs
