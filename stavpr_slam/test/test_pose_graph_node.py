# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``pose_graph`` over ROS, and its messages."""

import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry, Path
import numpy as np
from processes import DOMAIN, Process, SECOND, TIMEOUT
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from stavpr_msgs.msg import AlignedPlaces, LoopClosure, RelativePose
from stavpr_msgs.srv import SaveMap
from stavpr_ros.ros.output import pose_message, time_message
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.ros.graph_messages import closure_of
from test_pose_graph import circle, closure, error, LAP, NOISE, odometry_of


def closure_message(truth: np.ndarray, query: int) -> LoopClosure:
    """Return the closure of a query with the place one lap before."""
    measured = closure(truth, query, query - LAP)
    message = LoopClosure(query_index=query, place_index=query - LAP, has_relative_pose=True)
    relative = message.relative_pose
    relative.source, relative.is_independent = RelativePose.PNP, measured.is_independent
    relative.query_stamp = message.query_stamp = time_message(measured.query_stamp)
    relative.place_stamp = message.place_stamp = time_message(measured.place_stamp)
    relative.pose.pose = pose_message(measured.pose)
    relative.pose.covariance = NOISE.ravel()
    relative.frame = 'base_link'
    return message


def odometry_message(stamp: int, pose: np.ndarray) -> Odometry:
    message = Odometry(child_frame_id='base_link')
    message.header.stamp, message.header.frame_id = time_message(stamp), 'odom'
    message.pose.pose = pose_message(pose)
    return message


class Peer:
    """A node beside the pose graph."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('peer', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.values: dict[str, str] = {}
        self.paths: list[Path] = []
        self.corrected: list[Odometry] = []
        qos = QoSProfile(depth=1000)
        self.odometry = self.node.create_publisher(Odometry, 'odom', qos)
        self.closures = self.node.create_publisher(LoopClosure, 'stavpr/loop_closure', qos)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        subscribe = self.node.create_subscription
        subscribe(DiagnosticArray, '/diagnostics', self.on_diagnostics, 10)
        subscribe(Path, 'pose_graph/path', self.paths.append, latched)
        subscribe(Odometry, 'pose_graph/odometry', self.corrected.append, qos)
        self.save = self.node.create_client(SaveMap, 'pose_graph/save')

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'pose_graph: graph':
                self.values = {each.key: each.value for each in status.values}

    def wait_until(self, done) -> None:
        end = time.monotonic() + TIMEOUT
        while not done():
            assert time.monotonic() < end, self.values
            self.executor.spin_once(timeout_sec=0.1)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def peer():
    peer = Peer()
    yield peer
    peer.close()


def test_pose_graph_over_ros_corrects_saves_and_survives_bad_input(peer, tmp_path):
    options = ('--ros-args', '-p', f'maps_folder:={tmp_path}')
    process = Process(tmp_path / 'log', 'pose_graph', *options)
    try:
        peer.wait_until(
            lambda: (
                peer.odometry.get_subscription_count()
                and peer.closures.get_subscription_count()
                and peer.values
            )
        )
        truth = circle()
        for i, pose in enumerate(odometry_of(truth)):
            peer.odometry.publish(odometry_message((i + 1) * SECOND, pose))
        peer.odometry.publish(odometry_message(SECOND, np.full(7, np.nan)))
        peer.closures.publish(LoopClosure(has_relative_pose=True))
        for query in range(LAP, 2 * LAP, 2):
            peer.closures.publish(closure_message(truth, query))
        peer.wait_until(lambda: int(peer.values.get('accepted_closures', 0)) >= 0.9 * LAP / 2)
        # odometry of NaN, a closure without stamps
        peer.wait_until(lambda: int(peer.values['invalid']) >= 2)
        future = peer.save.call_async(SaveMap.Request(path='drive.tum'))
        peer.wait_until(future.done)
        assert future.result().success, future.result().message
        outside = peer.save.call_async(SaveMap.Request(path='../drive.tum'))
        peer.wait_until(outside.done)
        assert 'maps folder' in outside.result().message
        peer.wait_until(lambda: peer.paths and len(peer.paths[-1].poses) == 2 * LAP)
        tum = np.loadtxt(tmp_path / 'drive.tum')
        assert error(tum[:, 1:], truth) < 1
        assert len(peer.corrected) == 2 * LAP
        assert process.popen.poll() is None
    finally:
        process.end()


def test_closure_of_appearance_is_edge_of_meters_only_on_request():
    message = LoopClosure(query_index=3, place_index=1)
    message.query_stamp, message.place_stamp = time_message(3 * SECOND), time_message(SECOND)
    assert closure_of(message, appearance=False) is None
    found = closure_of(message, appearance=True)
    assert found is not None
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(3)
    assert not found.is_independent


def test_closure_of_message_has_changes_of_the_images():
    message = LoopClosure(query_index=3, place_index=1)
    message.query_stamp, message.place_stamp = time_message(3 * SECOND), time_message(SECOND)
    message.pairs = [
        AlignedPlaces(query_stamp=time_message(stamp * SECOND), query_change=change)
        for stamp, change in ((2, math.nan), (3, 0.25), (4, 0.5))
    ]
    found = closure_of(message, appearance=True)
    assert found is not None
    assert found.changes == ((3 * SECOND, 0.25), (4 * SECOND, 0.5))


def test_closure_of_map_has_pose_of_place():
    message = LoopClosure(query_index=-1, place_index=1, map_id='abc', has_poses=True)
    message.place_pose = pose_message(planar_poses(np.array([[4.0, 5.0, 0.0]]))[0])
    found = closure_of(message, appearance=True)
    assert found is not None
    assert found.map_id == 'abc'
    np.testing.assert_allclose(found.place_pose[:2], [4, 5])
