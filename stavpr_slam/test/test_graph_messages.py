# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of the pose graph: closures to measurements, paths and edges to messages."""

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
import numpy as np
from processes import SECOND
import pytest
from rclpy.serialization import deserialize_message
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.ros.messages import pose_message, time_message
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.ros.graph_messages import closure_of, edge_markers, path_bytes
from std_msgs.msg import Header
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
    found = closure_of(message, appearance=True)
    assert found is not None
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(3)
    np.testing.assert_array_equal(found.pose, [0, 0, 0, 0, 0, 0, 1])
    message.relative_pose.pose.pose = pose_message(np.array([9.0, 0, 0, 0, 0, 1, 0]))
    turned = closure_of(message, appearance=True)
    assert turned is not None
    np.testing.assert_array_equal(turned.pose, [0, 0, 0, 0, 0, 1, 0])  # by the mountings
    assert not found.is_independent


def test_closure_of_map_has_pose_of_place():
    message = LoopClosure(query_index=-1, place_index=1, map_id='abc', has_poses=True)
    message.place_pose = pose_message(planar_poses(np.array([[4.0, 5.0, 0.0]]))[0])
    found = closure_of(message, appearance=True)
    assert found is not None
    assert found.map_id == 'abc'
    np.testing.assert_allclose(found.place_pose[:2], [4, 5])
