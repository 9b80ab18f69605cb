# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Runs of keyframes without an edge, as one factor each: few keyframes are variables of the solution.

Along a run, the errors of the odometry are independent from step to step, of equal variance in all
directions. So the covariance of a whole run follows from sums over its keyframes, and the
keyframes inside follow from its ends: the most probable ones by the linear model, which is exact
for corrections that are small within a run.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import cross, inverse
from stavpr_slam.pose_graph.odometry import KeyframeChain, OdometryNoise
from stavpr_slam.pose_graph.transforms import adjoints

LONGEST = 10  # keyframes of a run
SHORTEST = 0.05  # meters that a step counts at least


@dataclass(frozen=True, eq=False)
class Runs:
    """
    The runs of a chain of N nodes.

    :param variable: whether a node is a variable of the solution, shape (N,), bool.
    :param before, after: variables at the ends of the run of each node, shape (N,); -1 = none. A
        variable ends its run, and has none where a session begins.
    :param motion: from ``before`` to each node, shape (N, 4, 4).
    :param covariance: of it, in the axes of the node, rotation first, shape (N, 6, 6).
    """

    variable: np.ndarray
    before: np.ndarray
    after: np.ndarray
    motion: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, chain: KeyframeChain, noise: OdometryNoise, ends: set[int]) -> 'Runs':
        """
        Divide a chain.

        :param ends: nodes that are variables; so are beginnings of sessions, fixed places, and
            some nodes of long runs.
        """
        T, count = chain.transforms, len(chain)
        order = np.argsort(chain.session, kind='stable')  # each session in a row
        begins = (chain.previous < 0)[order]
        number = np.arange(count)
        start = np.maximum.accumulate(np.where(begins, number, 0))
        chosen = begins | ((number - start) % LONGEST == 0)
        chosen[np.isin(order, list(ends))] = True
        own = np.maximum.accumulate(np.where(chosen, number, 0))  # variable at or before
        first = np.where(chosen & ~begins, own[number - 1], own)  # and before a variable
        later = np.minimum.accumulate(np.where(chosen, number, count)[::-1])[::-1]
        inside = later < count
        inside[inside] = start[later[inside]] == start[inside]

        def unordered(values: np.ndarray) -> np.ndarray:
            result = np.empty_like(values)
            result[order] = values
            return result

        before = np.where(begins, -1, order[first])
        after = np.where(inside, order[np.minimum(later, count - 1)], -1)
        moved = inverse(T[order[first]]) @ T[order]
        covariance = _covariances(chain, noise, order, first, start)
        return cls(*(unordered(each) for each in (chosen, before, after, moved, covariance)))

    def filled(self, values: np.ndarray) -> np.ndarray:
        """
        Return all nodes from the variables.

        :param values: shape (N, 4, 4), of which those of variables count.
        """
        result = values.copy()
        free = np.flatnonzero(~self.variable)
        before, after = self.before[free], self.after[free]
        result[free] = values[before] @ self.motion[free]
        inner = free[after >= 0]
        before, after = self.before[inner], self.after[inner]
        off = inverse(self.motion[after]) @ inverse(values[before]) @ values[after]
        error = np.concatenate(
            [Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]], axis=1
        )
        share = np.linalg.solve(self.covariance[after], error[:, :, None])
        rest = inverse(self.motion[after]) @ self.motion[inner]  # the node as seen from the end
        step = self.covariance[inner] @ adjoints(rest).transpose(0, 2, 1) @ share
        step = step[:, :, 0]
        result[inner, :3, 3] += np.einsum('nij,nj->ni', result[inner, :3, :3], step[:, 3:])
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        result[inner, :3, :3] = result[inner, :3, :3] @ turn
        return result


def _covariances(
    chain: KeyframeChain, noise: OdometryNoise, order: np.ndarray, first: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the covariances of the motions from ``first``; nodes by session, from ``start``."""
    at, T = chain.travelled[order], chain.transforms[order]
    length = np.maximum(np.diff(at, prepend=0.0), SHORTEST)
    length[start == np.arange(len(order))] = 0.0
    p, R = T[:, :3, 3] - T[start, :3, 3], T[:, :3, :3]
    sums = [
        np.cumsum(length),
        np.cumsum(length[:, None] * p, axis=0),
        np.cumsum(length[:, None, None] * p[:, :, None] * p[:, None], axis=0),
    ]
    # of the nodes after `first` until each node, about that node, in its axes
    total, moment, second = (each - each[first] for each in sums)
    second = second - moment[:, :, None] * p[:, None] - p[:, :, None] * moment[:, None]
    second += total[:, None, None] * p[:, :, None] * p[:, None]
    moment = np.einsum('nij,ni->nj', R, moment - total[:, None] * p)
    second = R.transpose(0, 2, 1) @ second @ R
    turn, shift, unit = noise.rotation**2, noise.translation**2, np.eye(3)
    result = np.zeros((len(order), 6, 6))
    result[:, :3, :3] = turn * total[:, None, None] * unit
    lever = turn * cross(moment)
    result[:, 3:, :3], result[:, :3, 3:] = lever, lever.transpose(0, 2, 1)
    result[:, 3:, 3:] = shift * total[:, None, None] * unit
    trace = np.trace(second, axis1=1, axis2=2)
    result[:, 3:, 3:] += turn * (trace[:, None, None] * unit - second)
    return result
