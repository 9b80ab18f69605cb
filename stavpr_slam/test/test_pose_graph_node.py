# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The executable ``pose_graph`` over ROS."""

from collections.abc import Sequence
import os
from pathlib import Path
import re
import signal
import time

from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as NavigationPath
import numpy as np
from processes import DOMAIN, Process, SECOND, TIMEOUT
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_msgs.srv import SaveMap
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.ros.messages import pose_array, pose_message, time_message
from stavpr_slam.pose_graph.transforms import planar_poses
from std_srvs.srv import Trigger
from test_pose_graph import circle, closure, error, LAP, NOISE, odometry_of

RESEND = 5.0  # seconds until an odometry is published again


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
    """A node beside the pose graph, or beside bridges."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('peer', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.values: dict[str, str] = {}  # of the graph
        self.diagnostics: dict[str, dict[str, str]] = {}  # of all
        self.level, self.text = b'', ''
        self.paths: list[NavigationPath] = []
        self.corrected: list[Odometry] = []
        qos = QoSProfile(depth=1000)
        self.odometry = self.node.create_publisher(Odometry, 'odom', qos)
        self.closures = self.node.create_publisher(LoopClosure, 'stavpr/loop_closure', qos)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        subscribe = self.node.create_subscription
        subscribe(DiagnosticArray, '/diagnostics', self.on_diagnostics, 10)
        subscribe(NavigationPath, 'pose_graph/path', self.paths.append, latched)
        subscribe(Odometry, 'pose_graph/odometry', self.corrected.append, qos)
        self.save = self.node.create_client(SaveMap, 'pose_graph/save')
        self.reset = self.node.create_client(Trigger, 'pose_graph/reset')

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.diagnostics[status.name] = values
            if status.name == 'pose_graph: graph':
                self.level, self.text, self.values = status.level, status.message, values

    def wait_until(self, done) -> None:
        end = time.monotonic() + TIMEOUT
        while not done():
            assert time.monotonic() < end, (self.text, self.diagnostics)
            self.executor.spin_once(timeout_sec=0.1)

    def call(self, client, request):
        """Return the response of a service."""
        future = client.call_async(request)
        self.wait_until(future.done)
        return future.result()

    def until_diagnosed(self, level: bytes, text: str) -> None:
        self.wait_until(lambda: self.level == level and text in self.text)

    def count(self, key: str) -> int:
        return int(self.values.get(key, 0))

    def drive(self, truth: np.ndarray, laps: int = 2) -> None:
        """Deliver the odometry of laps."""
        for i, pose in enumerate(odometry_of(truth)[: laps * LAP]):
            self.deliver(odometry_message((i + 1) * SECOND, pose), self.odometry, self.corrected)

    def deliver(
        self, message: Odometry, publisher: Publisher, corrected: Sequence[Odometry]
    ) -> None:
        """
        Publish an odometry until it is there corrected: the graph has it before later closures.

        The subscription is best effort; the graph ignores a stamp that it has.
        """
        again = time.monotonic()

        def is_corrected() -> bool:
            nonlocal again
            if time.monotonic() >= again:
                publisher.publish(message)
                again = time.monotonic() + RESEND
            return bool(corrected) and corrected[-1].header.stamp == message.header.stamp

        self.wait_until(is_corrected)

    def delay(self, stamp: int, pose: np.ndarray) -> float:
        """Return after how many seconds an odometry is there corrected."""
        began, before = time.monotonic(), len(self.corrected)
        self.odometry.publish(odometry_message(stamp, pose))
        self.wait_until(lambda: len(self.corrected) > before)
        return time.monotonic() - began

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def peer():
    peer = Peer()
    yield peer
    peer.close()


@pytest.fixture
def graph(peer, tmp_path):
    """Start the node; its maps folder is ``tmp_path``."""
    started = []

    def start(*parameters: str) -> Process:
        words = [w for p in (f'maps_folder:={tmp_path}', *parameters) for w in ('-p', p)]
        started.append(Process(tmp_path / 'log', 'pose_graph', '--ros-args', *words))
        peer.wait_until(lambda: peer.values.get('nodes'))
        return started[-1]

    yield start
    for process in started:
        process.end()


@pytest.fixture
def running(peer, graph):
    """Return the node, subscribed."""
    process = graph()
    topics = peer.odometry, peer.closures
    peer.wait_until(lambda: all(endpoint.get_subscription_count() for endpoint in topics))
    return process


def solver_of(process: Process) -> int:
    """Return the process of the graph; 0 = there is none."""
    folder = Path(f'/proc/{process.popen.pid}/task')
    children = ' '.join(file.read_text() for file in folder.glob('*/children')).split()
    result = [c for c in children if 'spawn_main' in Path(f'/proc/{c}/cmdline').read_text()]
    return int(result[0]) if result else 0


def has_ended(number: int) -> bool:
    try:
        return Path(f'/proc/{number}/stat').read_text().split()[2] == 'Z'
    except FileNotFoundError:
        return True


def test_pose_graph_over_ros_corrects_saves_and_survives_bad_input(peer, running, tmp_path):
    truth = circle()
    peer.drive(truth)
    peer.odometry.publish(odometry_message(SECOND, np.full(7, np.nan)))
    peer.closures.publish(LoopClosure(has_relative_pose=True))
    for query in range(LAP, 2 * LAP, 2):
        peer.closures.publish(closure_message(truth, query))
    peer.wait_until(lambda: peer.count('accepted_closures') >= 0.9 * LAP / 2)
    peer.wait_until(lambda: {'invalid_odometry', 'invalid_closures'} <= peer.values.keys())
    saved = peer.call(peer.save, SaveMap.Request(path='drive.tum'))
    assert saved.success, saved.message
    assert 'maps folder' in peer.call(peer.save, SaveMap.Request(path='../drive.tum')).message
    wrong = peer.call(peer.save, SaveMap.Request(path='drive.txt'))
    assert 'expected a name that ends in .kitti, .g2o or' in wrong.message
    peer.wait_until(lambda: peer.paths and len(peer.paths[-1].poses) == 2 * LAP)
    tum = np.loadtxt(tmp_path / 'drive.tum')
    assert error(tum[:, 1:], truth) < 1
    assert len({message.header.stamp.sec for message in peer.corrected}) == 2 * LAP
    assert running.popen.poll() is None


def test_pose_graph_in_a_long_solution_delays_no_odometry_and_ends_at_once(peer, running):
    """The solution does not end: its process is stopped."""
    poses = odometry_of(circle())
    peer.deliver(odometry_message(SECOND, poses[0]), peer.odometry, peer.corrected)
    solver = solver_of(running)
    loaded = Path(f'/proc/{solver}/maps').read_text()
    assert 'rclpy' not in loaded
    assert 'torch' not in loaded
    os.kill(solver, signal.SIGSTOP)
    saving = peer.save.call_async(SaveMap.Request(path='drive.tum'))
    delays = [peer.delay((i + 1) * SECOND, poses[i]) for i in range(1, 100)]
    assert max(delays) < 10  # on a busy machine
    assert peer.call(peer.reset, Trigger.Request()).success
    peer.wait_until(saving.done)
    assert 'reset' in saving.result().message
    assert has_ended(solver)
    peer.wait_until(lambda: solver_of(running))
    solver = solver_of(running)
    os.kill(solver, signal.SIGSTOP)
    peer.save.call_async(SaveMap.Request(path='drive.tum'))
    began = time.monotonic()
    assert running.stop(signal.SIGTERM) == 0
    assert time.monotonic() - began < 30
    assert has_ended(solver)


def test_pose_graph_killed_leaves_no_process_behind(peer, running):
    solver = solver_of(running)
    os.kill(solver, signal.SIGSTOP)  # in a solution it would not notice the end of the pipe
    running.popen.kill()
    peer.wait_until(lambda: has_ended(solver))


def test_pose_graph_without_its_process_reports_and_begins_anew(peer, running):
    truth = circle(3)
    peer.drive(truth)
    for query in range(LAP, 2 * LAP):
        peer.closures.publish(closure_message(truth, query))
    peer.wait_until(lambda: peer.count('accepted_closures') >= 0.9 * LAP)
    poses = odometry_of(truth)
    peer.delay((2 * LAP + 1) * SECOND, poses[2 * LAP])
    before = pose_array(peer.corrected[-1].pose.pose)
    assert np.linalg.norm(before - poses[2 * LAP]) > 1
    os.kill(solver_of(running), signal.SIGKILL)
    peer.until_diagnosed(DiagnosticStatus.ERROR, 'raise keyframe_distance')
    for i in range(2 * LAP, 3 * LAP):
        peer.delay((i + 1) * SECOND, poses[i])
    np.testing.assert_allclose(pose_array(peer.corrected[-LAP].pose.pose), before, atol=1e-6)
    peer.wait_until(lambda: peer.values.get('nodes') == str(LAP))
    path = peer.paths[-1].poses
    peer.wait_until(lambda: len(peer.paths[-1].poses) == LAP)
    path = [
        pose_array(stamped.pose) for stamped in (peer.paths[-1].poses[0], peer.paths[-1].poses[-1])
    ]
    np.testing.assert_allclose(path[0], before, atol=1e-6)
    np.testing.assert_allclose(path[1], pose_array(peer.corrected[-1].pose.pose), atol=1e-6)
    assert peer.values['lost_graphs'] == '1'


def test_pose_graph_diagnoses_closures_that_it_cannot_use(peer, running):
    truth = circle()

    def drive() -> None:
        peer.drive(truth)
        peer.wait_until(lambda: peer.values.get('nodes') == str(2 * LAP))

    def publish(**fields) -> None:
        peer.delay(2 * LAP * SECOND, odometry_of(truth)[-1])
        for query in range(LAP, 2 * LAP):
            message = closure_message(truth, query)
            for name, value in fields.items():
                setattr(message.relative_pose, name, value)
            peer.closures.publish(message)

    peer.deliver(odometry_message(SECOND, odometry_of(truth)[0]), peer.odometry, peer.corrected)
    publish(frame='camera')
    peer.until_diagnosed(DiagnosticStatus.WARN, '100 of 100 closures are invalid: ')
    assert 'set camera_transform' in peer.text
    assert peer.call(peer.reset, Trigger.Request()).success
    drive()
    publish(place_stamp=time_message(SECOND // 2))
    peer.until_diagnosed(DiagnosticStatus.WARN, '100 of 100 closures are of stamps without')
    assert peer.call(peer.reset, Trigger.Request()).success
    for source, remedy in (
        (RelativePose.REFUTED, 'are refuted by PnP'),
        (RelativePose.DROPPED, 'are dropped, as PnP is slower'),
    ):
        publish(source=source)
        peer.until_diagnosed(DiagnosticStatus.WARN, f'100 of 100 closures {remedy}')
        assert peer.call(peer.reset, Trigger.Request()).success
    drive()
    publish()
    peer.wait_until(lambda: peer.count('accepted_closures') > 0.9 * LAP)
    peer.until_diagnosed(DiagnosticStatus.OK, 'closures accepted')


def test_pose_graph_of_robots_has_topics_of_each(peer, graph):
    graph('robots:=[a, b]', 'appearance_edges:=false')
    received: list[Odometry] = []
    peer.node.create_subscription(Odometry, 'pose_graph/b/odometry', received.append, 10)
    publishers = [peer.node.create_publisher(Odometry, f'{name}/odom', 10) for name in 'ab']
    pose = odometry_of(circle())[0]
    peer.wait_until(lambda: all(endpoint.get_subscription_count() for endpoint in publishers))
    publishers[1].publish(odometry_message(SECOND, pose))
    peer.wait_until(lambda: received)
    peer.until_diagnosed(DiagnosticStatus.WARN, 'no odometry on a/odom: remap it')
    publishers[0].publish(odometry_message(SECOND, pose))
    np.testing.assert_allclose(pose_array(received[0].pose.pose), pose)
    peer.closures.publish(LoopClosure(robot_id='c'))
    peer.until_diagnosed(DiagnosticStatus.WARN, 'set robot_id of the recognition node')
    for _ in range(2):
        peer.closures.publish(LoopClosure(robot_id='b'))
    peer.until_diagnosed(DiagnosticStatus.WARN, '2 of 3 closures are without a usable relative')


def test_pose_graph_of_two_robots_is_in_one_frame(peer, graph):
    """Robot b drives the lap after robot a; its odometry begins elsewhere."""
    graph('robots:=[a, b]')
    odometry, corrected, paths, publishers = {}, {'a': [], 'b': []}, {'a': [], 'b': []}, {}
    truth, latched = circle(), QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    odometry['a'], odometry['b'] = np.split(odometry_of(truth), 2)
    elsewhere = matrices(planar_poses(np.array([[50.0, -80.0, 2.0]])))
    odometry['b'] = to_poses(elsewhere @ matrices(odometry['b']))
    subscribe = peer.node.create_subscription
    for robot in 'ab':
        topic = f'pose_graph/{robot}'
        subscribe(Odometry, f'{topic}/odometry', corrected[robot].append, 1000)
        subscribe(NavigationPath, f'{topic}/path', paths[robot].append, latched)
        publishers[robot] = peer.node.create_publisher(Odometry, f'{robot}/odom', 1000)
    topics = *publishers.values(), peer.closures
    peer.wait_until(lambda: all(endpoint.get_subscription_count() for endpoint in topics))
    for i in range(LAP):  # at the same time
        for robot, first in (('a', 0), ('b', LAP)):
            message = odometry_message((first + i + 1) * SECOND, odometry[robot][i])
            peer.deliver(message, publishers[robot], corrected[robot])
    for query in range(LAP, 2 * LAP):
        message = closure_message(truth, query)
        message.query_index, message.map_id, message.has_poses = -1, 'abc', True
        message.place_pose = pose_message(odometry['a'][query - LAP])
        message.robot_id, message.place_session = 'b', 'a'
        peer.closures.publish(message)
    counts = 'accepted_closures', 'rejected_closures'
    peer.wait_until(lambda: sum(map(peer.count, counts)) == LAP)
    for robot, first in (('a', 0), ('b', LAP)):
        message = odometry_message((first + LAP) * SECOND, odometry[robot][-1])
        publishers[robot].publish(message)

    def end(robot: str) -> np.ndarray:
        return pose_array(corrected[robot][-1].pose.pose)

    def has_path(robot: str) -> bool:
        path = paths[robot] and paths[robot][-1].poses
        return len(path) == LAP and np.allclose(pose_array(path[-1].pose), end(robot))

    peer.wait_until(lambda: all(len(endpoint) > LAP for endpoint in corrected.values()))
    peer.wait_until(lambda: all(map(has_path, 'ab')))
    assert np.linalg.norm(end('a')[:3] - end('b')[:3]) < 1


def test_pose_graph_publishes_the_topics_of_the_layouts(peer, running):
    folder = Path(get_package_share_directory('stavpr_ros')) / 'config'
    for name in ('pose_graph.rviz', 'pose_graph_foxglove.json'):
        topics = set(re.findall(r'(/pose_graph/\w+)', (folder / name).read_text()))
        assert topics == {f'/pose_graph/{x}' for x in ('path_before', 'path', 'edges', 'odometry')}
        result = dict(peer.node.get_publisher_names_and_types_by_node('pose_graph', '/'))
        assert topics <= result.keys()
