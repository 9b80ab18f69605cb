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
SERIES = 1e-2  # radians: the same of the logarithm and its derivative
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
def _move(poses, at, steps):
    """Return poses times the exponentials of twists, by their elements that are variables."""
    twist, result = np.zeros(6), poses.copy()
    for k in range(len(poses)):
        for a in range(len(at)):
            twist[at[a]] = steps[k, a]
        x, y, z = twist[0], twist[1], twist[2]
        angle = math.sqrt(x * x + y * y + z * z)
        once, twice, third = 1.0, 0.5, 1 / 6
        if angle > SMALL:
            once = math.sin(angle) / angle
            twice = (1 - math.cos(angle)) / angle**2
            third = (1 - once) / angle**2
        for i in range(3):  # a row of the rotation, turned once and twice
            a, b, c = poses[k, i, 0], poses[k, i, 1], poses[k, i, 2]
            p, q, r = b * z - c * y, c * x - a * z, a * y - b * x
            u, v, w = q * z - r * y, r * x - p * z, p * y - q * x
            result[k, i, 0] += once * p + twice * u
            result[k, i, 1] += once * q + twice * v
            result[k, i, 2] += once * r + twice * w
            result[k, i, 3] += (
                (a + twice * p + third * u) * twist[3]
                + (b + twice * q + third * v) * twist[4]
                + (c + twice * r + third * w) * twist[5]
            )
    return result


@kernel
def _logarithm(T, twist, derivative):
    """
    Write the logarithm of a transform, rotation first, and its derivative by a twist behind it.

    The derivative is x / (1 - exp(-x)) of x = ad(twist): 1 + x / 2 + a x^2 + b x^4, since the
    eigenvalues of x are 0 and +-i angle, each twice. Its block of the rotation, transposed, makes
    the translation a twist. The upper right block, which is 0, is not written.
    """
    w, v = twist[:3], twist[3:]
    w[0], w[1], w[2] = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]
    length, trace = math.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2), T[0, 0] + T[1, 1] + T[2, 2]
    angle = math.atan2(length, trace - 1)
    if length < TINY and trace < 0:  # half a turn, about an axis that is not known
        w[2] = length = 1.0
    w *= angle / length if length > TINY else 0.5
    half, square = angle / 2, angle**2
    second, fourth = 1 / 12 + square / 720, -1 / 720
    if angle > SERIES:
        even = half / math.tan(half)
        second = (1 - even) / square
        fourth = (1 - even / 2 - (half / math.sin(half)) ** 2 / 2) / square**2
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        derivative[a, a] = 1 + second * (w[a] ** 2 - square)
        derivative[a, b] = second * w[a] * w[b] - w[c] / 2
        derivative[b, a] = second * w[a] * w[b] + w[c] / 2
    for a in range(3):
        v[a] = 0.0
        for b in range(3):
            v[a] += derivative[b, a] * T[b, 3]
    both = v[0] * w[0] + v[1] * w[1] + v[2] * w[2]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        mixed = second * (v[a] * w[b] + w[a] * v[b]) - 2 * fourth * both * w[a] * w[b]
        derivative[a + 3, a] = -2 * fourth * both * (w[a] ** 2 - square)
        derivative[a + 3, a] += 2 * second * (v[a] * w[a] - both)
        derivative[a + 3, b], derivative[b + 3, a] = mixed - v[c] / 2, mixed + v[c] / 2
    derivative[3:, 3:] = derivative[:3, :3]


@kernel
def _linearize(poses, ends, motions, information, at):
    """
    Return the errors of factors, their derivatives, information, and the squared deviations.

    :param ends: first and second pose of each factor, (m, 2); the first is -1 for the origin.
    :param at: d elements of a twist that are variables.
    :returns: errors (m, d), derivatives by the first pose, and information, of a twist of the
        second pose, (m, d, d) each. The error is the same as a twist: it is an eigenvector of its
        derivative.
    """
    m, d = len(ends), len(at)
    errors, deviations = np.empty((m, d)), np.zeros(m)
    jacobians, local = np.empty((m, d, d)), np.zeros((m, d, d))
    origin, step, off, twist = np.eye(4), np.eye(4), np.eye(4), np.zeros(6)
    adjoint, derivative = np.zeros((6, 6)), np.zeros((6, 6))
    own, product = np.empty((d, d)), np.empty((d, d))
    for f in range(m):
        i, j = ends[f]
        _between(origin if i < 0 else poses[i], poses[j], step)
        _between(motions[f], step, off)
        _logarithm(off, twist, derivative)
        for b in range(3):
            c, e = (b + 1) % 3, (b + 2) % 3
            for a in range(3):
                adjoint[a, b] = adjoint[a + 3, b + 3] = -step[b, a]
                adjoint[a + 3, b] = step[c, a] * step[e, 3] - step[e, a] * step[c, 3]
        for a in range(d):
            errors[f, a] = twist[at[a]]
            for b in range(d):
                jacobians[f, a, b] = adjoint[at[a], at[b]]
                own[a, b] = derivative[at[a], at[b]]
        product[:] = 0.0
        _add(product, 1.0, information[f], own)
        _add(local[f], 1.0, own.T, product)
        for a in range(d):
            for b in range(d):
                deviations[f] += information[f, a, b] * errors[f, a] * errors[f, b]
    return errors, jacobians, local, deviations


@kernel
def _add(A, scale, B, C):
    """Add a scaled product of blocks to another one."""
    d = len(A)
    for a in range(d):
        for b in range(d):
            total = 0.0
            for c in range(d):
                total += B[a, c] * C[c, b]
            A[a, b] += scale * total


@kernel
def _assemble(columns, both, starts, rows, errors, jacobians, information, weights):
    """Return the normal equations in the order of elimination, the matrix decomposed."""
    d = errors.shape[1]
    blocks, gradient = np.zeros((len(rows), d, d)), np.zeros((len(starts) - 1, 1, d))
    product, pull = np.empty((d, d)), np.empty(d)
    for f in range(len(columns)):
        w = weights[f]
        if w == 0.0:
            continue
        i, j = columns[f]
        for a in range(d):
            pull[a] = 0.0
            for b in range(d):
                pull[a] -= w * information[f, a, b] * errors[f, b]
                blocks[starts[j], a, b] += w * information[f, a, b]
            gradient[j, 0, a] += pull[a]
        if i >= 0:
            product[:] = 0.0
            _add(product, w, information[f], jacobians[f])
            _add(blocks[starts[i]], 1.0, jacobians[f].T, product)
            for a in range(d):
                for b in range(d):
                    gradient[i, 0, b] += pull[a] * jacobians[f, a, b]
                    if i < j:
                        blocks[both[f], a, b] += product[a, b]
                    else:
                        blocks[both[f], b, a] += product[a, b]
    return blocks, gradient, _decompose(starts, rows, blocks)


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
def _divide(A, i, blocks, j):
    """Multiply a block by the inverse of a transposed root, in place."""
    for a in range(A.shape[1]):
        for b in range(A.shape[2]):
            for c in range(b):
                A[i, a, b] -= A[i, a, c] * blocks[j, b, c]
            A[i, a, b] /= blocks[j, b, b]


@kernel
def _decompose(starts, rows, blocks):
    """
    Decompose the lower half of a matrix, by columns of blocks, in place (right-looking Cholesky).

    :returns: the logarithm of the determinant of the result; NaN = it is not positive definite.
    """
    d, determinant = blocks.shape[1], 0.0
    pivot = np.empty((d, d))
    for j in range(len(starts) - 1):
        first, end = starts[j], starts[j + 1]
        determinant += _root(blocks[first])
        for p in range(first + 1, end):
            _divide(blocks, p, blocks, first)
        for p in range(first + 1, end):
            own, pivot[:] = starts[rows[p]], blocks[p]
            for q in range(p, end):
                while rows[own] < rows[q]:
                    own += 1
                for a in range(d):
                    for b in range(d):
                        total = 0.0
                        for c in range(d):
                            total += blocks[q, a, c] * pivot[b, c]
                        blocks[own, a, b] -= total
    return determinant


@kernel
def _forward(starts, rows, blocks, j, x):
    """Solve a column of the lower half in place for n right sides, x of shape (count, n, d)."""
    _divide(x, j, blocks, starts[j])
    (n, d), own = x.shape[1:], x[j].copy()
    for p in range(starts[j] + 1, starts[j + 1]):
        r = rows[p]
        for a in range(n):
            for b in range(d):
                total = 0.0
                for c in range(d):
                    total += own[a, c] * blocks[p, b, c]
                x[r, a, b] -= total


@kernel
def _solve(starts, rows, blocks, x):
    """Solve both halves in place for a right side, x of shape (count, 1, d)."""
    count, _, d = x.shape
    for j in range(count):
        _forward(starts, rows, blocks, j, x)
    for j in range(count - 1, -1, -1):
        for p in range(starts[j] + 1, starts[j + 1]):
            for a in range(d):
                for c in range(d):
                    x[j, 0, a] -= blocks[p, c, a] * x[rows[p], 0, c]
        for a in range(d - 1, -1, -1):
            for c in range(a + 1, d):
                x[j, 0, a] -= blocks[starts[j], c, a] * x[j, 0, c]
            x[j, 0, a] /= blocks[starts[j], a, a]


@kernel
def _covariances(starts, rows, blocks, columns, jacobians, result):
    """Write the covariances of the motions between the ends of factors, by their columns."""
    count, d = len(starts) - 1, blocks.shape[1]
    x = np.zeros((count, d, d))
    for f in range(len(columns)):
        first, second = columns[f]
        x[first] = jacobians[f]
        for a in range(d):
            x[second, a, a] = 1.0
        while min(first, second) < count:
            # a column fills the columns on the ways to the last one
            j = min(first, second)
            _forward(starts, rows, blocks, j, x)
            _add(result[f], 1.0, x[j], x[j].T)
            x[j] = 0.0
            after = rows[starts[j] + 1] if starts[j] + 1 < starts[j + 1] else count
            first = after if first == j else first
            second = after if second == j else second


def squares(innovations: np.ndarray) -> np.ndarray:
    """Return the squared deviations of factors, (n,), see :meth:`Solver.innovations`."""
    errors, variances = np.split(innovations[:, :-1], 2, axis=1)
    return (errors**2 / (1 + variances)).sum(axis=1)


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

    :param place: of the poses in the order of elimination, (V,).
    :param starts, rows: blocks of each column, the diagonal first, as in a CSC matrix.
    :param columns, both: of the ends of each factor, (m, 2), -1 = the origin, and the block of
        both, (m,).
    """

    active: np.ndarray
    place: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    both: np.ndarray

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
        place, L = lu.perm_c.astype(np.int64), lu.L.tocsc().sorted_indices()
        starts, rows = L.indptr.astype(np.int64), L.indices.astype(np.int64)
        keys = np.repeat(np.arange(count), np.diff(starts)) * count + rows
        columns = np.where(ends < 0, -1, place[ends])
        both = np.searchsorted(keys, columns.min(axis=1) * count + columns.max(axis=1))
        return cls(active, place, starts, rows, columns, both)


@dataclass(eq=False)
class Solver:
    """
    Solves for V poses by factors: the first V count always, others, closures, by their weights.

    :param ends, motions: as in :func:`_linearize`, (V + n, 2) and (V + n, 4, 4).
    :param at: as in :func:`_linearize`.
    """

    ends: np.ndarray
    motions: np.ndarray
    at: np.ndarray
    _patterns: list[Pattern] = field(default_factory=list)

    def linearize(self, poses: np.ndarray, information: np.ndarray) -> np.ndarray:
        """Return the squared deviations of all factors, (V + n,), and keep their derivatives."""
        self._errors, self._jacobians, self._local, deviations = _linearize(
            poses, self.ends, self.motions, information, self.at
        )
        return deviations

    def step(self, poses: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
        """
        Return the poses after a step from those that were linearized at last.

        :param weights: of the closures, (n,).
        :returns: and the logarithm of the determinant of the square root of the information.
        :raises LinAlgError: the poses have no unique solution.
        """
        pattern, blocks, x, determinant = self._decomposed(weights)
        if math.isfinite(determinant):
            _solve(pattern.starts, pattern.rows, blocks, x)
            result = _move(poses, self.at, x[pattern.place, 0])
            if np.isfinite(result).all():
                return result, determinant
        raise np.linalg.LinAlgError('the pose graph has no unique solution')

    def _decomposed(self, weights: np.ndarray) -> tuple[Pattern, np.ndarray, np.ndarray, float]:
        """Return the pattern, the blocks of the root, the right side, and its determinant."""
        count = len(self.ends) - len(weights)
        whole = np.concatenate([np.ones(count), weights])
        pattern = self._pattern(whole > 0, count)
        return pattern, *_assemble(
            pattern.columns, pattern.both, pattern.starts, pattern.rows, self._errors,
            self._jacobians, self._local, whole,
        )  # fmt: skip

    def innovations(
        self, weights: np.ndarray, chosen: np.ndarray, spread: np.ndarray | None = None
    ) -> np.ndarray:
        """
        Return how closures differ from what the others expect, at the poses linearized at last.

        :param weights: of all closures in that solution, (n,).
        :param chosen: numbers of some of them.
        :param spread: covariances of the motions between their ends, as solved if None.
        :returns: in rows of 2 d + 1: errors on axes where they do not correlate, in deviations of
            the closure, variances of what the others expect there, and the logarithm of the
            determinant of the covariance of the closure.
        """
        counts, chosen = weights[chosen, None] > 0, chosen + len(self.ends) - len(weights)
        if spread is None:
            pattern, blocks, *_ = self._decomposed(weights)
            columns, jacobians = pattern.columns[chosen], self._jacobians[chosen]
            spread = np.zeros_like(jacobians)
            _covariances(pattern.starts, pattern.rows, blocks, columns, jacobians, spread)
        root = np.linalg.cholesky(self._local[chosen])
        variances, axes = np.linalg.eigh(root.mT @ spread @ root)
        variances = variances.clip(0)
        # closures that count have made errors and variances smaller
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
    same, weights = np.tile(np.eye(4), (3, 1, 1)), np.ones(1)
    solver = Solver(np.array([[-1, 0], [0, 1], [0, 1]]), same, np.arange(6))
    solver.linearize(same[:2], np.tile(np.eye(6), (3, 1, 1)))
    solver.step(same[:2], weights)
    solver.innovations(weights, np.array([0]))
