# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What cycles of closures and odometry miss by, against simulated drives."""

import numpy as np
import pytest
from scipy.stats import chi2
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph.acceptance import SCALES
from stavpr_slam.pose_graph.closures import ResolvedClosure
from stavpr_slam.pose_graph.clusters import ConsistencySettings, grow
from stavpr_slam.pose_graph.cycles import Cycles
from stavpr_slam.pose_graph.keyframes import ChainSettings, KeyframeChain
from stavpr_slam.pose_graph.path_errors import OdometryNoise
from stavpr_slam.pose_graph.transforms import exponentials, logarithms, planar_poses

NOISE = OdometryNoise(0.05, 0.003, 0.0001)
COVARIANCE = np.diag([0.01, 0.01, 0.02, 0.3, 0.2, 0.1]) ** 2
LAP = 200
SPACE, PLANE = np.ones(6), np.array([0, 0, 1, 1, 1, 0])
TENTH = 10**8  # ns between images


def laps(count: int) -> np.ndarray:
    """Return the truth on an ellipse of 250 m, shape (N, 4, 4)."""
    angle = np.arange(count) * 2 * np.pi / LAP
    x, y = 50 * np.cos(angle), 30 * np.sin(angle)
    return matrices(planar_poses(np.column_stack([x, y, np.unwrap(np.arctan2(
        np.gradient(y), np.gradient(x)))])))  # fmt: skip


def drive(
    truth: np.ndarray, dice: np.random.Generator, scale: float = 1.0, axes: np.ndarray = SPACE,
    noise: OdometryNoise = NOISE,
) -> KeyframeChain:  # fmt: skip
    """Return an odometry with errors of all three kinds along some axes, rotation first."""
    steps = inverse(truth[:-1]) @ truth[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)[:, None]
    turned = noise.rotation * np.sqrt(length) * dice.normal(size=(len(steps), 3))
    turned += noise.bias * length * dice.normal(size=3)
    moved = noise.translation * np.sqrt(length) * dice.normal(size=(len(steps), 3))
    steps = steps @ exponentials(scale * axes * np.concatenate([turned, moved], axis=1))
    chain, pose = KeyframeChain(ChainSettings(0.1, 0.01), noise), truth[0]
    chain.add(TENTH, to_poses(pose))
    for i, step in enumerate(steps):
        pose = pose @ step
        chain.add((i + 2) * TENTH, to_poses(pose))
    assert len(chain) == len(truth)
    return chain


def measured(
    truth: np.ndarray, chain: KeyframeChain, query: int, place: int, dice: np.random.Generator,
    claimed: int | None = None, axes: np.ndarray = SPACE,
) -> ResolvedClosure:  # fmt: skip
    """Measure the query in the place, and claim it of another one."""
    error = axes * dice.multivariate_normal(np.zeros(6), COVARIANCE)[None]
    Z = inverse(truth[place]) @ truth[query] @ exponentials(error)[0]
    to = place if claimed is None else claimed
    return ResolvedClosure(query, to, Z, COVARIANCE, float(chain.travelled[query]), 0, 0, True)


def test_deviations_of_right_closures_are_chi_square():
    truth, dice = laps(2 * LAP), np.random.default_rng(0)
    ends = [(220, 20), (300, 100), (380, 180), (230, 25)]
    found = []
    for _ in range(30):
        chain = drive(truth, dice)
        cycles = Cycles(chain, [measured(truth, chain, *each, dice) for each in ends])
        found.append([cycles.deviations(i, 1.0) for i in range(len(ends))])
    squared = np.array(found)
    apart = ~np.eye(len(ends), dtype=bool)
    assert squared[:, ~apart] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(squared.mean(axis=0)[apart], 6, atol=1.6)
    above = (squared > chi2.ppf(0.95, 6)).mean(axis=0)[apart]
    assert 0 <= above.min() < above.max() < 0.2


def test_deviations_ahead_are_larger_than_across():
    """Ahead, an error of 10 m is improbable where one of 10 m across is not."""
    straight = np.tile(np.eye(4), (LAP, 1, 1))
    straight[:, 0, 3] = np.arange(LAP)
    chain = drive(straight, np.random.default_rng(0), 0.0)
    squared = []
    for off in ([10.0, 0, 0], [0, 10.0, 0]):
        Z = inverse(straight[0]) @ straight[150]
        Z[:3, 3] += off
        far = ResolvedClosure(150, 0, Z, COVARIANCE, 150.0, 0, 0, True)
        first = ResolvedClosure(1, 0, straight[1], COVARIANCE, 1.0, 0, 0, True)
        squared.append(Cycles(chain, [first, far]).deviations(0, 1.0)[1])
    assert squared[0] > 100 > 16 > squared[1]


def test_logarithm_of_a_turn_about_a_point_is_exact():
    turn, point = np.array([0.1, -0.2, 1.9]), np.array([3.0, -7.0, 2.0])
    motion = exponentials(np.array([[*turn, 0, 0, 0]]))
    motion[0, :3, 3] = point - motion[0, :3, :3] @ point
    expected = [*turn, *-np.cross(turn, point)]
    np.testing.assert_allclose(logarithms(motion)[0], expected, atol=1e-9)
    small = exponentials(np.array([[1e-7, 0, 0, 1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(logarithms(small)[0], [1e-7, 0, 0, 1, 2, 3], atol=1e-6)


@pytest.mark.parametrize('factor', [0.3, 1.0])
@pytest.mark.parametrize(('every', 'most'), [(0, 2), (10, 4)], ids=['right', 'tenth_wrong'])
def test_noise_scale_is_that_of_the_odometry(factor, every, most):
    truth, dice = laps(3 * LAP), np.random.default_rng(3)
    chain, closures = drive(truth, dice, factor, PLANE), []
    for number, query in enumerate(range(LAP, 3 * LAP, 10)):
        claimed = (query + 60) % LAP if every and number % every == 0 else None
        closures.append(measured(truth, chain, query, query % LAP, dice, claimed, PLANE))
    found = Cycles(chain, closures).noise_scale(SCALES)
    assert 0.5 * factor < found < most * factor


def test_grow_does_not_mix_places_of_two_laps():
    """Over a lap, the odometry is so uncertain that wrong closures agree with right ones."""
    truth, dice = laps(3 * LAP), np.random.default_rng(0)
    chain, clusters = drive(truth, dice), []
    for query in range(2 * LAP + 10, 2 * LAP + 18):
        place = query % LAP + (LAP if query % 2 else 0)
        edge = measured(truth, chain, query, place, dice)
        grow(clusters, edge, chain, 10.0, ConsistencySettings())
    assert [len(each.members) for each in clusters] == [4, 4]
    for cluster in clusters:
        places = [each.place for each in cluster.members]
        assert max(places) - min(places) < LAP
