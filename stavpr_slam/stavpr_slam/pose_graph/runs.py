# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Runs of keyframes without an edge, as one factor each: few keyframes are variables."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph import tuning
from stavpr_slam.pose_graph.keyframes import KeyframeChain


@dataclass(frozen=True, eq=False)
class Runs:
    """
    The runs of a chain of N nodes.

    :param variable: whether a node is a variable of the solution, shape (N,), bool.
    :param before, after: variables at the ends of the run of each node, shape (N,); -1 = none. A
        variable ends its run, and has none where a session begins.
    :param motion: from ``before`` to each node, shape (N, 4, 4).
    :param share: distance from ``before`` to each node, of the whole run, shape (N,).
    :param covariance: of ``motion`` at scale 1, in the axes of the node, shape (N, 6, 6).
    """

    variable: np.ndarray
    before: np.ndarray
    after: np.ndarray
    motion: np.ndarray
    share: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, chain: KeyframeChain, ends: Collection[int]) -> 'Runs':
        """
        Divide a chain.

        :param ends: nodes that are variables; so are beginnings of sessions, fixed places, and
            every tenth node of long runs.
        """
        count = len(chain)
        order = np.argsort(chain.session, kind='stable')  # each session in a row
        begins = (chain.previous < 0)[order]
        number = np.arange(count)
        start = np.maximum.accumulate(np.where(begins, number, 0))
        chosen = begins | ((number - start) % tuning.LONGEST == 0)
        chosen[np.isin(order, list(ends))] = True
        own = np.maximum.accumulate(np.where(chosen, number, 0))  # variable at or before
        first = np.where(chosen & ~begins, own[number - 1], own)  # and before a variable
        later = np.minimum.accumulate(np.where(chosen, number, count)[::-1])[::-1]
        inside = later < count
        inside[inside] = start[later[inside]] == start[inside]
        variable, before, after, since = np.empty((4, count), int)
        variable[order], since[order] = chosen, order[first]
        before[order] = np.where(begins, -1, order[first])
        after[order] = np.where(inside, order[np.minimum(later, count - 1)], -1)
        T, at = chain.transforms, chain.travelled
        length = np.maximum(at[after] - at[since], 1e-9)
        covariance = chain.path_errors(number, since)
        return cls(
            variable.astype(bool), before, after, inverse(T[since]) @ T,
            (at - at[since]) / length, covariance,
        )  # fmt: skip

    def fill(self, values: np.ndarray) -> np.ndarray:
        """
        Return all nodes from the variables: the correction of a run grows with the distance.

        :param values: shape (N, 4, 4), of which those of variables count.
        """
        result = values.copy()
        free = np.flatnonzero(~self.variable)
        result[free] = values[self.before[free]] @ self.motion[free]
        inner = free[self.after[free] >= 0]
        share, after = self.share[inner, None], self.after[inner]
        end = values[self.before[inner]] @ self.motion[after]
        turn = Rotation.from_matrix(values[after, :3, :3] @ end[:, :3, :3].swapaxes(1, 2))
        rotation = Rotation.from_rotvec(share * turn.as_rotvec()).as_matrix()
        result[inner, :3, :3] = rotation @ result[inner, :3, :3]
        result[inner, :3, 3] += share * (values[after] - end)[:, :3, 3]
        return result
