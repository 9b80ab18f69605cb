# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each rule of the pose graph has a drive that is worse without it."""

from dataclasses import replace
from unittest.mock import Mock

from motions import exponentials
import numpy as np
import pytest
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam.pose_graph import (
    Closure,
    keyframes,
    network,
    optimize,
    PoseGraph,
    solution,
    tuning,
)
from stavpr_slam.pose_graph.transforms import adjoints, planar_poses
from test_pose_graph import carried_drive, circle, closure, error, LAP, odometry_of, SECOND


def ratio(truth, odometry, closures):
    """Return the error after / before, and the graph."""
    stamps = (np.arange(len(truth)) + 1) * SECOND
    estimate, graph = optimize(stamps, odometry, closures)
    return error(estimate, truth) / error(odometry, truth), graph


def false_shifts(count: int, share: float, run: int) -> list[int]:
    """Return by how many images the places of closures are wrong, a share of them, in runs."""
    dice = np.random.default_rng(9)
    shifts = dice.integers(31, 70, -(-count // run))
    shifts *= dice.random(len(shifts)) < share
    return np.repeat(shifts, run)[:count].tolist()


def false_drive(kind: str):
    """Return three laps, their odometry, and closures that are false, all or in a way."""
    truth, closures = circle(3) * [3.0, 3.0, 1.0], []
    shifts = false_shifts(2 * LAP, 1.0, {'runs': 20, 'long runs': 40}.get(kind, 1))
    for query, shift in zip(range(LAP, 3 * LAP), shifts, strict=True):
        place = query % LAP
        claimed = (place + (40 if kind == 'shift' else shift)) % LAP
        if kind == 'laps':  # returning every lap, each time beside the lap before
            place, claimed = query - LAP, max(query - LAP - 35, 0)
        closures.append(closure(truth, query, place, claimed, independent=True))
    return truth, slight(truth, 0.12), closures


def slight(truth, drift):
    return odometry_of(truth, drift=drift, seed=9)


@pytest.mark.parametrize('kind', ['random', 'runs', 'long runs', 'shift', 'laps'])
def test_only_false_closures_leave_the_odometry(kind):
    relative, graph = ratio(*false_drive(kind))
    assert relative < 1.02
    assert graph.accepted == 0


@pytest.mark.parametrize(('drift', 'most'), [(0.25, 0.2), (8.0, 1.02)])
def test_odometry_of_other_errors_is_corrected_or_stays(drift, most):
    truth, queries = circle(4), range(LAP, 4 * LAP, 2)
    closures = [
        closure(truth, query, query % LAP, (query + shift) % LAP)
        for query, shift in zip(queries, false_shifts(len(queries), 0.3, 20), strict=True)
    ]
    assert ratio(truth, slight(truth, drift), closures)[0] < most


def test_false_closures_and_the_right_half_that_comes_later():
    truth, odometry, closures = false_drive('shift')
    graph = PoseGraph()
    for i, pose in enumerate(odometry):
        graph.add_odometry((i + 1) * SECOND, pose)
    for measurement in closures:
        graph.add_closure(measurement)
    graph.update()
    assert graph.accepted == 0
    for query in range(LAP, 3 * LAP):
        graph.add_closure(closure(truth, query, query - LAP))
    estimate = graph.update(final=True)
    assert graph.accepted > 150
    assert error(to_poses(estimate), truth) < 0.5 * error(odometry, truth)


@pytest.mark.parametrize('drift', [0.06, 0.5, 2.0])
def test_odometry_of_any_noise_is_never_made_worse(drift):
    """A third of the closures are false in runs; the odometry is trusted too much at first."""
    truth, queries = circle(4), range(LAP, 4 * LAP, 2)
    closures = [
        closure(truth, query, query % LAP, (query + shift) % LAP)
        for query, shift in zip(queries, false_shifts(len(queries), 0.3, 20), strict=True)
    ]
    assert ratio(truth, slight(truth, drift), closures)[0] < 1.0


def test_large_drift_with_a_tight_odometry_only(monkeypatch):
    truth = circle(4)
    closures = [closure(truth, q, q - LAP) for q in range(LAP, 4 * LAP, 2)]
    drive = truth, slight(truth, 2.0), closures
    relative, graph = ratio(*drive)
    assert relative < 0.15
    assert graph.scale > tuning.TIGHT
    monkeypatch.setattr(tuning, 'SCALES', tuning.SCALES[:1])
    assert ratio(*drive)[0] > 0.3


@pytest.mark.parametrize('group', [1, 10, 50])
def test_groups_of_closures_end_in_the_same_path(group):
    truth, queries = circle(3), range(LAP, 3 * LAP, 4)
    odometry = slight(truth, 0.3)
    closures = [
        closure(truth, query, query % LAP, (query + shift) % LAP)
        for query, shift in zip(queries, false_shifts(len(queries), 0.3, 1), strict=True)
    ]
    graph, waiting = PoseGraph(), list(closures)
    for i, pose in enumerate(odometry):
        graph.add_odometry((i + 1) * SECOND, pose)
        while len(waiting) >= 1 and waiting[0].query_stamp <= (i + 1) * SECOND:
            graph.add_closure(waiting.pop(0))
        if graph.pending >= group:
            graph.update()
            now = to_poses(graph.solved)
            assert (
                error(now, truth[: i + 1]) < 1.02 * error(odometry[: i + 1], truth[: i + 1]) + 0.2
            )
    estimate = to_poses(graph.update(final=True))
    whole, _ = optimize((np.arange(len(truth)) + 1) * SECOND, odometry, closures)
    assert np.linalg.norm(estimate[:, :3] - whole[:, :3], axis=1).max() < 1e-6


def slipping() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the truth, an odometry that slips from image 30 to 50, and a filter's covariances."""
    truth, dice = circle(), np.random.default_rng(2)
    T = matrices(planar_poses(truth))
    steps = inverse(T[:-1]) @ T[1:]
    slips = (np.arange(len(steps)) // 10 % 20 // 2 == 1)[:, None]
    deviations = np.where(slips, [0, 0, 0.04, 0.2, 0.1, 0], [0, 0, 0.001, 0.005, 0.005, 0])
    errors = deviations * dice.normal(size=deviations.shape) + slips * [0, 0, 0.02, 0, 0, 0]
    poses, own, covariances = [np.eye(4)], np.zeros((6, 6)), [np.zeros((6, 6))]
    for step, deviation in zip(steps @ exponentials(errors), deviations, strict=True):
        poses.append(poses[-1] @ step)
        back, turn = adjoints(inverse(step)[None])[0], np.zeros((6, 6))
        own = back @ own @ back.T + np.diag(deviation**2 + 1e-10)
        turn[:3, 3:] = turn[3:, :3] = poses[-1][:3, :3]
        covariances.append(turn @ own @ turn.T)
    return truth, to_poses(np.array(poses)), np.array(covariances)


def test_covariances_of_the_odometry_correct_the_stretch_that_slips(monkeypatch):
    truth, odometry, covariances = slipping()

    def error_with(given):
        graph = PoseGraph()
        for i, pose in enumerate(odometry):
            covariance = None if given is None else given[i]
            graph.add_odometry((i + 1) * SECOND, pose, covariance=covariance)
        for q in range(LAP, 2 * LAP):
            graph.add_closure(closure(truth, q, q - LAP))
        graph.update(final=True)
        return error(to_poses(graph.solved), truth)

    without = error_with(None)
    assert error_with(covariances) < 0.6 * without
    constant = np.tile(np.diag([0.01] * 6), (len(odometry), 1, 1))
    assert error_with(constant) == error_with(0 * constant) == without
    monkeypatch.setattr(keyframes, 'message_growth', lambda *_: None)
    assert error_with(covariances) == without


def test_few_wrong_closures_join_no_session(monkeypatch):
    """The odometry stops for 10 s; behind it, six closures are of one wrong place."""
    truth = circle(1)
    stamps = (np.arange(LAP) + 1) * SECOND
    stamps[50:] += 10 * SECOND
    made = [closure(truth, q, q, q - 50, stamps) for q in range(70, 76)]
    estimate, _ = optimize(stamps, odometry_of(truth), made)
    assert error(estimate, truth) < 2
    monkeypatch.setattr(tuning, 'JOINS', 1)
    estimate, _ = optimize(stamps, odometry_of(truth), made)
    assert error(estimate, truth) > 20


def wrong_at_the_end(count: int, laps: int = 2, size: float = 1.0):
    """Return laps, the last closures of which are of one wrong place."""
    truth = circle(laps) * [size, size, 1]
    right = laps * LAP - count
    closures = [
        closure(truth, q, q % LAP, (q + 40) % LAP if q >= right else None)
        for q in range(LAP, laps * LAP)
    ]
    return truth, odometry_of(truth), closures


def test_wrong_closures_prove_no_break():
    relative, graph = ratio(*wrong_at_the_end(28))
    assert graph.splits == 0
    assert relative < 1.02


def test_few_false_runs_prove_no_break():
    """A session that begins anywhere lets 37 of 150 agree, all of which are false."""
    truth, dice = circle(4), np.random.default_rng(36)
    shifts = np.repeat(dice.integers(31, 70, 8), 20)[: 3 * LAP // 2].tolist()
    closures = [
        closure(truth, query, query % LAP, (query + shift) % LAP)
        for query, shift in zip(range(LAP, 4 * LAP, 2), shifts, strict=True)
    ]
    relative, graph = ratio(truth, odometry_of(truth, drift=0.5, seed=36), closures)
    assert (graph.accepted, graph.splits) == (0, 0)
    assert relative < 1.02


def test_carried_robot_without_breaks(monkeypatch):
    """With breaks, see test_optimize_carried_robot_cuts_where_the_odometry_stands."""
    monkeypatch.setattr(tuning, 'SUPPORT', 10**6)
    relative, graph = ratio(*carried_drive())
    assert (relative > 0.3, graph.splits) == (True, 0)


def test_false_runs_are_tried_at_few_factors(monkeypatch):
    """A break explains each run: a decision at all factors would be of no use."""
    counting = Mock(wraps=solution.solve_drives)
    monkeypatch.setattr(solution, 'solve_drives', counting)
    ratio(*false_drive('long runs'))
    assert [len(call.args) for call in counting.call_args_list].count(2) == 1
    monkeypatch.setattr(PoseGraph, '_proves', lambda *_: True)
    ratio(*false_drive('long runs'))
    assert [len(call.args) for call in counting.call_args_list].count(2) > 2


def test_break_is_at_a_pause(monkeypatch):
    """The odometry drives on behind a gap of 4.9 s as before."""
    truth, _, closures = carried_drive()
    odometry, late = odometry_of(circle(3)[: len(truth)]), int(3.9 * SECOND)
    stamps = (np.arange(len(truth)) + 1) * SECOND
    stamps[140:] += late
    closures = [
        replace(measurement, query_stamp=measurement.query_stamp + late * (number > 140))
        for measurement in closures
        if not 137 < (number := measurement.query_stamp // SECOND) <= 140
    ]
    estimate, _ = optimize(stamps, odometry, closures)
    assert error(estimate, truth) < 1
    monkeypatch.setattr(tuning, 'PAUSE', np.inf)
    estimate, _ = optimize(stamps, odometry, closures)
    assert error(estimate, truth) > 3


def test_recorded_drive_in_groups_of_ten_is_never_above_its_odometry(data_folder):
    """Drive 06 of KITTI with an appearance detector's closures, two thirds of them false."""
    folder = data_folder / 'kitti_graphs/06'
    odometry, truth, pairs = (
        np.loadtxt(folder / f'{name}.csv', delimiter=',', skiprows=1)
        for name in ('odometry', 'truth', 'closures_alpha_0.30')
    )
    poses, graph, at = planar_poses(odometry), PoseGraph(), 0
    covariance = np.diag([3.0] * 3 + [np.radians(20)] * 3) ** 2
    pairs = pairs[np.argsort(pairs[:, 0], kind='stable')].astype(int)
    for number, (query, place) in enumerate(pairs.tolist(), 1):
        while at <= query:
            graph.add_odometry((at + 1) * SECOND, poses[at])
            at += 1
        stamps = (query + 1) * SECOND, (place + 1) * SECOND
        graph.add_closure(Closure(*stamps, np.array([0, 0, 0, 0, 0, 0, 1.0]), covariance))
        if number % 10 == 0 or number == len(pairs):
            graph.update(final=number == len(pairs))
            estimate = np.array([graph.at((i + 1) * SECOND) for i in range(at)])
            before = error(poses[:at], truth[:at])
            assert error(estimate, truth[:at]) < max(1.02 * before, before + 0.2)
    assert error(estimate, truth[:at]) < 0.75 * before


def test_factor_without_a_solution_is_not_tried_again(monkeypatch):
    """The estimate stays at the factor before, and the update ends."""
    truth = circle(3)
    closures = [closure(truth, query, query - LAP) for query in range(LAP, 3 * LAP, 2)]
    expected, _ = ratio(truth, slight(truth, 0.3), closures)
    fit, scales = network.Network.fit, []

    def failing(graph, information, *others):
        scales.append(np.linalg.slogdet(information[1])[1])
        if scales[-1] > scales[0] + 3:  # of an odometry that is trusted more
            raise np.linalg.LinAlgError
        return fit(graph, information, *others)

    monkeypatch.setattr(network.Network, 'fit', failing)
    assert ratio(truth, slight(truth, 0.3), closures)[0] == pytest.approx(expected, rel=0.5)
    assert max(scales) > scales[0] + 3
