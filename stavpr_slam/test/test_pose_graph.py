# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose graph as a library: drives on a circle with a known truth."""

from dataclasses import replace
from unittest.mock import Mock

from motions import exponentials
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph import align_maps, Closure, optimize, PoseGraph
from stavpr_slam.pose_graph import graph as graph_module
from stavpr_slam.pose_graph.transforms import body_covariance, planar_poses

SECOND = 10**9
LAP = 100  # images of 2 m
EXTREME = (np.nan, np.inf, 1e308, -1e308, 1e30, 1e-320, -1.0, 0.0)
NOISE = np.diag([0.3, 0.3, 0.3, 0.02, 0.02, 0.02]) ** 2


def circle(laps: int = 2) -> np.ndarray:
    """Return planar poses on a circle of 200 m."""
    angle = np.arange(laps * LAP) * 2 * np.pi / LAP
    radius = 2 * LAP / (2 * np.pi)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2])


def odometry_of(
    truth: np.ndarray, moved: np.ndarray | None = None, drift: float = 1.0, seed: int = 12
) -> np.ndarray:
    """
    Return an odometry with errors of the scale and of the heading, poses (N, 7).

    :param moved: whether it noticed the motion before each image, shape (N,).
    """
    dice, T = np.random.default_rng(seed), matrices(planar_poses(truth))
    steps = inverse(T[:-1]) @ T[1:]
    steps[:, :3, 3] *= 1 + drift * (0.02 * dice.normal(size=(len(steps), 1)) - 0.01)
    errors, length = np.zeros((len(steps), 6)), np.linalg.norm(steps[:, :3, 3], axis=1)
    errors[:, 2] = np.radians(0.5) * np.sqrt(length) * dice.normal(size=len(steps))
    errors[:, 2] += np.radians(0.02) * length
    steps = steps @ exponentials(drift * errors)
    poses = [np.eye(4)]
    for number, step in enumerate(steps, 1):
        poses.append(poses[-1] @ step if moved is None or moved[number] else poses[-1])
    return to_poses(np.array(poses))


def closure(truth, query, place, claimed=None, stamps=None, independent=None) -> Closure:
    """Measure query in place with noise, and claim it of another place."""
    T = matrices(planar_poses(truth[[place, query]]))
    Z = inverse(T[0]) @ T[1]
    Z[:2, 3] += np.random.default_rng(query).normal(size=2) * 0.1
    at = (np.arange(len(truth)) + 1) * SECOND if stamps is None else stamps
    to = place if claimed is None else claimed
    marked = query % 3 == 0 if independent is None else independent
    return Closure(int(at[query]), int(at[to]), to_poses(Z), NOISE, marked)


def error(poses: np.ndarray, truth: np.ndarray) -> float:
    """Return the rms distance (m) after alignment in the plane."""
    a, b = poses[:, :2] - poses[:, :2].mean(axis=0), truth[:, :2] - truth[:, :2].mean(axis=0)
    turn, _ = Rotation.align_vectors(np.pad(b, ((0, 0), (0, 1))), np.pad(a, ((0, 0), (0, 1))))
    moved = turn.apply(np.pad(a, ((0, 0), (0, 1))))[:, :2]
    return float(np.sqrt(((moved - b) ** 2).sum(axis=1).mean()))


def solve(truth, closures, odometry=None, stamps=None):
    at = (np.arange(len(truth)) + 1) * SECOND if stamps is None else stamps
    return optimize(at, odometry_of(truth) if odometry is None else odometry, closures)


def graph_of(odometry, closures=(), late=0, every=0, begin=0):
    """
    Return a graph of a drive, an image each second.

    :param closures: each is added so many images late.
    :param every: images, from ``begin`` on, after which the graph is updated; 0 = never.
    """
    graph, waiting = PoseGraph(), list(closures)
    for i, pose in enumerate(odometry):
        graph.add_odometry((i + 1) * SECOND, pose)
        while waiting and waiting[0].query_stamp <= (i + 1 - late) * SECOND:
            graph.add_closure(waiting.pop(0))
        if every and i >= begin and i % every == 0:
            graph.update()
    return graph


@pytest.fixture(scope='module')
def drive():
    """Return the truth of two laps and the closures of the second."""
    truth = circle()
    return truth, [closure(truth, q, q - LAP) for q in range(LAP, 2 * LAP)]


def test_optimize_with_closures_corrects_drift(drive):
    truth, closures = drive
    estimate, graph = solve(truth, closures)
    assert error(odometry_of(truth), truth) > 3
    assert error(estimate, truth) < 1
    assert graph.accepted >= 0.95 * len(closures)


def test_burst_of_late_closures_ends_as_all_at_once(drive):
    """60 closures come together when the drive is over, the others as the robot drives."""
    truth, closures = drive
    graph = graph_of(odometry_of(truth), closures[60:], every=10)
    for measurement in closures[:60]:
        graph.add_closure(measurement)
    live = error(to_poses(graph.update()), truth)
    assert live == pytest.approx(error(solve(truth, closures)[0], truth), rel=0.05)
    online = matrices(graph.map_to_odom()) @ graph.chain.transforms[-1]
    np.testing.assert_allclose(online, graph.solved[-1], atol=1e-9)


def test_optimize_twice_gives_same_trajectory(drive):
    truth, closures = drive
    assert np.array_equal(solve(truth, closures[::4])[0], solve(truth, closures[::4])[0])


@pytest.mark.parametrize('run', [1, 20])
def test_optimize_with_wrong_closures_rejects_them(drive, run):
    """A third is wrong, alone or in runs that agree with each other."""
    truth, closures = drive
    false = [(q // run) % 3 == 1 for q in range(LAP)]
    mixed = [
        closure(truth, LAP + k, k, (k + 30 + 9 * (k // run % 5)) % LAP) if wrong else closures[k]
        for k, wrong in enumerate(false)
    ]
    estimate, graph = solve(truth, mixed)
    right = [own for own, wrong in zip(closures, false, strict=True) if not wrong]
    clean, _ = solve(truth, right)
    assert graph.rejected >= 0.9 * sum(false)
    assert error(estimate, truth) < 1.3 * error(clean, truth) + 0.1


def carried_drive():
    """
    Return a drive whose odometry misses 40 m before image 140, its odometry, and closures.

    Three closures before the break are of windows that have most of their images after it.
    """
    truth = np.delete(circle(3), np.s_[140:160], axis=0)
    moved = np.arange(len(truth)) != 140
    closures = []
    for q in range(LAP, len(truth) - 10):
        if 133 < q < 137:
            continue
        there = 157 + q - 137 if q < 140 else q + 20
        place = (there if q >= 137 else q) % LAP
        measured = closure(truth, q, q - LAP if q < 137 else place)
        if 137 <= q < 140:  # as seen from there
            measured = replace(closure(circle(3), there, place), query_stamp=(q + 1) * SECOND)
        closures.append(measured)
    return truth, odometry_of(truth, moved), closures


def test_optimize_carried_robot_cuts_where_the_odometry_stands():
    truth, odometry, closures = carried_drive()
    estimate, graph = solve(truth, closures, odometry)
    assert graph.splits == 1
    assert error(estimate, truth) < 1.5  # one image on the wrong side would be 2 m


def test_update_carried_robot_is_found_within_80_images():
    truth, odometry, closures = carried_drive()
    graph = graph_of(odometry[:222], closures, late=10, every=4, begin=LAP + 1)
    graph.update()
    estimate = np.array([graph.at((i + 1) * SECOND) for i in range(222)])
    assert error(estimate, truth[:222]) < 1.5


def test_optimize_odometry_reset_joins_sessions():
    truth = circle()
    stamps = (np.arange(2 * LAP) + 1) * SECOND
    stamps[LAP:] += 3600 * SECOND
    odometry = odometry_of(truth)
    odometry[LAP:] = odometry_of(truth[LAP:])
    closures = [closure(truth, q, q - LAP, stamps=stamps) for q in range(LAP, 2 * LAP)]
    estimate, graph = solve(truth, closures, odometry, stamps)
    assert graph.chain.sessions == 2
    assert 'no odometry for' in graph.chain.breaks[0][1]
    later = np.linalg.norm(estimate[LAP:, :2] - estimate[:LAP, :2], axis=1)
    assert later.max() < 1.0  # both passes of a place are at one place


def test_optimize_closures_with_map_move_graph_into_it():
    truth = circle(1)
    moved = planar_poses(truth + np.array([100.0, 50.0, 0.0]))
    same = np.array([0, 0, 0, 0, 0, 0, 1.0])
    closures = [
        Closure((q + 1) * SECOND, 7 + q, same, NOISE, q % 5 == 0, 'map', moved[q])
        for q in range(0, LAP, 2)
    ]
    estimate, _ = solve(truth, closures)
    assert np.linalg.norm(estimate[:, :3] - moved[:, :3], axis=1).max() < 1.0


def test_values_that_are_invalid_are_counted(drive):
    graph, bad = PoseGraph(), Closure(1, 2, drive[1][0].pose, np.zeros((6, 6)))
    with pytest.raises(InputError, match='not finite'):
        graph.add_odometry(SECOND, np.full(7, np.nan))
    with pytest.raises(InputError, match='positive definite'):
        graph.add_closure(bad)
    assert (graph.counts['invalid odometry'], graph.counts['invalid'], len(graph.chain)) == (
        1,
        1,
        0,
    )


@pytest.mark.parametrize('field', ['pose', 'place_pose', 'covariance', 'odometry'])
def test_update_after_extreme_values_is_finite(drive, field):
    """Values are rejected, or the graph computes with them; later closures still count."""
    truth, closures = drive
    graph, odometry = PoseGraph(), odometry_of(truth)
    rejected = 0
    for i, pose in enumerate(odometry):
        graph.add_odometry((i + 1) * SECOND, pose)
        if i < LAP:
            continue
        graph.add_closure(closures[i - LAP])
        value = EXTREME[i % len(EXTREME)]
        where = i % 6
        try:
            if field == 'odometry':
                bad = pose.copy()
                bad[where] = value
                graph.add_odometry((i + 1) * SECOND + 1, bad)
            else:
                good = replace(closures[i - LAP], place_pose=pose, map_id='map')
                bad = getattr(good, field).copy()
                bad.flat[7 * where if field == 'covariance' else where] = value
                graph.add_closure(replace(good, **{field: bad}))
        except InputError:
            rejected += 1
        if i % 10 == 0:
            graph.update()
    assert rejected > 30
    assert np.isfinite(graph.update()).all()
    assert graph.accepted > 50


def test_update_without_solution_leaves_new_closures_out(drive, monkeypatch):
    truth, closures = drive
    graph = graph_of(odometry_of(truth))
    for measurement in closures[:20]:
        graph.add_closure(measurement)
    graph.update()
    accepted = graph.accepted
    fails = Mock(side_effect=[np.linalg.LinAlgError, graph._solution])
    monkeypatch.setattr(graph_module.solution, 'add_closures', fails)
    graph.add_closure(closures[20])
    graph.update()
    assert graph.counts['failed'] == 1
    assert graph.accepted == accepted


def test_update_closure_of_unknown_stamp_is_counted(drive):
    truth, closures = drive
    graph = graph_of(odometry_of(truth)[:50])
    graph.add_closure(Closure(40 * SECOND, SECOND // 2, closures[0].pose, NOISE))
    graph.add_closure(Closure(60 * SECOND, SECOND, closures[0].pose, NOISE))
    graph.update()
    assert graph.counts['unknown stamp'] == 1
    assert graph.pending == 1


def test_add_closure_before_its_odometry_keeps_the_newest_only(drive, monkeypatch):
    monkeypatch.setattr(graph_module, 'MAX_PENDING', 3)
    graph = graph_of(odometry_of(drive[0])[:1])
    for measurement in drive[1][:5]:
        graph.add_closure(measurement)
    assert graph.pending == 3


def test_optimize_images_between_keyframes_have_their_odometry():
    poses = planar_poses(np.array([[0, 0, 0], [0.2, 0, 0], [0.3, 0.1, 0], [1.5, 0, 0.0]]))
    estimate, _ = optimize(SECOND * np.arange(1, 5), poses, [])
    np.testing.assert_allclose(estimate[:, :3], poses[:, :3], atol=1e-9)


def test_body_covariance_turned_by_90_degrees_swaps_axes():
    T = matrices(np.array([0, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]))
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    expected = np.diag([5.0, 4.0, 6.0, 2.0, 1.0, 3.0])
    np.testing.assert_allclose(body_covariance(covariance, T), expected, atol=1e-12)


def test_align_maps_with_wrong_pairs_returns_transform():
    truth = circle(1)
    poses = planar_poses(truth)
    move = matrices(planar_poses(np.array([[30.0, -20.0, 1.0]])))[0]
    reference = to_poses(move @ matrices(poses))
    pairs = np.array([(k, (k + 40) % LAP if k // 20 % 3 == 1 else k) for k in range(LAP)])
    np.testing.assert_allclose(align_maps(reference, poses, pairs), move, atol=0.3)


def test_align_maps_without_common_places_raises():
    poses = planar_poses(circle(1))
    with pytest.raises(InputError, match='common stretch'):
        align_maps(poses, poses, np.zeros((0, 2), int))
