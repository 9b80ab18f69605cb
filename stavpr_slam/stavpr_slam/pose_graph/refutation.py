# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which edges the graph as a whole refutes: each is compared with what all others say of its ends.

Two closures far from each other may agree although a third between them excludes one. By the
residuals of least squares and their covariance (Baarda, *A Testing Procedure for Use in Geodetic
Networks*, 1968), an edge is as far from the solution without it as its own residual is improbable.
"""

from dataclasses import dataclass

import numpy as np
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_slam.pose_graph.solver import Solver

REFUTED = 11.3  # squared deviations: 99 % for motion in a plane, of three dimensions
STARTS = 3  # edges left out that a search keeps
ROUNDS = 4  # of leaving out and taking in
FLOOR = 1e-6  # of the variance of an edge: as much is left where nothing else knows its ends

Weighted = dict[int, tuple[ResolvedClosure, float]]  # edges by any keys, with their weights


@dataclass(frozen=True, eq=False)
class Refutation:
    """
    Compares edges with all others together.

    :param noise, links: as those of :meth:`Solver.update`.
    """

    chain: KeyframeChain
    noise: OdometryNoise
    links: dict[int, int]

    def refuted(self, initial: np.ndarray, edges: Weighted) -> list[int]:
        """
        Return which edges contradict the others together.

        What is left may be the lighter of two sides, where edges support each other: it is
        searched again with some of those that were left out, heavy ones first, and the heaviest
        set counts.

        :param initial: transforms of all nodes, shape (N, 4, 4).
        :raises RuntimeError: the graph is too ill-conditioned for its covariance, as by edges of a
            tenth of a millimeter.
        """

        def weight(keys: list[int]) -> float:
            return sum(edges[key][1] for key in keys)

        found = self._left_out(initial, edges, None) or []
        for key in sorted(found, key=lambda key: -edges[key][1])[:STARTS]:
            other = self._left_out(initial, edges, key) if key in found else None
            if other is not None and weight(other) < weight(found):
                found = other
        return found

    def _left_out(
        self, initial: np.ndarray, edges: Weighted, kept: int | None
    ) -> list[int] | None:
        """
        Leave out the worst edge in relation to its weight until none contradicts the others.

        Then those that do not contradict the rest are taken in again.

        :param kept: edge that is not left out.
        :returns: those that are left out; None = the kept one contradicts the rest.
        """
        taken = {key: edge for key, (edge, _) in edges.items()}
        left: dict[int, ResolvedClosure] = {}
        for number in range(ROUNDS):
            while taken:
                initial, squared = self.compared(initial, taken, left)
                over = {k: squared[k] / edges[k][1] for k in taken if squared[k] > REFUTED}
                against = {k: v for k, v in over.items() if k != kept}
                if not against:
                    if over:
                        return None
                    break
                worst = max(against, key=lambda k: against[k])
                left[worst] = taken.pop(worst)
            again = [key for key in left if squared[key] <= REFUTED]
            if not again or number == ROUNDS - 1:
                break
            taken |= {key: left.pop(key) for key in again}
        return list(left)

    def compared(
        self, initial: np.ndarray, taken: dict[int, ResolvedClosure],
        left: dict[int, ResolvedClosure],
    ) -> tuple[np.ndarray, dict[int, float]]:  # fmt: skip
        """
        Return how far each edge is from what all others that are taken imply.

        :param left: further edges, by other keys.
        :returns: the nodes by the edges that are taken, (N, 4, 4), and squared deviations.
        """
        nodes, found = Solver().residuals(self.chain, initial, taken, left, self.noise, self.links)
        squared, own = {}, np.eye(6)
        for key, (missed, known) in found.items():
            covariance = own + known if key in left else (1 + FLOOR) * own - known
            squared[key] = float(missed @ np.linalg.solve(covariance, missed))
        return nodes, squared
