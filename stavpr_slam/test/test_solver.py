# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Steps of the pose graph's solver, beside a dense solution whose derivatives are differences."""

from motions import exponentials, logarithms
from numba.core import event
import numpy as np
import pytest
from scipy.linalg import block_diag
from stavpr_ros.mapping.transforms import inverse
from stavpr_slam.pose_graph.g2o import graph_of as graph_of_file
from stavpr_slam.pose_graph.g2o import read_edges
from stavpr_slam.pose_graph.solver import compile_kernels, Solver, squares
from test_graph_files import write
from test_pose_graph import circle, closure, LAP, solve

PLANAR, SPATIAL = np.array([3, 4, 2]), np.arange(6)
N = 12


def random_motions(rng, count, at, turn):
    twists = np.zeros((count, 6))
    twists[:, at] = rng.normal(0, 1, (count, len(at)))
    twists[:, :3] *= turn
    twists[:, 3:] *= 5
    return exponentials(twists)


def graph_of(at, turn):
    """Return ends, motions, information and poses: the first one is tied to the origin."""
    rng = np.random.default_rng(len(at))
    chain = np.stack([np.arange(-1, N - 1), np.arange(N)], axis=1)
    ends = np.concatenate([chain, [[0, 7], [9, 2], [11, 3], [5, 11]]])
    motions = random_motions(rng, len(ends), at, turn)
    root = rng.normal(0, 1, (len(ends), len(at), len(at)))
    information = root @ root.transpose(0, 2, 1) + np.eye(len(at))
    return ends, motions, information, random_motions(rng, N, at, turn)


def errors_of(ends, motions, poses):
    first = np.where(ends[:, 0, None, None] < 0, np.eye(4), poses[ends[:, 0]])
    return logarithms(inverse(motions) @ inverse(first) @ poses[ends[:, 1]])


def moved(poses, x, at):
    twists = np.zeros((N, 6))
    twists[:, at] = x.reshape(N, -1)
    return poses @ exponentials(twists)


def derivatives(ends, motions, poses, at):
    """Return the derivatives of all errors by the poses, by differences."""
    size, h = N * len(at), 1e-6
    columns = []
    for k in range(size):
        ahead, behind = (
            errors_of(ends, motions, moved(poses, sign * h * np.eye(size)[k], at))[:, at]
            for sign in (1, -1)
        )
        columns.append(((ahead - behind) / (2 * h)).ravel())
    return np.array(columns).T


@pytest.mark.parametrize('at', [PLANAR, SPATIAL])
@pytest.mark.parametrize('turn', [1e-4, 0.1, 0.8])
def test_step_is_that_of_gauss_and_newton(at, turn):
    """Also where errors turn far: closures that are false."""
    ends, motions, information, poses = graph_of(at, turn)
    weights = np.ones(len(ends))
    weights[-2:] = 0.3, 0.0
    solver = Solver(ends, motions, at)
    squared = solver.linearize(poses, information)
    errors = errors_of(ends, motions, poses)[:, at]
    np.testing.assert_allclose(
        squared, np.einsum('ni,nij,nj->n', errors, information, errors), rtol=1e-6, atol=1e-9
    )
    J = derivatives(ends, motions, poses, at)
    W = block_diag(*(weights[:, None, None] * information))
    expected = moved(poses, -np.linalg.solve(J.T @ W @ J, J.T @ W @ errors.ravel()), at)
    result, determinant = solver.step(poses, weights[N:])
    np.testing.assert_allclose(result, expected, atol=1e-4)
    assert determinant == pytest.approx(np.linalg.slogdet(J.T @ W @ J)[1] / 2, abs=1e-5)


@pytest.mark.parametrize('at', [PLANAR, SPATIAL])
def test_deviations_are_by_the_errors_of_both_ends(at):
    ends, motions, information, poses = graph_of(at, 0.3)
    chosen, weights = np.array([N, N + 1, N + 3]), np.ones(len(ends))
    weights[chosen] = 0
    solver = Solver(ends, motions, at)
    solver.linearize(poses, information)
    errors, J = errors_of(ends, motions, poses)[:, at], derivatives(ends, motions, poses, at)
    W = block_diag(*(weights[:, None, None] * information))
    poses_covariance, expected = np.linalg.inv(J.T @ W @ J), []
    for f in chosen:
        own = J[f * len(at) : (f + 1) * len(at)]
        spread = np.linalg.inv(information[f]) + own @ poses_covariance @ own.T
        expected.append(errors[f] @ np.linalg.solve(spread, errors[f]))
    result = squares(solver.innovations(weights[N:], chosen - N))
    np.testing.assert_allclose(result, expected, rtol=1e-4)


def test_step_without_a_factor_of_the_step_before_is_that_of_a_new_solver():
    ends, motions, information, poses = graph_of(SPATIAL, 0.1)
    solver, weights = Solver(ends, motions, SPATIAL), np.ones(len(ends) - N)
    solver.linearize(poses, information)
    solver.step(poses, weights)
    weights[-1] = 0
    again, _ = solver.step(poses, weights)
    fresh = Solver(ends, motions, SPATIAL)
    fresh.linearize(poses, information)
    np.testing.assert_allclose(again, fresh.step(poses, weights)[0], atol=1e-9)


def test_pose_without_factors_has_no_solution():
    ends, motions, information, poses = graph_of(PLANAR, 0.1)
    solver, weights = Solver(ends, motions, PLANAR), np.ones(len(ends) - N)
    information[(ends == N - 1).any(axis=1)] = 0.0
    solver.linearize(poses, information)
    with pytest.raises(np.linalg.LinAlgError, match='no unique solution'):
        solver.step(poses, weights)


def test_kernels_that_are_compiled_at_build_are_all_of_a_drive_and_a_file(tmp_path):
    """The first closure of a robot compiles nothing: ``stavpr warm`` has."""

    class Compiled(event.Listener):
        def on_start(self, event):
            names.append(event.data['dispatcher'].py_func.__name__)

        def on_end(self, event):
            """Do nothing."""

    names = list[str]()
    compile_kernels()
    with event.install_listener('numba:compile', Compiled()):
        truth = circle()
        closures = [closure(truth, q, q - LAP) for q in range(LAP, 2 * LAP)]
        solve(truth, closures)
        for freedom in (3, 6):
            graph_of_file(read_edges(write(tmp_path / 'a.g2o', freedom, 0.3))).update(final=True)
    assert names == []
