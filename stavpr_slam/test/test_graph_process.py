# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The graph that the process of the pose graph serves."""

import numpy as np
from stavpr_ros.mapping.transforms import matrices
from stavpr_slam.pose_graph import GraphSettings, optimize
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.ros.graph_process import GraphServer, RobotOdometry
from test_pose_graph import circle, closure, error, LAP, odometry_of

SECOND = 10**9
POSES = planar_poses(np.column_stack([np.arange(10.0), np.zeros((10, 2))]))


def odometry(robot: str, i: int, covariance: list[float] | None = None) -> RobotOdometry:
    return RobotOdometry(robot, (i + 1) * SECOND, POSES[i].tolist(), covariance)


def errors(origin: np.ndarray, is_given: bool) -> np.ndarray:
    """Return the covariance of a path whose messages have errors across only."""
    server = GraphServer(GraphSettings(), {'a': origin})
    for i in range(10):
        grown = np.diag([0.001, 1.0, 0.001, 0.0, 0.0, 0.0]) * (i + 1)
        server.serve([odometry('a', i, grown.ravel().tolist() if is_given else None)], False, None)
    return server._graph.chain.path_errors(np.array([0]), np.array([9]))[0]


def test_server_uses_covariances_of_messages_in_the_frame_of_its_origin():
    turned = matrices(planar_poses(np.array([[5.0, 2.0, np.pi / 2]])))[0]
    found = errors(np.eye(4), True)
    assert found[4, 4] > 5 > 100 * found[3, 3]
    np.testing.assert_allclose(errors(turned, True), found, atol=1e-6)
    assert errors(np.eye(4), False)[4, 4] < 1


def test_server_of_robots_has_breaks_and_paths_of_each_in_no_trajectory_file(tmp_path):
    server = GraphServer(GraphSettings(), {})
    inputs = [odometry(robot, i) for i in range(2) for robot in 'ab']
    snapshot = server.serve([*inputs, odometry('b', 9)], True, None)
    assert snapshot.breaks == [('b', 'no odometry for 8.0 s')]
    assert {'b no odometry for 8.0 s'} == {snapshot.values['breaks']}
    stamps = {robot: rows[0].tolist() for robot, rows in snapshot.paths.trajectories.items()}
    saved = server.serve([], False, (f'{tmp_path}/drive.tum', False)).saved
    assert 'ends in .g2o, the file of several robots' in saved
    assert stamps == {'a': [SECOND, 2 * SECOND], 'b': [SECOND, 2 * SECOND, 10 * SECOND]}


def test_live_graph_ends_as_the_recorded_drive():
    """The messages of wheels have covariances of zero; closures come one by one."""
    truth = circle(3)
    poses, zero = odometry_of(truth), np.zeros(36).tolist()
    closures = [closure(truth, q, q % LAP, independent=True) for q in range(LAP, 3 * LAP, 6)]
    server, waiting = GraphServer(GraphSettings(), {}), list(closures)
    for i, pose in enumerate(poses):
        inputs = [RobotOdometry('', (i + 1) * SECOND, pose.tolist(), zero)]
        while waiting and waiting[0].query_stamp <= (i - 9) * SECOND:
            inputs.append(waiting.pop(0))
        server.serve(inputs, False, None)
    snapshot = server.serve(waiting, True, None)
    _, _, live = snapshot.paths.trajectories['']
    offline, _ = optimize((np.arange(len(truth)) + 1) * SECOND, poses, closures)
    expected = error(offline, truth)
    assert expected < 0.15 * error(poses, truth)
    assert error(live, truth) < 1.05 * expected + 0.02
