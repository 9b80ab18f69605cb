# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts around the pose graph: false closures, its client, tf, restarts."""

import sys
from types import ModuleType, SimpleNamespace

from geometry_msgs.msg import TransformStamped
import numpy as np
from processes import DOMAIN, SECOND
import pytest
import rclpy
from sensor_msgs.msg import CameraInfo
from stavpr_msgs.msg import AlignedPlaces, LoopClosure, RelativePose
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.messages import time_message
from stavpr_ros.ros.sensors import CameraInput
from stavpr_slam.pose_graph import PoseGraph
from stavpr_slam.pose_graph.false_places import FalsePlaces, NEAR, RUN
from stavpr_slam.ros.false_closures import FalseClosures
from stavpr_slam.ros.graph_client import fetch_graph
from stavpr_slam.ros.graph_messages import closure_of
from test_pose_graph import circle, odometry_of


@pytest.fixture
def context():
    rclpy.init(domain_id=DOMAIN)
    yield rclpy.get_default_context()
    rclpy.try_shutdown()


def offsets(share: float, coherent: bool) -> np.ndarray:
    """Return how far the chosen places of 200 closures are from their own."""
    false = FalsePlaces(share, coherent, 1)
    return np.array([false.place(i, range(2 * i + 1)) - i for i in range(200)])


def test_false_places_at_random_are_a_share_and_far():
    off = offsets(0.3, False)
    assert 0.15 < (off != 0).mean() < 0.45
    assert np.abs(off[off != 0]).min() > NEAR - 1
    assert not offsets(0.0, False).any()


def test_false_places_coherent_are_runs():
    off = offsets(0.5, True)
    assert (off != 0).any()
    changes = np.flatnonzero(np.diff(off != 0)) + 1
    assert not (changes % RUN).any()


def test_false_closure_is_relayed_with_the_stamps_of_its_place(context, monkeypatch):
    sent = []
    monkeypatch.setattr(
        rclpy.publisher.Publisher, 'publish', lambda _, message: sent.append(message)
    )
    monkeypatch.setattr(FalsePlaces, 'place', lambda *_: 7)
    node = FalseClosures(1.0, False, 1)
    (subscription,) = node.subscriptions
    message = LoopClosure(query_index=300, place_index=0)
    message.relative_pose.place_stamp = time_message(SECOND)
    message.pairs = [AlignedPlaces(place_index=7, place_stamp=time_message(8 * SECOND))]
    subscription.callback(message)
    node.destroy_node()
    relative = sent[-1].relative_pose
    assert sent[-1].place_index == relative.place_index == 7
    assert sent[-1].place_stamp == relative.place_stamp == time_message(8 * SECOND)


def test_fetch_graph_without_node_names_what_is_missing():
    with pytest.raises(StavprError, match=r'pose_graph: 3 closures not in 0\.3 s'):
        fetch_graph([], 3, DOMAIN, timeout=0.3)


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
    found = tuple(closure_of(message, appearance) is not None for appearance in (False, True))
    assert found == expected


def test_pose_graph_with_stamps_that_jump_back_begins_a_session():
    truth = circle(1)
    odometry, graph = odometry_of(truth), PoseGraph()
    for i in (*range(60), *range(20)):
        graph.add_odometry((i + 1) * SECOND, odometry[i])
    graph.update()
    assert graph.chain.sessions == 2
    assert 'the stamps jumped back' in graph.chain.breaks[0]


def test_camera_transform_of_tf_is_looked_up(context, monkeypatch):
    """A stand-in of the interface of tf2_ros: Buffer, TransformListener, lookup_transform."""
    asked, ended = [], []

    class Buffer:
        known = False

        def lookup_transform(self, target_frame, source_frame, time):
            asked.append((target_frame, source_frame, time.nanoseconds))
            if not self.known:
                raise LookupError(f'{source_frame} does not exist')
            found = TransformStamped()
            found.transform.translation.z = 1.5
            return found

    module = ModuleType('tf2_ros')
    module.Buffer = Buffer
    module.TransformListener = lambda buffer, node: SimpleNamespace(
        unregister=lambda: ended.append(True)
    )
    monkeypatch.setitem(sys.modules, 'tf2_ros', module)
    node = rclpy.create_node('camera_test', context=context)
    camera = CameraInput(node, '')
    k = [300.0, 0.0, 159.5, 0.0, 300.0, 119.5, 0.0, 0.0, 1.0]
    camera._on_info(CameraInfo(width=320, height=240, k=k))
    assert camera.camera('base', 'optical') is None
    assert "no transform from 'optical' to 'base' on tf" in camera.problem
    Buffer.known = True
    found = camera.camera('base', 'optical')
    assert found is not None
    assert found.mount == (0, 0, 1.5, 0, 0, 0, 1)
    assert asked == [('base', 'optical', 0)] * 2
    camera.close()
    assert ended == [True]
    node.destroy_node()
