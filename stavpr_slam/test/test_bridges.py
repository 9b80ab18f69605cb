# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bridges to other SLAM systems: moved edges, poses, and each bridge as a process."""

from collections import Counter
from functools import partial
import json
import os
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace

from bridge_target import AHEAD, closures, DEVIATIONS, Drive, EDGES, KEYFRAME, stamp_of
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from interface_packages import build_interfaces
import numpy as np
from processes import environment, executable, Process, SECOND, TIMEOUT
import pytest
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.errors import UnavailableError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.ros.messages import nanoseconds, pose_array
from stavpr_slam.commands.bridge import main
from stavpr_slam.pose_graph import ChainSettings, Closure, OdometryNoise
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.ros.bridges.bridge import Bridge
from stavpr_slam.ros.bridges.poses import RobotLocalizationBridge
from stavpr_slam.ros.bridges.rtabmap import keyframe_edge, nearest, RtabmapBridge
from test_pose_graph import LAP
from test_pose_graph_node import Peer

COVARIANCE = np.diag([0.2, 0.1, 0.3, 0.01, 0.02, 0.03]) ** 2


def closure(pose: np.ndarray, covariance: np.ndarray = COVARIANCE) -> Closure:
    return Closure(2 * SECOND, SECOND, pose, covariance)


def test_keyframe_edge_of_known_motions_is_transform_of_keyframes():
    poses = matrices(np.concatenate([np.eye(4, 3), Rotation.random(4, 1).as_quat()], axis=1))
    place, query, place_keyframe, query_keyframe = poses
    measured = closure(to_poses(inverse(place) @ query))
    ends = inverse(place_keyframe) @ place, inverse(query_keyframe) @ query
    transform, _ = keyframe_edge(measured, *ends)
    np.testing.assert_allclose(transform, inverse(place_keyframe) @ query_keyframe, atol=1e-12)


def test_keyframe_edge_covariance_is_that_of_samples():
    dice = np.random.default_rng(0)
    start = matrices(np.array([1.0, 2, 0, 0, 0, 0.6, 0.8]))
    before = matrices(np.array([0.5, 0, 0, 0, 0.6, 0, 0.8]))
    motion = matrices(np.array([3.0, 1, 0, 0, 0, 0, 1]))  # a long one, so that its lever counts
    transform, covariance = keyframe_edge(closure(to_poses(start)), before, inverse(motion))
    samples = dice.multivariate_normal(np.zeros(6), COVARIANCE, 20000)
    moved = np.tile(start, (20000, 1, 1))
    moved[:, :3, :3] = Rotation.from_rotvec(samples[:, 3:]).as_matrix() @ start[:3, :3]
    moved[:, :3, 3] += samples[:, :3]
    off = inverse(transform) @ before @ moved @ motion
    turns = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
    errors = np.concatenate([turns, off[:, :3, 3]], axis=1)
    np.testing.assert_allclose(np.cov(errors.T), covariance, atol=2e-3)


def test_nearest_external_keyframe_is_returned_with_its_motion():
    keyframes, odometry = dict[int, int](), KeyframeChain(ChainSettings(), OdometryNoise())
    at = lambda x: np.array([x, 0, 0, 0, 0, 0, 1.0])  # noqa: E731
    near = partial(nearest, keyframes, odometry, 2 * SECOND)
    odometry.add(SECOND, at(1.0))
    keyframes[3 * SECOND // 2] = 5  # before the odometry after it
    assert near(2 * SECOND) is None
    for second in (2, 3, 4, 5, 6, 7):
        odometry.add(second * SECOND, at(second))
    keyframes[4 * SECOND] = 6
    number, motion = near(2 * SECOND)
    assert number == 5
    np.testing.assert_allclose(motion[:3, 3], [0.5, 0, 0])
    assert near(3 * SECOND)[0] == 6
    assert near(7 * SECOND) is None  # 3 s away
    keyframes[9 * SECOND] = 7
    assert near(9 * SECOND)[0] == 7  # the same stamp: no motion
    assert near(17 * SECOND // 2) is None  # without odometry


@pytest.mark.parametrize('target', [[], ['rtab'], ['--ros-args']])
def test_bridge_without_target_is_usage_error(target, capsys):
    assert main(target) == 2
    assert 'rtabmap, rtabmap_global_pose' in capsys.readouterr().err


def test_bridge_without_the_messages_of_its_target_is_error_that_names_them(monkeypatch):
    monkeypatch.setitem(sys.modules, 'rtabmap_msgs', None)
    with pytest.raises(UnavailableError, match=r'package rtabmap_msgs \(ros-jazzy-.*\): install'):
        RtabmapBridge()


@pytest.mark.parametrize(
    ('counts', 'level', 'text'),
    [
        ({}, DiagnosticStatus.WARN, 'no closures on /stavpr/loop_closure: remap it'),
        ({'closures': 91, 'invalid': 91}, DiagnosticStatus.WARN, 'the closures are invalid'),
        ({'closures': 9, 'waiting': 9}, DiagnosticStatus.WARN, 'no keyframes of the target'),
        ({'closures': 9, 'waiting': 1, 'sent': 8}, DiagnosticStatus.OK, '8 closures sent'),
    ],
)
def test_status_of_bridge_that_sends_nothing_is_warning_with_remedy(counts, level, text):
    bridge = SimpleNamespace(counts=Counter(counts), resolve_topic_name='/{}'.format)
    result, sentence = Bridge.status(bridge)
    assert result == level
    assert text in sentence


def test_pose_of_a_relocalization_waits_for_a_subscriber():
    counts = iter([0, 1, 1, 0, 1])
    publisher = SimpleNamespace(get_subscription_count=lambda: next(counts))
    bridge = SimpleNamespace(_last=-11 * SECOND, _gap=10 * SECOND, _publisher=publisher)
    bridge.publish = lambda *_: ''
    rows = [(bridge, LoopClosure(), closure(np.zeros(7)))] * 5
    causes = [RobotLocalizationBridge.take(*row) for row in rows]
    assert causes == ['without_subscriber', '', 'not_relocalized', 'without_subscriber', '']


def test_pose_bridges_publish_pose_on_map(tmp_path):
    """The prior of RTAB-Map for each independent closure, robot_localization once."""
    peer = Peer()
    node, counts, wait_until = peer.node, peer.diagnostics, peer.wait_until
    priors: list[PoseWithCovarianceStamped] = []
    poses: list[PoseWithCovarianceStamped] = []
    qos = QoSProfile(depth=100)
    kind = PoseWithCovarianceStamped
    subscriptions = [
        node.create_subscription(kind, 'global_pose', priors.append, qos),
        node.create_subscription(kind, 'robot_localization_bridge/pose', poses.append, qos),
    ]
    targets = ('rtabmap_global_pose', 'robot_localization')
    processes = [Process(tmp_path / name, 'bridge', name) for name in targets]
    try:
        wait_until(lambda: peer.closures.get_subscription_count() == 2)
        wait_until(lambda: all(node.count_publishers(own.topic_name) for own in subscriptions))
        wait_until(lambda: len(counts) == 2)  # they have discovered each other's topics
        sent = closures(Drive(), on_map=True)
        sent[-1].relative_pose.query_stamp.sec += 100  # lost in between
        sent[-1].relative_pose.pose.covariance[0] = np.nan
        sent[-2].relative_pose.query_stamp.sec += 100
        for message in [*sent, *closures(Drive(), on_map=False)[:3]]:
            peer.closures.publish(message)
        wait_until(
            lambda: all(int(own.get('closures', 0)) == len(sent) + 3 for own in counts.values())
        )
        wait_until(lambda: len(priors) == EDGES and len(poses) == 2)
        assert counts['rtabmap_global_pose_bridge: bridge']['not_on_a_map'] == '3'
        assert counts['robot_localization_bridge: bridge']['invalid'] == '1'
        assert counts['robot_localization_bridge: bridge']['sent'] == '2'
        assert (priors[0].header.frame_id, poses[0].header.frame_id) == ('base_link', 'map')
        first = poses[0].pose
        expected = Drive().at(sent[0].place_index - AHEAD + LAP)
        np.testing.assert_allclose(matrices(pose_array(first.pose)), expected, atol=1e-6)
        assert nanoseconds(poses[1].header.stamp) == nanoseconds(
            sent[-2].relative_pose.query_stamp
        )
        covariance = np.array(first.covariance).reshape(6, 6)
        assert np.sqrt(np.linalg.eigvalsh(covariance)) == pytest.approx(sorted(DEVIATIONS))
    finally:
        for process in processes:
            process.end()
        peer.close()


@pytest.fixture(scope='module')
def overlay(tmp_path_factory):
    """Return the workspace with the message packages of the targets."""
    return build_interfaces(tmp_path_factory.mktemp('interfaces')) / 'local_setup.bash'


@pytest.mark.long
def test_bridge_passes_edges_to_target(overlay):
    """The bridge and the target are processes; edges are between keyframes 0.3 s from images."""
    tests = str(Path(__file__).parent)
    own = environment() | {'PYTHONPATH': f'{tests}:{os.environ.get("PYTHONPATH", "")}'}

    def start(*command: str) -> subprocess.Popen:
        return subprocess.Popen(
            ['bash', '-c', '. "$0" && exec "$@"', str(overlay), *command],
            env=own, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    bridge = start(executable('bridge'), 'rtabmap')
    peer = start(sys.executable, f'{tests}/bridge_target.py')
    try:
        edges = json.loads(peer.communicate(timeout=200)[0])
    finally:
        for process in (peer, bridge):
            process.terminate()
    assert bridge.wait(TIMEOUT) == 0
    drive = Drive()
    queries = [1 + LAP + 2 * KEYFRAME * i for i in range(EDGES)]
    assert len(edges) == len(queries)
    for edge, query in zip(edges, queries, strict=True):
        images = [(number - 1) * KEYFRAME + 0.3 for number in edge['nodes']]
        assert abs(max(images) - query) <= KEYFRAME / 2
        assert abs(min(images) - (query - LAP + AHEAD)) <= KEYFRAME / 2
        truth = inverse(drive.at(images[0])) @ drive.at(images[1])
        assert np.linalg.norm(truth[:3, 3]) > 5  # so that the other direction differs
        np.testing.assert_allclose(
            matrices(np.array(edge['pose'])), truth, atol=0.02
        )  # chords of the odometry
        assert edge['type'] == 4
        assert edge['deviations'][:3] == pytest.approx(sorted(DEVIATIONS)[:3], rel=0.2)
    assert stamp_of(0) == SECOND
