# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each rule of the pose graph has a drive that is worse without it."""

from dataclasses import replace

import numpy as np
import pytest
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam import simulated_odometry
from stavpr_slam.pose_graph import (
    acceptance,
    breaks,
    ConsistencySettings,
    GraphSettings,
    keyframes,
    OdometryNoise,
    optimize,
    PoseGraph,
)  # fmt: skip
from stavpr_slam.pose_graph.consistency import ConsistentSet
from stavpr_slam.pose_graph.false_places import FalsePlaces
from stavpr_slam.pose_graph.transforms import adjoints, exponentials, planar_poses
from stavpr_slam.simulated_odometry import drifted
from test_pose_graph import carried_drive, circle, closure, error, LAP, odometry_of, SECOND

DEFAULT = GraphSettings()


def rules(**changes) -> GraphSettings:
    return replace(DEFAULT, consistency=ConsistencySettings(**changes))


def ratio(truth, odometry, closures, settings=DEFAULT):
    """Return the error after / before, and the graph."""
    stamps = (np.arange(len(truth)) + 1) * SECOND
    found, graph = optimize(stamps, odometry, closures, settings)
    return error(found, truth) / error(odometry, truth), graph


def test_false_runs_without_comparison_of_all_together(monkeypatch):
    """Four laps with closures for two of eight images, a third of them false in runs."""
    truth, false, known, closures = circle(4), FalsePlaces(0.3, True, 9), set(), []
    for query in range(LAP, 4 * LAP):
        known |= {query, query % LAP}
        claimed = false.place(query % LAP, known)
        if query % 8 < 2:
            closures.append(closure(truth, query, query % LAP, claimed))
    dice = np.random.default_rng(9)
    odometry = planar_poses(drifted(truth, np.ones(len(truth), bool), dice, 1.0))
    assert ratio(truth, odometry, closures)[0] < 0.1
    monkeypatch.setattr(acceptance, 'refuted', lambda *_: [])
    assert ratio(truth, odometry, closures)[0] > 0.3


def test_carried_robot_without_pairwise_consistency_or_breaks(monkeypatch):
    """With both, the error is below 5 %, see test_optimize_carried_robot_cuts_at_the_image."""
    drive = carried_drive()
    found, graph = ratio(*drive, rules(break_gain=10**6))
    assert (found > 0.3, graph.splits) == (True, 0)
    monkeypatch.setattr(
        ConsistentSet, 'conflicts', lambda _, clusters, __: np.zeros((len(clusters),) * 2, bool)
    )
    found, graph = ratio(*drive)
    assert (found > 0.3, graph.splits) == (True, 0)


def _unknown(_, edges, __):
    return np.full(len(edges), np.inf), np.zeros(len(edges))


def test_closures_of_single_images_without_confirmation(monkeypatch):
    truth = circle()
    closures = [closure(truth, q, q - LAP) for q in (*range(100, 120), *range(130, 200, 10))]
    drive = truth, odometry_of(truth), closures
    found, graph = ratio(*drive)
    monkeypatch.setattr(acceptance, 'predicted', _unknown)
    less, without = ratio(*drive)
    assert (graph.rejected, without.rejected) == (5, 7)
    assert found < 0.6 * less


def test_precise_odometry_without_estimate_of_its_errors():
    """A tenth of the closures are off by 2 m."""
    truth, closures = circle(), []
    for q in range(LAP, 2 * LAP):
        made = closure(truth, q, q - LAP)
        closures.append(replace(made, pose=made.pose + np.eye(7)[0] * 2 * (140 <= q < 150)))
    dice = np.random.default_rng(1)
    odometry = planar_poses(drifted(truth, np.ones(len(truth), bool), dice, 0.02))
    found, graph = ratio(truth, odometry, closures)
    assert graph.scale < 0.1
    less, _ = ratio(truth, odometry, closures, replace(DEFAULT, adapt=False))
    assert found < 0.5 * less


def test_heading_with_bias_without_its_covariance(monkeypatch):
    monkeypatch.setattr(simulated_odometry, 'HEADING_BIAS', 0.0009)
    monkeypatch.setattr(simulated_odometry, 'HEADING_NOISE', 0.001)
    truth = circle(3)
    known = [q for q in range(LAP, 3 * LAP) if q % LAP < 95]  # clusters end with a lap
    drive = truth, odometry_of(truth), [closure(truth, q, q % LAP) for q in known]
    found, graph = ratio(*drive)
    assert graph.rejected == 0
    less, _ = ratio(*drive, replace(DEFAULT, noise=OdometryNoise(bias=0.0)))
    assert found < 0.5 * less


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
    assert error_with(covariances) < 0.5 * without
    constant = np.tile(np.diag([0.01] * 6), (len(odometry), 1, 1))
    assert error_with(constant) == error_with(0 * constant) == without
    monkeypatch.setattr(keyframes, 'given_growth', lambda *_: None)
    assert error_with(covariances) == without


def test_few_wrong_closures_join_no_session():
    """The odometry stops for 10 s; behind it, six closures are of one wrong place."""
    truth = circle(1)
    stamps = (np.arange(LAP) + 1) * SECOND
    stamps[50:] += 10 * SECOND
    made = [closure(truth, q, q, q - 50, stamps) for q in range(70, 76)]
    found, _ = optimize(stamps, odometry_of(truth), made)
    assert error(found, truth) < 2
    found, _ = optimize(stamps, odometry_of(truth), made, rules(join_support=1))
    assert error(found, truth) > 20


def wrong_at_the_end(count: int, laps: int = 2, size: float = 1.0):
    """Return laps, the last closures of which are of one wrong place."""
    truth = circle(laps) * [size, size, 1]
    right = laps * LAP - count
    closures = [
        closure(truth, q, q % LAP, (q + 40) % LAP if q >= right else None)
        for q in range(LAP, laps * LAP)
    ]
    return truth, odometry_of(truth), closures


@pytest.mark.parametrize(
    ('given', 'rule'),
    [((28,), 'break_support'), ((45, 3, 0.25), 'break_distance')],
    ids=['few', 'short'],
)
def test_wrong_closures_prove_no_break(given, rule):
    drive = wrong_at_the_end(*given)
    found, graph = ratio(*drive)
    assert graph.splits == 0
    more, graph = ratio(*drive, rules(**{rule: 1}))
    assert graph.splits == 1
    assert found < 0.5 * more


def test_wrong_closures_beside_right_ones_prove_no_break():
    """At the end, 45 images have wrong closures, and 30 of these images right ones."""
    truth, odometry, closures = wrong_at_the_end(45)
    closures += [closure(truth, q, q % LAP) for q in range(2 * LAP - 30, 2 * LAP)]
    closures.sort(key=lambda each: each.query_stamp)
    assert ratio(truth, odometry, closures)[1].splits == 0
    assert ratio(truth, odometry, closures, rules(break_gain=1))[1].splits == 1


def unseen(closures):
    """Return closures whose windows lack the image at the break; a truck passes later."""
    return [
        replace(each, changes=tuple(
            (stamp, 0.95 if stamp == 146 * SECOND else change)
            for stamp, change in each.changes if stamp != 141 * SECOND
        ))
        for each in closures
    ]  # fmt: skip


def driving(truth):
    """Return an odometry that drives on while the robot is carried."""
    return odometry_of(circle(3)[: len(truth)])


def test_break_is_where_odometry_stands(monkeypatch):
    truth, odometry, closures = carried_drive()
    assert ratio(truth, odometry, unseen(closures))[0] < 0.03
    monkeypatch.setattr(breaks, 'STOPPED', 0.0)
    assert ratio(truth, odometry, unseen(closures))[0] > 0.1


def test_break_is_where_images_change():
    truth, _, closures = carried_drive()
    assert ratio(truth, driving(truth), closures)[0] < 0.03
    same = [replace(each, changes=()) for each in closures]
    assert ratio(truth, driving(truth), same)[0] > 0.1


def test_break_is_where_few_closures_are_on_the_wrong_side(monkeypatch):
    truth, _, closures = carried_drive()
    assert ratio(truth, driving(truth), unseen(closures))[0] < 0.15
    monkeypatch.setattr(breaks, 'WRONG_SIDE', 0.0)
    assert ratio(truth, driving(truth), unseen(closures))[0] > 0.3


def test_break_is_at_a_pause(monkeypatch):
    """The odometry has a gap of 4.9 s, and drives on behind it as before."""
    truth, _, closures = carried_drive()
    odometry, late = driving(truth), int(3.9 * SECOND)
    stamps = (np.arange(len(truth)) + 1) * SECOND
    stamps[140:] += late
    closures = [
        replace(each, changes=(), query_stamp=each.query_stamp + late * (number > 140))
        for each in closures
        if not 137 < (number := each.query_stamp // SECOND) <= 140
    ]
    found, _ = optimize(stamps, odometry, closures)
    assert error(found, truth) < 1
    monkeypatch.setattr(breaks, 'PAUSE', np.inf)
    found, _ = optimize(stamps, odometry, closures)
    assert error(found, truth) > 3
