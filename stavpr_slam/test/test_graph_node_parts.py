# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Around the pose graph: messages, sources of closures, tf, and the graph of its process."""

import math
import subprocess
import sys
from types import ModuleType, SimpleNamespace

from geometry_msgs.msg import PoseStamped, TransformStamped
from nav_msgs.msg import Path
import numpy as np
from processes import SECOND
import pytest
import rclpy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_ros.mapping.transforms import matrices
from stavpr_ros.ros.messages import pose_message, time_message
from stavpr_ros.ros.sensors import CameraInput
from stavpr_slam.pose_graph import GraphSettings, optimize, PoseGraph
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.ros.graph_messages import closure_of, edge_markers, path_bytes
from stavpr_slam.ros.graph_process import GraphServer, RobotOdometry
from std_msgs.msg import Header
from test_pose_graph import circle, closure, error, LAP, odometry_of
from visualization_msgs.msg import Marker


@pytest.mark.parametrize('frame', ['', 'map', 'odom_1', 'world', 'earth.7'])
@pytest.mark.parametrize('count', [0, 1, 3])
def test_path_bytes_are_those_of_the_message(frame, count):
    stamps = np.arange(count, dtype=np.int64) * SECOND // 3 + SECOND
    poses = np.random.default_rng(1).normal(size=(count, 7))
    path = Path(header=Header(frame_id=frame))
    for own, pose in zip(stamps.tolist(), poses, strict=True):
        path.header.stamp = time_message(own)
        header = Header(frame_id=frame, stamp=time_message(own))
        path.poses.append(PoseStamped(header=header, pose=pose_message(pose)))
    assert deserialize_message(path_bytes(frame, stamps, poses), Path) == path


def test_edge_markers_are_lines_of_accepted_and_of_rejected_edges():
    ends = np.arange(12.0).reshape(2, 2, 3)
    accepted, rejected = edge_markers('map', ends, ends[:0]).markers
    assert (accepted.id, rejected.id, rejected.action) == (0, 1, Marker.DELETE)
    assert [(p.x, p.y, p.z) for p in accepted.points] == [tuple(row) for row in ends.reshape(4, 3)]
    assert accepted.color.g > accepted.color.r


def test_closure_of_appearance_is_edge_of_meters_only_on_request():
    message = LoopClosure(query_index=3, place_index=1)
    message.query_stamp, message.place_stamp = time_message(3 * SECOND), time_message(SECOND)
    assert closure_of(message, appearance=False) is None
    result = closure_of(message, appearance=True)
    assert result is not None
    assert np.sqrt(result.covariance[0, 0]) == pytest.approx(3)
    np.testing.assert_array_equal(result.pose, [0, 0, 0, 0, 0, 0, 1])
    message.relative_pose.pose.pose = pose_message(np.array([9.0, 0, 0, 0, 0, 1, 0]))
    turned = closure_of(message, appearance=True)
    assert turned is not None
    np.testing.assert_array_equal(turned.pose, [0, 0, 0, 0, 0, 1, 0])  # by the mountings
    assert not result.is_independent


def test_closure_of_map_has_pose_of_place():
    message = LoopClosure(query_index=-1, place_index=1, map_id='abc', has_poses=True)
    message.place_pose = pose_message(planar_poses(np.array([[4.0, 5.0, 0.0]]))[0])
    result = closure_of(message, appearance=True)
    assert result is not None
    assert result.map_id == 'abc'
    np.testing.assert_allclose(result.place_pose[:2], [4, 5])


@pytest.mark.parametrize(
    ('source', 'has_pose', 'expected'),
    [
        (RelativePose.NONE, False, (False, True)),
        (RelativePose.ALIGNED, True, (True, True)),
        (RelativePose.PNP, True, (True, True)),
        (RelativePose.REFUTED, False, (False, False)),
        (RelativePose.DROPPED, False, (False, False)),
        (RelativePose.REFUTED, True, (False, False)),  # of a publisher of another version
    ],
)
def test_closure_of_each_source(source, has_pose, expected):
    """Appearance replaces a relative pose that could not be measured, not one refuted."""
    message = LoopClosure(query_index=9, place_index=2, has_relative_pose=has_pose)
    message.relative_pose.source = source
    result = tuple(closure_of(message, appearance) is not None for appearance in (False, True))
    assert result == expected


def test_pose_graph_with_stamps_that_jump_back_begins_a_session():
    truth = circle(1)
    odometry, graph = odometry_of(truth), PoseGraph()
    for i in (*range(60), *range(20)):
        graph.add_odometry((i + 1) * SECOND, odometry[i])
    graph.update()
    assert graph.chain.sessions == 2
    assert 'the stamps jumped back' in graph.chain.breaks[0][1]


def test_camera_transform_of_tf_is_looked_up(default_context, monkeypatch):
    """A stand-in of the interface of tf2_ros: Buffer, TransformListener, lookup_transform."""
    asked, ended = [], []

    class Buffer:
        known = False

        def lookup_transform(self, target_frame, source_frame, time):
            asked.append((target_frame, source_frame, time.nanoseconds))
            if not self.known:
                raise LookupError(f'{source_frame} does not exist')
            result = TransformStamped()
            result.transform.translation.z = 1.5
            return result

    module = ModuleType('tf2_ros')
    module.Buffer = Buffer
    module.TransformListener = lambda buffer, node: SimpleNamespace(
        unregister=lambda: ended.append(True)
    )
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)
    node = rclpy.create_node('camera_test', context=default_context)
    camera = CameraInput(node, '')
    k = [300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0]
    (subscription,) = node.subscriptions
    subscription.callback(CameraInfo(width=320, height=240, k=k))
    assert camera.camera('base', 'optical') is None
    assert "no transform from 'optical' to 'base' on tf" in camera.problem
    Buffer.known = True
    result = camera.camera('base', 'optical')
    assert result is not None
    assert result.mount == (0, 0, 1.5, 0, 0, 0, 1)
    assert asked == [('base', 'optical', 0)] * 2
    assert camera.yaw('', 'optical') == 0.0  # without odometry
    result = camera.yaw('base', 'optical')
    assert result == pytest.approx(0)  # its z is up
    rear = CameraInput(node, '0 0 1 -1.5708 0 1.5708')
    assert abs(rear.yaw('', '')) == pytest.approx(math.pi, abs=1e-4)
    camera.close()
    assert ended == [True]
    node.destroy_node()


OPTIMIZED = """
import importlib, pkgutil, sys
import stavpr_ros.alignment.cpu, stavpr_ros.method, stavpr_slam
for package in (stavpr_ros.alignment.cpu, stavpr_ros.method, stavpr_slam):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):
        importlib.import_module(module.name)
from stavpr_ros.commands.stavpr import main
assert __doc__ is None
sys.exit(main(['bridge', '--help']) or main(['pose_graph', '--help']) or main(sys.argv[1:]))
"""


def test_package_runs_without_its_docstrings(tmp_path):
    """As ``python -OO`` does."""
    (tmp_path / 'a.g2o').write_text('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n')
    call = [sys.executable, '-OO', '-c', OPTIMIZED, 'optimize_graph', str(tmp_path / 'a.g2o')]
    text = subprocess.check_output(call, text=True)
    assert 'Adds loop closures to RTAB-Map' in text
    assert '2 poses, 0 closures' in text


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
    result = errors(np.eye(4), True)
    assert result[4, 4] > 5 > 100 * result[3, 3]
    np.testing.assert_allclose(errors(turned, True), result, atol=1e-6)
    assert errors(np.eye(4), False)[4, 4] < 1


def test_server_of_robots_has_breaks_and_paths_of_each_in_no_trajectory_file(tmp_path):
    server = GraphServer(GraphSettings(), {})
    inputs = [odometry(robot, i) for i in range(2) for robot in 'ab']
    snapshot = server.serve([*inputs, odometry('b', 9)], True, None)
    assert snapshot.breaks == [('b', 'no odometry for 8.0 s')]
    assert {'b no odometry for 8.0 s'} == {snapshot.values['breaks']}
    stamps = {robot: rows[0].tolist() for robot, rows in snapshot.trajectories.items()}
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
    _, _, live = snapshot.trajectories['']
    offline, _ = optimize((np.arange(len(truth)) + 1) * SECOND, poses, closures)
    expected = error(offline, truth)
    assert expected < 0.15 * error(poses, truth)
    assert error(live, truth) < 1.05 * expected + 0.02
