# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Parts around the pose graph: sources of closures, stamps that jump back, tf."""

import math
import subprocess
import sys
from types import ModuleType, SimpleNamespace

from geometry_msgs.msg import TransformStamped
from processes import SECOND
import pytest
import rclpy
from sensor_msgs.msg import CameraInfo
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_ros.ros.sensors import CameraInput
from stavpr_slam.pose_graph import PoseGraph
from stavpr_slam.ros.graph_messages import closure_of
from test_pose_graph import circle, odometry_of


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
            found = TransformStamped()
            found.transform.translation.z = 1.5
            return found

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
    found = camera.camera('base', 'optical')
    assert found is not None
    assert found.mount == (0, 0, 1.5, 0, 0, 0, 1)
    assert asked == [('base', 'optical', 0)] * 2
    assert camera.yaw('', 'optical') == 0.0  # without odometry
    found = camera.yaw('base', 'optical')
    assert found == pytest.approx(0)  # its z is up
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
