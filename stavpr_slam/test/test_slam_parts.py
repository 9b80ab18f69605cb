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
from rclpy.context import Context
from sensor_msgs.msg import CameraInfo
from stavpr_msgs.msg import AlignedPlaces, LoopClosure, RelativePose
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.messages import pose_message, time_message
from stavpr_ros.ros.sensors import CameraInput
from stavpr_slam.pose_graph import PoseGraph
from stavpr_slam.pose_graph.false_places import NEAR, RUN
from stavpr_slam.ros.false_closures import FalseClosures
from stavpr_slam.ros.graph_client import fetch_graph
from stavpr_slam.ros.graph_messages import closure_of
from test_pose_graph import circle, closure, error, LAP, odometry_of


@pytest.fixture
def context():
    own = Context()
    rclpy.init(context=own, domain_id=DOMAIN)
    yield own
    rclpy.try_shutdown(context=own)


def relayed(context, monkeypatch, share, coherent, count=200):
    """Return how far the places of relayed closures are from the right ones."""
    create = FalseClosures.__init__
    monkeypatch.setattr('rclpy.node.Node.__init__', _in(context))
    node = FalseClosures.__new__(FalseClosures)
    create(node, share, coherent, 1)
    sent = []
    node._publisher = SimpleNamespace(publish=sent.append)
    for place in range(count):
        stamps = time_message((place + 300) * SECOND), time_message((place + 1) * SECOND)
        message = LoopClosure(query_index=place + 300, place_index=place)
        message.query_stamp, message.place_stamp = stamps
        message.relative_pose.place_stamp = stamps[1]
        message.pairs = [
            AlignedPlaces(
                query_index=place + 300, query_stamp=stamps[0], place_index=place,
                place_stamp=stamps[1],
            )
        ]  # fmt: skip
        node._on_closure(message)
        assert sent[-1].relative_pose.place_stamp == sent[-1].place_stamp
    node.destroy_node()
    return np.array([message.place_index - i for i, message in enumerate(sent)])


def _in(context):
    original = rclpy.node.Node.__init__

    def initialize(self, name, **options):
        original(self, name, context=context, **options)

    return initialize


def test_false_closures_of_share_zero_are_relayed_unchanged(context, monkeypatch):
    assert not relayed(context, monkeypatch, 0.0, False).any()


def test_false_closures_at_random_are_a_share_and_far(context, monkeypatch):
    off = relayed(context, monkeypatch, 0.3, False)
    assert 0.15 < (off != 0).mean() < 0.45
    assert np.abs(off[off != 0]).min() > NEAR - 1


def test_false_closures_coherent_are_runs(context, monkeypatch):
    off = relayed(context, monkeypatch, 0.5, True)
    assert (off != 0).any()
    changes = np.flatnonzero(np.diff(off != 0)) + 1
    assert not (changes % RUN).any()


def test_fetch_graph_without_node_names_what_is_missing():
    with pytest.raises(StavprError, match=r'pose_graph: 3 closures not in 0\.3 s'):
        fetch_graph([], 3, DOMAIN, timeout=0.3)


def test_pose_graph_started_late_counts_closures_of_earlier_places():
    """The node was restarted on lap 2: only closures of lap 3 with lap 2 have two known stamps."""
    truth = circle(3)
    odometry, graph = odometry_of(truth), PoseGraph()
    for i in range(LAP, 3 * LAP):
        graph.add_odometry((i + 1) * SECOND, odometry[i])
        graph.add_closure(closure(truth, i, i - LAP))
    found = graph.update()[:, :2, 3]
    assert graph.counts['unknown stamp'] == LAP
    assert graph.accepted > 0.9 * LAP
    assert error(np.pad(found, ((0, 0), (0, 5))), truth[LAP:]) < 1


def test_pose_graph_accepts_closures_before_and_after_recognition_restarts():
    """The recognition node was restarted on lap 2: it numbers places anew, stamps go on."""
    truth = circle(3)
    odometry, graph, restart = odometry_of(truth), PoseGraph(), LAP + 40
    for i in range(3 * LAP):
        graph.add_odometry((i + 1) * SECOND, odometry[i])
        first = 0 if i < restart else restart
        if i - LAP < first:
            continue  # the place of this image is not on the route
        made = closure(truth, i, i - LAP, independent=True)
        message = LoopClosure(query_index=i - first, place_index=i - LAP - first)
        message.has_relative_pose = True
        edge = message.relative_pose
        edge.source, edge.is_independent = RelativePose.PNP, True
        edge.query_stamp = time_message(made.query_stamp)
        edge.place_stamp = time_message(made.place_stamp)
        edge.pose.pose, edge.pose.covariance = pose_message(made.pose), made.covariance.ravel()
        graph.add_closure(closure_of(message, False))
    found = graph.update()[:, :2, 3]
    assert graph.accepted > 0.9 * (40 + 60)
    assert {edge.query for edge in graph.edges if edge.accepted} & set(range(LAP, restart))
    assert error(np.pad(found, ((0, 0), (0, 5))), truth) < error(odometry, truth) / 2


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
