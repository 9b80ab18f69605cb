# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All clusters together: the prediction of each one by the others.

Linearized, the misclosures of loops are jointly Gaussian: their covariance is that of the
closures, and of the odometry that loops have in common. Each one is compared with its prediction
by all others (leave-one-out by the inverse of the covariance; Baarda, *A Testing Procedure for Use
in Geodetic Networks*, 1968).
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.transforms import adjoints, exponentials, logarithms

REFUTED = 11.3  # squared deviations: 99 % for motion in a plane, of three dimensions
CERTAIN = 100.0  # odds from which a single closure is right
LARGEST = 300  # loops that are compared together; more are divided into interleaved groups
ITERATIONS = 2  # of Gauss and Newton after each edge that is left out
UNKNOWN = np.repeat([3.0, 1e3], 3) ** 2  # variances of the pose of a session, rad and m


class NodeErrors:
    """
    Errors of the nodes by the odometry, as twists in the axes of the map, and their covariances.

    ``transforms`` are those of the linearization, (N, 4, 4), about the middle of the map;
    ``errors`` the twists that they have by the odometry, (N, 6); ``loose``: in which of S sessions
    with an unknown pose they are, (N, S).

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
        loose = sorted(set(chain.session[chain.session >= 0].tolist()) - anchors)
        self.loose = (chain.session[:, None] == loose).astype(float)

    def covariance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return those between nodes (n,) and (m,) of known sessions, shape (n, m, 6, 6)."""
        a, b = a[:, None], b[None]
        result = self._spread[np.minimum(a, b)]
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
    """
    The misclosures of n loops, which edges close, with their precision.

    The poses of loose sessions are unknowns beside them (as in universal kriging): as large
    covariances they would leave no digits for those of the closures.
    """

    def __init__(self, nodes: NodeErrors, edges: Sequence[ResolvedClosure]) -> None:
        self._nodes = nodes
        self.ends = np.array([[edge.query, edge.place] for edge in edges])
        self._back = inverse(np.array([edge.transform for edge in edges]))
        self._X, self._errors = nodes.transforms[self.ends], nodes.errors[self.ends]
        self._start = self._X, self._errors
        self._turn = adjoints(self._X[:, 0])
        measured = np.array([edge.covariance for edge in edges])
        self.measured = self._turn @ measured @ self._turn.swapaxes(1, 2)
        loose = nodes.loose[self.ends]
        self.loose = np.kron(loose[:, 0] - loose[:, 1], np.eye(6))
        self._ends_loose = [np.kron(each, np.eye(6)) for each in loose.swapaxes(0, 1)]

    def misclosures(self) -> np.ndarray:
        """Return the misclosures by the odometry in the axes of the map, shape (6 n,)."""
        query, place = self._X[:, 0], self._X[:, 1]
        off = self._turn @ logarithms(self._back @ inverse(place) @ query)[:, :, None]
        return (off[:, :, 0] - self._errors[:, 0] + self._errors[:, 1]).ravel()

    def end_covariances(self, others: 'Loops') -> np.ndarray:
        """Return those of the errors of the ends with other loops, shape (2, 6 n, 6 m)."""
        covariance, (query, place) = self._nodes.covariance, others.ends.T
        found = [covariance(own, query) - covariance(own, place) for own in self.ends.T]
        shape = 2, 6 * len(self.ends), 6 * len(others.ends)
        return np.array(found).transpose(0, 1, 3, 2, 4).reshape(shape)

    def covariance(self) -> np.ndarray:
        """Return that of the misclosures, shape (6 n, 6 n)."""
        query, place = self.end_covariances(self)
        return query - place + block_diag(*self.measured)

    def move(self, ends: np.ndarray, given: 'Given') -> None:
        """
        Linearize at the poses that loops imply.

        :param ends: covariances of the ends with these loops, shape (2, 6 n, 6 m).
        """
        errors = [
            -(own @ given.pulled + loose @ given.sessions).reshape(-1, 6)
            for own, loose in zip(ends, self._ends_loose, strict=True)
        ]
        X, start = self._start
        self._errors = np.array(errors).swapaxes(0, 1)
        moved = exponentials((self._errors - start).reshape(-1, 6)).reshape(*X.shape)
        self._X = moved @ X
        self._turn = adjoints(self._X[:, 0])


class Given:
    """
    What the misclosures of m loops imply.

    :param precision: inverse of their covariance, shape (6 m, 6 m).
    :param loose: unknown poses in each of them, shape (6 m, 6 S).
    :param off: the misclosures, shape (6 m,).
    """

    def __init__(self, precision: np.ndarray, loose: np.ndarray, off: np.ndarray) -> None:
        self._precision, self._loose, self._off = precision, loose, off
        self._weighed = precision @ loose
        prior = np.tile(UNKNOWN, loose.shape[1] // 6)
        self._unknown = np.linalg.inv(np.diag(1 / prior) + loose.T @ self._weighed)
        self.sessions = self._unknown @ (self._weighed.T @ off)
        self.pulled = precision @ (off - loose @ self.sessions)

    def deviations(self) -> np.ndarray:
        """Return squared deviations of the loops from the predictions by the others, (m,)."""
        m = len(self._off) // 6
        blocks = self._precision.reshape(m, 6, m, 6)[np.arange(m), :, np.arange(m)]
        weighed = self._weighed.reshape(m, 6, self._weighed.shape[1])
        blocks = blocks - weighed @ self._unknown @ weighed.swapaxes(1, 2)
        return _squared(self.pulled.reshape(m, 6), blocks)

    def predicted(
        self, off: np.ndarray, own: np.ndarray, shared: np.ndarray, loose: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the deviation of another loop from its prediction, (6,), and the covariance, (6, 6).

        :param off, own: its misclosure, and the covariance of that.
        :param shared: covariance with these loops, shape (6, 6 m).
        :param loose: unknown poses in it, shape (6, 6 S).
        """
        left = loose - shared @ self._weighed
        covariance = own - shared @ self._precision @ shared.T + left @ self._unknown @ left.T
        return off - shared @ self.pulled - loose @ self.sessions, covariance


def refuted(nodes: NodeErrors, edges: Sequence[ResolvedClosure], weights: np.ndarray) -> list[int]:
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
    ends, whole = loops.end_covariances(loops), loops.covariance()
    precision = np.linalg.inv(whole)
    taken, off, moved = np.arange(len(weights)), loops.misclosures(), False

    def rows(numbers: np.ndarray) -> np.ndarray:
        return (6 * numbers[:, None] + np.arange(6)).ravel()

    while True:
        own = rows(taken)
        given = Given(precision, loops.loose[own], off[own])
        squared = given.deviations()
        over = np.where(squared > REFUTED, squared / weights[taken], 0.0)
        if over.any():
            gone, moved = np.array([np.argmax(over)]), False
            rest = np.delete(np.arange(len(taken)), gone)
            a, b = rows(rest), rows(gone)
            core = np.linalg.solve(precision[np.ix_(b, b)], precision[np.ix_(b, a)])
            precision = precision[np.ix_(a, a)] - precision[np.ix_(a, b)] @ core
            taken = taken[rest]
        elif moved:
            break
        else:
            for _ in range(ITERATIONS):
                loops.move(ends[:, :, own], given)
                off, moved = loops.misclosures(), True
                given = Given(precision, loops.loose[own], off[own])
    left = []
    for i in np.setdiff1d(np.arange(len(weights)), taken).tolist():
        one = rows(np.array([i]))
        missed, covariance = given.predicted(
            off[one], whole[np.ix_(one, one)], whole[np.ix_(one, own)], loops.loose[one]
        )
        if _squared(missed[None], covariance[None])[0] > REFUTED:
            left.append(i)
    return left


def predicted(
    nodes: NodeErrors, edges: Sequence[ResolvedClosure], others: Sequence[ResolvedClosure]
) -> tuple[np.ndarray, np.ndarray]:
    """
    Return the deviations of edges from their predictions, and the odds that they are right.

    Odds by Bayes' rule: the density of the misclosure by the prediction, and that of a wrong
    place, which is anywhere on the map; as many of the edges are right as there are others.

    :returns: squared deviations and odds, shape (n,) each.
    """
    squared, odds = np.zeros((2, len(edges)))
    if not edges or not others:
        return squared + np.inf, odds
    known = Loops(nodes, others[:: -(-len(others) // LARGEST)])
    given = Given(np.linalg.inv(known.covariance()), known.loose, known.misclosures())
    for i, edge in enumerate(edges):
        loop = Loops(nodes, [edge])
        query, place = loop.end_covariances(known)
        missed, own = given.predicted(
            loop.misclosures(), loop.covariance(), query - place, loop.loose
        )
        back = adjoints(inverse(nodes.transforms[edge.query][None]))[0]
        missed, own = back @ missed, back @ own @ back.T
        squared[i] = _squared(missed[None], own[None])[0]
        turn, shift = (np.linalg.eigvalsh(own[k : k + 3, k : k + 3]) for k in (0, 3))
        volume = np.sqrt(2 * np.pi * shift[1] * shift[2] * turn[2])
        odds[i] = nodes.area / volume * np.exp(-squared[i] / 2) * len(others) / len(edges)
    return squared, odds


def _squared(off: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return squared Mahalanobis distances (n,) of deviations (n, 6)."""
    solved = np.linalg.solve(covariances, off[:, :, None])[:, :, 0]
    result: np.ndarray = (off * solved).sum(axis=1)
    return result
