# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Steps of Gauss and Newton on rigid motions: factors, and a sparse Cholesky decomposition by blocks.

A factor is a motion Z measured between two poses; its error is the logarithm of the inverse of Z
and their motion, and a step is a twist in the axes of the pose. Poses in the plane have the
three elements of a twist that are in it.
"""

from dataclasses import dataclass, field
import math

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu
from stavpr_ros.compilation import kernel
from stavpr_slam.pose_graph import tuning

TINY = 1e-12  # twice the sine of an angle
SMALL = 1e-5  # radians: of a rotation whose series are cut after two terms
SERIES = 1e-2  # radians: the same of the derivative of the logarithm
PATTERNS = 16  # that are kept
ALONE = 1e-9  # least part of its errors that a factor leaves to others


@kernel
def _between(a, b, result):
    """Write the inverse of a transform times another."""
    for i in range(3):
        result[i, 3] = 0.0
        for j in range(3):
            result[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]
            result[i, 3] += a[j, i] * (b[j, 3] - a[j, 3])


@kernel
def _logarithm(T, twist):
    """Write the logarithm of a transform, rotation first."""
    x, y, z = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]
    length, trace = math.sqrt(x * x + y * y + z * z), T[0, 0] + T[1, 1] + T[2, 2]
    angle = math.atan2(length, trace - 1)
    if length < TINY and trace < 0:  # half a turn, about an axis that is not known
        z = length = 1.0
    factor = angle / length if length > TINY else 0.5
    x, y, z = factor * x, factor * y, factor * z
    half = angle / 2
    rest = (1 - half / math.tan(half)) / angle**2 if angle > SMALL else 1 / 12
    a, b, c = T[0, 3], T[1, 3], T[2, 3]
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
    twist[0], twist[1], twist[2] = x, y, z
    twist[3] = a - p / 2 + rest * (y * r - z * q)
    twist[4] = b - q / 2 + rest * (z * p - x * r)
    twist[5] = c - r / 2 + rest * (x * q - y * p)


@kernel
def _move(T, twist, result):
    """Write a transform times the exponential of a twist."""
    x, y, z = twist[0], twist[1], twist[2]
    angle = math.sqrt(x * x + y * y + z * z)
    once, twice, third = 1.0, 0.5, 1 / 6
    if angle > SMALL:
        once = math.sin(angle) / angle
        twice = (1 - math.cos(angle)) / angle**2
        third = (1 - once) / angle**2
    a, b, c = twist[3], twist[4], twist[5]
    p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
    local = (
        (1 - twice * (y * y + z * z), twice * x * y - once * z, twice * x * z + once * y,
         a + twice * p + third * (y * r - z * q)),
        (twice * x * y + once * z, 1 - twice * (x * x + z * z), twice * y * z - once * x,
         b + twice * q + third * (z * p - x * r)),
        (twice * x * z - once * y, twice * y * z + once * x, 1 - twice * (x * x + y * y),
         c + twice * r + third * (x * q - y * p)),
    )  # fmt: skip
    for i in range(3):
        for j in range(4):
            result[i, j] = T[i, 3] * (j == 3)
            for k in range(3):
                result[i, j] += T[i, k] * local[k][j]
    result[3, :3], result[3, 3] = 0.0, 1.0


@kernel
def _derivative(twist, derivative):
    """
    Write the derivative of the logarithm of a transform by a twist behind it, (6, 6).

    It is x / (1 - exp(-x)) of x = ad(twist): 1 + x / 2 + a x^2 + b x^4, since the eigenvalues of x
    are 0 and +-i angle, each twice. The upper right block, which is 0, is not written.
    """
    w, v = twist[:3], twist[3:]
    square, both = w[0] ** 2 + w[1] ** 2 + w[2] ** 2, v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
    second, fourth = 1 / 12 + square / 720, -1 / 720
    if square > SERIES**2:
        half = math.sqrt(square) / 2
        even = half / math.tan(half)
        second = (1 - even) / square
        fourth = (1 - even / 2 - (half / math.sin(half)) ** 2 / 2) / square**2
    for a in range(3):
        for b in range(3):
            one = w[a] * w[b] - square * (a == b)
            mixed = v[a] * w[b] + w[a] * v[b] - 2 * both * (a == b)
            derivative[a, b] = second * one + (a == b)
            derivative[a + 3, b] = second * mixed - 2 * fourth * both * one
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for row, half_turn in ((0, w[c] / 2), (3, v[c] / 2)):
            derivative[row + b, a] += half_turn
            derivative[row + a, b] -= half_turn
    derivative[3:, 3:] = derivative[:3, :3]


@kernel
def _linearize(poses, ends, motions, information, at, errors, jacobians, local, deviations):
    """
    Write the errors of factors, their derivatives by the first pose, and the squared deviations.

    :param ends: first and second pose of each factor, (m, 2); the first is -1 for the origin.
    :param at: d elements of a twist that are variables.
    :param jacobians, local: written, (m, d, d): derivatives, and information, of a twist of the
        second pose. The error is the same as a twist: it is an eigenvector of its derivative.
    """
    d = len(at)
    origin, step, off, twist = np.eye(4), np.eye(4), np.eye(4), np.zeros(6)
    adjoint, derivative = np.zeros((6, 6)), np.zeros((6, 6))
    own, product = np.empty((d, d)), np.empty((d, d))
    for f in range(len(ends)):
        i, j = ends[f]
        _between(origin if i < 0 else poses[i], poses[j], step)
        _between(motions[f], step, off)
        _logarithm(off, twist)
        x, y, z = step[0, 3], step[1, 3], step[2, 3]
        for a in range(3):
            u, v, w = step[0, a], step[1, a], step[2, a]
            adjoint[a, 0] = adjoint[a + 3, 3] = -u
            adjoint[a, 1] = adjoint[a + 3, 4] = -v
            adjoint[a, 2] = adjoint[a + 3, 5] = -w
            adjoint[a + 3, 0] = v * z - w * y
            adjoint[a + 3, 1] = w * x - u * z
            adjoint[a + 3, 2] = u * y - v * x
        _derivative(twist, derivative)
        deviations[f] = 0.0
        for a in range(d):
            errors[f, a] = twist[at[a]]
            for b in range(d):
                jacobians[f, a, b] = adjoint[at[a], at[b]]
                own[a, b] = derivative[at[a], at[b]]
        product[:], local[f] = 0.0, 0.0
        _add(product, 1.0, information[f], own, False)
        _add(local[f], 1.0, own.T, product, False)
        for a in range(d):
            for b in range(d):
                deviations[f] += information[f, a, b] * errors[f, a] * errors[f, b]


@kernel
def _add(A, scale, B, C, is_transposed):
    """Add a scaled product of blocks to another one, or its transpose."""
    d = len(A)
    for a in range(d):
        for b in range(d):
            total = 0.0
            for c in range(d):
                total += B[a, c] * C[c, b]
            if is_transposed:
                A[b, a] += scale * total
            else:
                A[a, b] += scale * total


@kernel
def _assemble(ends, slots, errors, jacobians, information, weights, blocks, gradient):
    """Write the normal equations; slots: the block of the second pose, the first, and both."""
    blocks[:], gradient[:] = 0.0, 0.0
    d = errors.shape[1]
    one, product, pull = np.eye(d), np.empty((d, d)), np.empty(d)
    for f in range(len(ends)):
        w = weights[f]
        if w == 0.0:
            continue
        i, j = ends[f]
        own, other, both, is_transposed = slots[f]
        for a in range(d):
            pull[a] = 0.0
            for b in range(d):
                pull[a] -= w * information[f, a, b] * errors[f, b]
                blocks[own, a, b] += w * information[f, a, b]
            gradient[j, a] += pull[a]
        if i >= 0:
            product[:] = 0.0
            _add(product, w, information[f], jacobians[f], False)
            _add(blocks[both], 1.0, product, one, is_transposed == 1)
            _add(blocks[other], 1.0, jacobians[f].T, product, False)
            for a in range(d):
                for b in range(d):
                    gradient[i, b] += pull[a] * jacobians[f, a, b]


@kernel
def _root(A):
    """Decompose a block in place; return the logarithm of its determinant, NaN = it has none."""
    determinant = 0.0
    for a in range(len(A)):
        for b in range(a):
            for c in range(b):
                A[a, b] -= A[a, c] * A[b, c]
            A[a, b] /= A[b, b]
            A[b, a] = 0.0
        for c in range(a):
            A[a, a] -= A[a, c] ** 2
        if not A[a, a] > 0:
            return np.nan
        A[a, a] = math.sqrt(A[a, a])
        determinant += math.log(A[a, a])
    return determinant


@kernel
def _decompose(starts, rows, blocks):
    """
    Decompose the lower half of a matrix, by columns of blocks, in place (left-looking Cholesky).

    :returns: the logarithm of the determinant of the result; NaN = it is not positive definite.
    """
    count, d = len(starts) - 1, blocks.shape[1]
    head, link, first = np.full(count, -1), np.full(count, -1), starts[:-1].copy()
    where, pivot, determinant = np.zeros(count, np.int64), np.empty((d, d)), 0.0
    for j in range(count):
        for p in range(starts[j], starts[j + 1]):
            where[rows[p]] = p
        k = head[j]
        while k >= 0:  # columns that have a block in this row
            after = link[k]
            pivot[:] = blocks[first[k]]
            for p in range(first[k], starts[k + 1]):
                q = where[rows[p]]
                for a in range(d):
                    for b in range(d):
                        total = 0.0
                        for c in range(d):
                            total += blocks[p, a, c] * pivot[b, c]
                        blocks[q, a, b] -= total
            _queue(k, starts, rows, head, link, first)
            k = after
        determinant += _root(blocks[starts[j]])
        for p in range(starts[j] + 1, starts[j + 1]):
            for a in range(d):
                for b in range(d):
                    for c in range(b):
                        blocks[p, a, b] -= blocks[p, a, c] * blocks[starts[j], b, c]
                    blocks[p, a, b] /= blocks[starts[j], b, b]
        _queue(j, starts, rows, head, link, first)
    return determinant


@kernel
def _queue(k, starts, rows, head, link, first):
    """Note a column for the row of its next block."""
    first[k] += 1
    if first[k] < starts[k + 1]:
        row = rows[first[k]]
        link[k], head[row] = head[row], k


@kernel
def _forward(starts, rows, blocks, j, x):
    """Solve a column of the lower half in place for n right sides, x of shape (count, d, n)."""
    d, n = x.shape[1:]
    for a in range(d):
        for k in range(n):
            for c in range(a):
                x[j, a, k] -= blocks[starts[j], a, c] * x[j, c, k]
            x[j, a, k] /= blocks[starts[j], a, a]
    own = x[j].copy()
    for p in range(starts[j] + 1, starts[j + 1]):
        r = rows[p]
        for a in range(d):
            for k in range(n):
                total = 0.0
                for c in range(d):
                    total += blocks[p, a, c] * own[c, k]
                x[r, a, k] -= total


@kernel
def _backward(starts, rows, blocks, x):
    """Solve the upper half in place, x of shape (count, d, 1)."""
    count, d, _ = x.shape
    for j in range(count - 1, -1, -1):
        for p in range(starts[j] + 1, starts[j + 1]):
            for c in range(d):
                for a in range(d):
                    x[j, c, 0] -= blocks[p, a, c] * x[rows[p], a, 0]
        for a in range(d - 1, -1, -1):
            for c in range(a + 1, d):
                x[j, a, 0] -= blocks[starts[j], c, a] * x[j, c, 0]
            x[j, a, 0] /= blocks[starts[j], a, a]


@kernel
def _solve(
    poses, ends, errors, jacobians, information, weights, at, order, slots, starts, rows, result
):
    """Write the poses after a step, and return the logarithm of the determinant."""
    d = len(at)
    blocks, gradient = np.empty((len(rows), d, d)), np.empty((len(poses), d))
    _assemble(ends, slots, errors, jacobians, information, weights, blocks, gradient)
    determinant = _decompose(starts, rows, blocks)
    if np.isnan(determinant):
        return determinant
    x, twist = np.expand_dims(gradient[order], 2), np.zeros(6)
    for j in range(len(order)):
        _forward(starts, rows, blocks, j, x)
    _backward(starts, rows, blocks, x)
    for k in range(len(order)):
        for a in range(d):
            twist[at[a]] = x[k, a, 0]
        _move(poses[order[k]], twist, result[order[k]])
    return determinant


@kernel
def _covariances(
    ends, errors, jacobians, information, weights, at, order, slots, starts, rows, chosen, result
):
    """Write the covariances of the motions between the ends of some of the factors."""
    d, count = len(at), len(order)
    blocks, gradient = np.empty((len(rows), d, d)), np.empty((count, d))
    _assemble(ends, slots, errors, jacobians, information, weights, blocks, gradient)
    determinant = _decompose(starts, rows, blocks)
    column, x = np.empty(count, np.int64), np.zeros((count, d, d))
    for k in range(count):
        column[order[k]] = k
    for number in range(len(chosen)):
        f = chosen[number]
        first, second = column[ends[f, 0]], column[ends[f, 1]]
        for a in range(d):
            x[second, a, a] = 1.0
            for b in range(d):
                x[first, b, a] += jacobians[f, a, b]
        while True:  # the columns that a column fills are those of the ways to the last one
            j = min(first, second)
            if j == count:
                break
            _forward(starts, rows, blocks, j, x)
            _add(result[number], 1.0, x[j].T, x[j], False)
            x[j] = 0.0
            after = rows[starts[j] + 1] if starts[j] + 1 < starts[j + 1] else count
            first = after if first == j else first
            second = after if second == j else second
    return determinant


def squares(innovations: np.ndarray) -> np.ndarray:
    """Return the squared deviations of factors, (n,), see :meth:`Solver.innovations`."""
    errors, variances = np.split(innovations[:, :-1], 2, axis=1)
    result: np.ndarray = (errors**2 / (1 + variances)).sum(axis=1)
    return result


def likelihoods(innovations: np.ndarray) -> np.ndarray:
    """Return the logarithms of their densities, but for the constant of a normal one, (n,)."""
    variances = 1 + np.split(innovations[:, :-1], 2, axis=1)[1]
    size = innovations[:, -1] + np.log(variances).sum(axis=1)
    return np.asarray(-(squares(innovations) + size) / 2)


def scale_errors(innovations: np.ndarray, factor: float) -> np.ndarray:
    """Return innovations where all errors are larger by a factor."""
    d, result = innovations.shape[1] // 2, innovations.copy()
    result[:, :d] /= factor
    result[:, -1] += 2 * d * math.log(factor)
    return result


@dataclass(frozen=True, eq=False)
class Pattern:
    """
    Blocks of the decomposition, for some of the factors.

    :param order: the poses in the order of elimination, (V,).
    :param starts, rows: blocks of each column, the diagonal first, as in a CSC matrix.
    :param slots: blocks of each factor: second pose, first, both, and whether transposed, (m, 4).
    """

    active: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    slots: np.ndarray

    @classmethod
    def of(cls, ends: np.ndarray, count: int, active: np.ndarray) -> 'Pattern':
        """Order by minimum degree, and take the blocks of a matrix without zeros in its roots."""
        i, j = ends[active & (ends[:, 0] >= 0)].T
        graph = coo_array((np.full(len(i), -1.0), (i, j)), (count, count))
        graph = graph + graph.T
        # a Laplacian and little: what fills its root does not vanish along a path
        graph = (graph + diags_array(1e-3 - graph.sum(axis=0))).tocsc()
        options = {'SymmetricMode': True}
        lu = splu(graph, 'MMD_AT_PLUS_A', diag_pivot_thresh=0.0, relax=1, options=options)
        place, L = lu.perm_c, lu.L.tocsc().sorted_indices()
        starts, rows = L.indptr.astype(np.int64), L.indices.astype(np.int64)
        keys = np.repeat(np.arange(count), np.diff(starts)) * count + rows
        first, second = place[ends[:, 0]], place[ends[:, 1]]
        column, row = np.minimum(first, second), np.maximum(first, second)
        both = np.searchsorted(keys, column * count + row)
        slots = np.stack([starts[second], starts[first], both, first > second], axis=1)
        return cls(active, np.argsort(place), starts, rows, slots.astype(np.int64))


@dataclass(eq=False)
class Solver:
    """
    Solves for poses by factors.

    :param ends, motions: as in :func:`_linearize`, (m, 2) and (m, 4, 4).
    :param at: as in :func:`_linearize`.
    """

    ends: np.ndarray
    motions: np.ndarray
    at: np.ndarray
    _patterns: list[Pattern] = field(default_factory=list)

    def linearize(self, poses: np.ndarray, information: np.ndarray) -> np.ndarray:
        """Return the squared deviations of all factors, (m,), and keep their derivatives."""
        count, d = len(self.ends), len(self.at)
        self._errors, self._local = np.empty((count, d)), np.empty((count, d, d))
        self._jacobians = np.empty((count, d, d))
        result = np.empty(count)
        _linearize(
            poses, self.ends, self.motions, information, self.at, self._errors, self._jacobians,
            self._local, result,
        )  # fmt: skip
        return result

    def step(self, poses: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
        """
        Return the poses after a step from those that were linearized at last.

        :param weights: of the factors, (m,).
        :returns: and the logarithm of the determinant of the square root of the information.
        :raises LinAlgError: the poses have no unique solution.
        """
        pattern, result = self._pattern(weights > 0, len(poses)), np.empty_like(poses)
        determinant = _solve(
            poses, self.ends, self._errors, self._jacobians, self._local, weights, self.at,
            pattern.order, pattern.slots, pattern.starts, pattern.rows, result,
        )  # fmt: skip
        if not math.isfinite(determinant) or not np.isfinite(result).all():
            raise np.linalg.LinAlgError('the pose graph has no unique solution')
        return result, determinant

    def innovations(
        self, count: int, weights: np.ndarray, chosen: np.ndarray, spread: np.ndarray | None = None
    ) -> np.ndarray:
        """
        Return how factors differ from what the others expect, at the poses linearized at last.

        :param count: number of poses.
        :param weights: of the factors, (m,).
        :param chosen: n of them, which have a first pose.
        :param spread: covariances of the motions between their ends, (n, d, d); None = as solved.
        :returns: in rows of 2 d + 1: errors on axes where they do not correlate, in deviations of
            the factor, variances of what the others expect there, and the logarithm of the
            determinant of the covariance of the factor.
        """
        if spread is None:
            pattern, d = self._pattern(weights > 0, count), len(self.at)
            spread = np.zeros((len(chosen), d, d))
            _covariances(
                self.ends, self._errors, self._jacobians, self._local, weights, self.at,
                pattern.order, pattern.slots, pattern.starts, pattern.rows, chosen, spread,
            )  # fmt: skip
        root = np.linalg.cholesky(self._local[chosen])
        variances, axes = np.linalg.eigh(root.mT @ spread @ root)
        variances, counts = variances.clip(0), weights[chosen, None] > 0
        # factors that count have made errors and variances smaller
        rest = np.where(counts, (1 - variances).clip(ALONE), 1.0)
        errors = (axes.mT @ (root.mT @ self._errors[chosen, :, None]))[:, :, 0]
        size = -2 * np.log(np.einsum('nii->ni', root)).sum(axis=1)
        return np.column_stack([errors / rest, variances / rest, size])

    def _pattern(self, active: np.ndarray, count: int) -> Pattern:
        size = active.sum()
        for pattern in self._patterns:
            most = (tuning.SPARE if len(pattern.rows) < tuning.FILLED * size else 1.02) * size
            if not (active & ~pattern.active).any() and pattern.active.sum() <= most:
                return pattern
        self._patterns = [Pattern.of(self.ends, count, active), *self._patterns[: PATTERNS - 1]]
        return self._patterns[0]


def compile_kernels() -> None:
    """Compile all kernels, by a step of two poses, for ``stavpr warm``."""
    ends, count = np.array([[-1, 0], [0, 1]]), 2
    poses, weights = np.tile(np.eye(4), (count, 1, 1)), np.ones(count)
    solver = Solver(ends, poses.copy(), np.arange(6))
    solver.linearize(poses, np.tile(np.eye(6), (count, 1, 1)))
    solver.step(poses, weights)
    solver.innovations(count, weights, np.array([1]))
