# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Each rule of the pose graph has a drive that is worse without it."""

from dataclasses import replace

import numpy as np
import pytest
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_slam import simulated_odometry
from stavpr_slam.pose_graph import (
    acceptance, breaks, ConsistencySettings, GraphSettings, keyframes, optimize, OdometryNoise,
    PoseGraph,
)  # fmt: skip
from stavpr_slam.pose_graph.consistency import ConsistentSet
from stavpr_slam.pose_graph.false_places import FalsePlaces
from stavpr_slam.pose_graph.transforms import adjoints, exponentials, planar_poses
from stavpr_slam.simulated_odometry import drifted
from test_pose_graph import carried_drive, circle, closure, error, LAP, odometry_of, SECOND, solve

DEFAULT = GraphSettings()


def rules(**changes) -> GraphSettings:
    return replace(DEFAULT, consistency=ConsistencySettings(**changes))


def ratio(truth, odometry, closures, settings=DEFAULT):
    """Return the error after / before, and the graph."""
    stamps = (np.arange(len(truth)) + 1) * SECOND
    found, graph = optimize(stamps, odometry, closures, settings)
    return error(found, truth) / error(odometry, truth), graph


def half_false(draw: int):
    """Return four laps, half of whose closures are false in runs of 20."""
    truth, false, known, closures = circle(4), FalsePlaces(0.5, True, draw), set(), []
    for query in range(LAP, 4 * LAP):
        known |= {query, query % LAP}
        closures.append(closure(truth, query, query % LAP, false.place(query % LAP, known)))
    dice = np.random.default_rng(draw)
    return truth, planar_poses(drifted(truth, np.ones(len(truth), bool), dice, 1.0)), closures


@pytest.mark.parametrize('draw', [2, 5])
def test_half_of_the_closures_false_without_comparison_of_all_together(draw, monkeypatch):
    drive = half_false(draw)
    assert ratio(*drive)[0] < 0.2
    monkeypatch.setattr(acceptance, 'refuted', lambda *_: [])
    assert ratio(*drive)[0] > 0.5


def test_carried_robot_without_pairwise_consistency(monkeypatch):
    assert ratio(*carried_drive())[0] < 0.05
    none = np.zeros((len(carried_drive()[2]),) * 2, bool)
    monkeypatch.setattr(
        ConsistentSet, 'conflicts', lambda _, clusters, __: none[: len(clusters), : len(clusters)]
    )
    assert ratio(*carried_drive())[0] > 0.3


def test_closures_of_single_images_without_confirmation(monkeypatch):
    truth = circle()
    closures = [closure(truth, q, q - LAP) for q in (*range(100, 120), *range(130, 200, 10))]
    drive = truth, odometry_of(truth), closures
    found, graph = ratio(*drive)
    nothing = lambda _, edges, __: (np.full(len(edges), np.inf), np.zeros(len(edges)))  # noqa: E731
    monkeypatch.setattr(acceptance, 'predicted', nothing)
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


# breaks


def test_carried_robot_without_breaks():
    assert ratio(*carried_drive())[0] < 0.05
    assert ratio(*carried_drive(), rules(break_gain=10**6))[0] > 0.3


def wrong_at_the_end(count: int, size: float = 1.0):
    """Return three laps, the last closures of which are of one wrong place."""
    truth = circle(3) * [size, size, 1]
    first = 3 * LAP - count
    closures = [
        closure(truth, q, q % LAP, (q + 40) % LAP if q >= first else None)
        for q in range(LAP, 3 * LAP)
    ]
    return truth, odometry_of(truth), closures


@pytest.mark.parametrize(
    ('drive', 'rule'),
    [
        (wrong_at_the_end(28), 'break_support'),
        (wrong_at_the_end(60, 0.25), 'break_distance'),
    ],
    ids=['few', 'short'],
)
def test_wrong_closures_prove_no_break(drive, rule):
    assert ratio(*drive)[1].splits == 0
    found, graph = ratio(*drive, rules(**{rule: 1}))
    assert graph.splits == 1
    assert found > 2 * ratio(*drive)[0]


def test_wrong_closures_beside_right_ones_prove_no_break():
    """At the end, 45 images have wrong closures, and 30 of these images right ones."""
    truth, odometry, closures = wrong_at_the_end(45)
    closures += [closure(truth, q, q % LAP) for q in range(3 * LAP - 30, 3 * LAP)]
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
    monkeypatch.setattr(breaks, 'STANDING', 0.0)
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
    """The odometry pauses for 4.9 s, and drives on after it as before."""
    truth, _, closures = carried_drive()
    stamps = (np.arange(len(truth)) + 1) * SECOND
    late = int(3.9 * SECOND)
    stamps[140:] += late
    closures = [
        replace(each, changes=(), query_stamp=each.query_stamp + late * (each.query_stamp > 140 * SECOND),
                place_stamp=each.place_stamp)
        for each in closures
    ]
    found, _ = optimize(stamps, driving(truth), closures)
    monkeypatch.setattr(breaks, 'PAUSE', np.inf)
    less, _ = optimize(stamps, driving(truth), closures)
    assert error(found, truth) < 1
    assert error(less, truth) > 3
