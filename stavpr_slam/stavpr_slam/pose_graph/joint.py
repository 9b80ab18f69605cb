# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All clusters together: what the others imply about each one.

Linearized, the misclosures of loops are jointly Gaussian: their covariance is that of the
closures, and of the odometry that loops have in common. Each one is compared with its prediction
by all others (leave-one-out by the inverse of the covariance; Baarda, *A Testing Procedure for Use
in Geodetic Networks*, 1968).
"""

from collections.abc import Sequence

import numpy as np
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.transforms import adjoints, exponentials, logarithms

REFUTED = 11.3  # squared deviations: 99 % for motion in a plane, of three dimensions
CERTAIN = 100.0  # odds from which a single closure is right
LARGEST = 300  # loops that are compared together; more are divided into interleaved groups
ITERATIONS = 2  # of Gauss and Newton after each edge that is left out
UNKNOWN = np.diag([3.0] * 3 + [1e3] * 3) ** 2  # of the pose of a session, rad and m


class NodeErrors:
    """
    Errors of the nodes by the odometry, as twists in the axes of the map, and their covariances.

    ``transforms`` are those of the linearization, (N, 4, 4), about the middle of the map;
    ``errors`` the twists that they have by the odometry, (N, 6).

    :param solved: transforms of all nodes in the map, shape (N, 4, 4).
    :param scale: factor on the errors of the odometry.
    :param anchors: sessions whose pose is known.
    """

    def __init__(
        self, chain: KeyframeChain, solved: np.ndarray, scale: float, anchors: set[int]
    ) -> None:
        T, number = chain.transforms, np.arange(len(chain))
        self.transforms = X = solved.copy()
        X[:, :3, 3] -= X[:, :3, 3].mean(axis=0)
        before = np.where(chain.previous < 0, number, chain.previous)
        local = T.copy()
        local[:, :3, 3] -= chain.origin
        turn = adjoints(X @ inverse(local))
        steps = logarithms(inverse(inverse(T[before]) @ T) @ inverse(X[before]) @ X)
        moved = (adjoints(X) @ steps[:, :, None])[:, :, 0]
        spread = turn @ (chain.spread - chain.spread[before]) @ turn.swapaxes(1, 2)
        bent = turn @ (chain.bent - chain.bent[before])
        order = np.argsort(chain.session, kind='stable')
        first = np.maximum.accumulate(np.where(chain.previous[order] < 0, number, 0))

        def summed(steps: np.ndarray) -> np.ndarray:
            sums = np.cumsum(steps[order], axis=0)
            result = np.empty_like(sums)
            result[order] = sums - sums[first]
            return result

        self.errors = summed(moved)
        self._spread, self._bent = scale**2 * summed(spread), scale * summed(bent)
        self._session, self._recording = chain.session, chain.recording
        self._loose = ~np.isin(chain.session, list(anchors)) & (chain.session >= 0)

    def covariance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the covariances between nodes (n,) and (m,), shape (n, m, 6, 6)."""
        a, b = a[:, None], b[None]
        result = self._spread[np.minimum(a, b)]
        result[self._loose[a] & self._loose[b]] += UNKNOWN
        result[self._session[a] != self._session[b]] = 0
        bent = self._bent[a] @ self._bent[b].swapaxes(2, 3)
        bent[self._recording[a] != self._recording[b]] = 0
        return result + bent

    @property
    def area(self) -> float:
        """Return the area of the map: of its two largest extents, m^2."""
        extents = np.ptp(self.transforms[:, :3, 3], axis=0)
        return float(np.prod(np.sort(extents)[1:]))


class Loops:
    """The misclosures of n loops, which edges close, and their covariances."""

    def __init__(self, nodes: NodeErrors, edges: Sequence[ResolvedClosure]) -> None:
        self.ends = np.array([[edge.query, edge.place] for edge in edges])
        self._nodes, self._back = nodes, inverse(np.array([edge.transform for edge in edges]))
        self._X, self._errors = nodes.transforms[self.ends], nodes.errors[self.ends]
        self._start = self._X, self._errors
        self._turn = adjoints(self._X[:, 0])
        measured = np.array([edge.covariance for edge in edges])
        self.measured = self._turn @ measured @ self._turn.swapaxes(1, 2)

    def misclosures(self) -> np.ndarray:
        """Return the misclosures by the odometry in the axes of the map, shape (n, 6)."""
        query, place = self._X[:, 0], self._X[:, 1]
        off = self._turn @ logarithms(self._back @ inverse(place) @ query)[:, :, None]
        result: np.ndarray = off[:, :, 0] - self._errors[:, 0] + self._errors[:, 1]
        return result

    def end_covariances(self, others: 'Loops') -> np.ndarray:
        """Return those of the errors of the ends with other loops, shape (2, n, m, 6, 6)."""
        covariance, (query, place) = self._nodes.covariance, others.ends.T
        return np.array([covariance(own, query) - covariance(own, place) for own in self.ends.T])

    def move(self, errors: np.ndarray) -> None:
        """Linearize at other errors of the ends, shape (2, n, 6)."""
        X, start = self._start
        self._errors = errors.swapaxes(0, 1)
        moved = exponentials((self._errors - start).reshape(-1, 6)).reshape(*X.shape)
        self._X = moved @ X
        self._turn = adjoints(self._X[:, 0])


def refuted(
    nodes: NodeErrors, edges: Sequence[ResolvedClosure], weights: np.ndarray
) -> list[int]:
    """
    Return the edges that contradict the odometry and the others together.

    The worst one in relation to its weight is left out until none contradicts the others; then
    those are taken in again that agree with the rest.

    :param weights: shape (n,).
    """
    groups, found = -(-len(edges) // LARGEST), []
    for group in range(groups):
        numbers = np.arange(len(edges))[group::groups]
        loops = Loops(nodes, [edges[i] for i in numbers])
        found += numbers[_refuted(loops, weights[numbers])].tolist()
    return found


def _refuted(loops: Loops, weights: np.ndarray) -> list[int]:
    ends, n = loops.end_covariances(loops), len(weights)
    shared = ends[0] - ends[1]
    whole = shared.copy()
    whole[np.arange(n), np.arange(n)] += loops.measured
    flat = whole.transpose(0, 2, 1, 3).reshape(6 * n, 6 * n)
    P = np.linalg.inv(flat).reshape(n, 6, n, 6)
    taken, off, moved = np.arange(n), loops.misclosures(), False
    while True:
        pulled = np.einsum('iajb,jb->ia', P, off[taken])
        own = P[np.arange(len(taken)), :, np.arange(len(taken))]
        squared = _squared(pulled, own)
        over = np.where(squared > REFUTED, squared / weights[taken], 0.0)
        if over.any():
            worst, moved = int(np.argmax(over)), False
            rest = np.arange(len(taken)) != worst
            gone, core = P[rest, :, worst], np.linalg.inv(P[worst, :, worst])
            P = P[rest][:, :, rest] - np.einsum('iab,bc,jdc->iajd', gone, core, gone)
            taken = taken[rest]
        elif moved:
            break
        else:
            for _ in range(ITERATIONS):
                pulled = np.einsum('iajb,jb->ia', P, loops.misclosures()[taken])
                loops.move(-np.einsum('enjab,jb->ena', ends[:, :, taken], pulled))
            off, moved = loops.misclosures(), True
    left = np.setdiff1d(np.arange(n), taken)
    gain = np.einsum('ljab,jbkc->lakc', shared[np.ix_(left, taken)], P)
    off = off[left] - np.einsum('lakc,kc->la', gain, off[taken])
    own = whole[left, left] - np.einsum('lakc,lkdc->lad', gain, shared[np.ix_(left, taken)])
    return [int(i) for i, each in zip(left, _squared(off, own), strict=True) if each > REFUTED]


def predicted(
    nodes: NodeErrors, edges: Sequence[ResolvedClosure], others: Sequence[ResolvedClosure]
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return how far edges are from what the odometry and others imply, and the odds of being right.

    Odds by Bayes' rule: the density of the misclosure by the prediction, and that of a wrong
    place, which is anywhere on the map; as many of the edges are right as there are others.

    :returns: squared deviations and odds, shape (n,) each.
    """
    squared, odds = np.zeros((2, len(edges)))
    if not edges or not others:
        return squared + np.inf, odds
    known = Loops(nodes, others)
    off, n = known.misclosures().ravel(), len(others)
    ends = known.end_covariances(known)
    whole = ends[0] - ends[1]
    whole[np.arange(n), np.arange(n)] += known.measured
    P = np.linalg.inv(whole.transpose(0, 2, 1, 3).reshape(6 * n, 6 * n))
    for i, edge in enumerate(edges):
        loop = Loops(nodes, [edge])
        query, place = loop.end_covariances(known)
        shared = (query - place)[0].transpose(1, 0, 2).reshape(6, 6 * n)
        query, place = loop.end_covariances(loop)
        own = (query - place)[0, 0] + loop.measured[0] - shared @ P @ shared.T
        missed = loop.misclosures()[0] - shared @ P @ off
        back = adjoints(inverse(nodes.transforms[edge.query][None]))[0]
        missed, own = back @ missed, back @ own @ back.T
        squared[i] = missed @ np.linalg.solve(own, missed)
        turn, shift = (np.linalg.eigvalsh(own[k : k + 3, k : k + 3]) for k in (0, 3))
        volume = np.sqrt(2 * np.pi * shift[1] * shift[2] * turn[2])
        odds[i] = nodes.area / volume * np.exp(-squared[i] / 2) * n / len(edges)
    return squared, odds


def _squared(off: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return squared Mahalanobis distances (n,) of deviations (n, 6)."""
    solved = np.linalg.solve(covariances, off[:, :, None])[:, :, 0]
    result: np.ndarray = (off * solved).sum(axis=1)
    return result
