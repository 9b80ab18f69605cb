# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose-graph node: odometry and loop closures in, corrected poses out."""

from collections import Counter
import math
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from stavpr_msgs.msg import LoopClosure
from stavpr_msgs.srv import SaveMap
from stavpr_ros.errors import InputError, SettingsError, StavprError
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.pipeline.maps_folder import inside, maps_folder
from stavpr_ros.ros.diagnostics import one_status
from stavpr_ros.ros.navigation import tf_message, transform_message
from stavpr_ros.ros.output import nanoseconds, pose_message
from stavpr_ros.ros.rclpy_workarounds import ManagedNode, repeat_responses
from stavpr_ros.ros.subscriptions import odometry_pose
from stavpr_slam.pose_graph import ChainSettings, GraphSettings, PoseGraph
from stavpr_slam.pose_graph.files import save_graph
from stavpr_slam.ros.graph_messages import closure_of, edge_markers, path_messages
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

ODOMETRY_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
CLOSURE_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PERIOD = 1.0  # seconds between two diagnostics, and at least between two paths
SHARE = 0.1  # of the time, at most, for the publication of paths and edges
MAX_INBOX = 100_000  # messages that wait for the worker
STOP_TIMEOUT = 30.0  # seconds for the worker to end
PARAMETERS = {
    'autostart': (True, 'configure and activate at the start'),
    'loop_closure_topics': (
        ['stavpr/loop_closure'],
        'topics of stavpr_msgs/LoopClosure, one for each recognition node',
    ),
    'map_frame': ('map', 'frame of the corrected poses'),
    'keyframe_distance': (1.0, 'meters between keyframes, above 0'),
    'max_odometry_gap': (5.0, 'seconds without odometry that begin a new session, above 0'),
    'appearance_edges': (
        True,
        'closures without a relative pose count as edges, with deviations of 3 m and 10 degrees',
    ),
    'publish_tf': (False, 'publish map -> odom on /tf; requires tf2_msgs'),
    'maps_folder': ('', "folder that ~/save writes to; '' = that of the recognition node"),
}


class PoseGraphNode(ManagedNode):
    """
    Corrects the odometry by loop closures.

    A lifecycle node. A worker thread solves; callbacks only hand over and publish the latest
    odometry in the map frame.

    :raises StavprError: an invalid parameter, or GTSAM is not installed.
    """

    THREADS = 4

    def __init__(self, **options: Any) -> None:
        super().__init__('pose_graph', **options)
        given = {
            name: self.declare_parameter(name, default).value
            for name, (default, _) in PARAMETERS.items()
        }
        self._frame, self._topics = str(given['map_frame']), list(given['loop_closure_topics'])
        self._appearance = bool(given['appearance_edges'])
        self._folder = maps_folder(given['maps_folder'])
        for name in ('keyframe_distance', 'max_odometry_gap'):
            if not (math.isfinite(given[name]) and given[name] > 0):
                raise SettingsError(f'{name} = {given[name]}: expected a number above 0')
        keyframes = ChainSettings(given['keyframe_distance'], max_gap=given['max_odometry_gap'])
        self._graph = PoseGraph(GraphSettings(keyframes))
        self._tf_type: Any = tf_message() if given['publish_tf'] else None
        self._lock = threading.Lock()  # of the graph
        self._wake = threading.Condition()  # of the inbox
        self._inbox: list[Odometry | LoopClosure] = []
        self._worker: threading.Thread | None = None
        self._running = False
        self._entities: list[Any] = []
        self._correction = np.eye(4)  # from the odometry's frame to the map
        self._odometry_frame = self._child_frame = ''
        self.counts: Counter[str] = Counter()
        self.problem = ''
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        group = MutuallyExclusiveCallbackGroup()
        self.create_timer(PERIOD, self._publish_diagnostics, group, steady)
        services = MutuallyExclusiveCallbackGroup()
        for kind, name, serve in (
            (SaveMap, '~/save', self._save),
            (Trigger, '~/reset', self._reset),
        ):
            repeat_responses(self.create_service(kind, name, serve, callback_group=services))
        self._start: Timer | None = None
        if given['autostart']:
            self._start = self.create_timer(0.0, self._on_start, services, steady)

    def _on_start(self) -> None:
        assert self._start is not None
        self._start.cancel()
        if self.advance(self.trigger_configure):
            self.advance(self.trigger_activate)

    # life cycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create the publishers."""
        make = self.create_lifecycle_publisher
        self._path_before = make(Path, '~/path_before', LATCHED)
        self._path = make(Path, '~/path', LATCHED)
        self._edges = make(MarkerArray, '~/edges', LATCHED)
        self._odometry = make(Odometry, '~/odometry', 50)
        self._transform = make(TransformStamped, '~/map_to_odom', LATCHED)
        self._publishers = [
            self._path_before, self._path, self._edges, self._odometry, self._transform
        ]  # fmt: skip
        self._tf: Any = None
        if self._tf_type is not None:
            self._tf = make(self._tf_type, '/tf', 100)
            self._publishers.append(self._tf)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe, and start the worker."""
        result = super().on_activate(state)
        group = MutuallyExclusiveCallbackGroup()
        subscribe = self.create_subscription
        self._entities = [
            subscribe(Odometry, 'odom', self._on_odometry, ODOMETRY_QOS, callback_group=group),
            *(
                subscribe(LoopClosure, topic, self._hand_over, CLOSURE_QOS, callback_group=group)
                for topic in self._topics
            ),
        ]
        self._running = True
        self._worker = threading.Thread(target=self._work, name='graph', daemon=True)
        self._worker.start()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe, and end the worker; the graph stays."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the graph."""
        self._forget()
        for publisher in self._publishers:
            self.destroy_publisher(publisher)
        self._publishers = []
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the worker."""
        self._stop()
        return super().on_shutdown(state)

    def destroy_node(self) -> None:
        """End the worker, and destroy the node."""
        self.ending.set()
        self._stop()
        super().destroy_node()

    def _stop(self) -> None:
        for subscription in self._entities:
            self.destroy_subscription(subscription)
        self._entities = []
        with self._wake:
            self._running = False
            self._wake.notify()
        if self._worker is not None:
            self._worker.join(STOP_TIMEOUT)
            self._worker = None

    def _forget(self) -> None:
        with self._wake:
            self._inbox.clear()
        with self._lock:
            self._graph.reset()
            self._correction = np.eye(4)
        self.problem = ''

    # callbacks

    def _hand_over(self, message: Odometry | LoopClosure) -> None:
        with self._wake:
            if len(self._inbox) >= MAX_INBOX:
                del self._inbox[0]
                self.counts['dropped'] += 1
            self._inbox.append(message)
            if isinstance(message, LoopClosure):
                self._wake.notify()

    def _on_odometry(self, message: Odometry) -> None:
        self._hand_over(message)
        pose = odometry_pose(message)
        if not np.isfinite(pose).all() or not pose[3:].any():
            return  # the worker counts it
        corrected = to_poses(self._correction @ matrices(pose))
        result = Odometry(child_frame_id=message.child_frame_id, twist=message.twist)
        result.header = Header(stamp=message.header.stamp, frame_id=self._frame)
        result.pose.pose = pose_message(corrected)
        result.pose.covariance = message.pose.covariance
        self._odometry.publish(result)
        if self._tf is not None:
            correction = to_poses(self._correction)
            transform = transform_message(correction, self._frame, message.header.frame_id)
            transform.header.stamp = message.header.stamp
            self._tf.publish(self._tf_type(transforms=[transform]))

    # worker

    def _work(self) -> None:
        published, due = True, 0.0
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closures() or not self._running, PERIOD)
                if not self._running:
                    return
                inbox, self._inbox = self._inbox, []
            try:
                with self._lock:
                    for message in inbox:
                        self._take(message)
                    if inbox:
                        self._graph.update()
                        self._correction = matrices(self._graph.map_to_odom())
                published = published and not inbox
                began = time.monotonic()
                if not published and began >= due:
                    self._publish_graph()
                    published, took = True, time.monotonic() - began
                    due = began + max(PERIOD, took / SHARE)
            except Exception as error:  # one update failed: the next may succeed
                self.counts['failed updates'] += 1
                self.problem = f'{type(error).__name__}: {error}'
                self.get_logger().error(f'no update: {self.problem}', throttle_duration_sec=10.0)

    def _closures(self) -> bool:
        return any(isinstance(message, LoopClosure) for message in self._inbox)

    def _take(self, message: Odometry | LoopClosure) -> None:
        """Add a message to the graph; invalid input is counted and logged."""
        graph = self._graph
        try:
            if isinstance(message, Odometry):
                self.counts['odometry'] += 1
                breaks = len(graph.chain.breaks)
                graph.add_odometry(nanoseconds(message.header.stamp), odometry_pose(message))
                if len(graph.chain.breaks) > breaks:
                    self.get_logger().warning(f'new session: {graph.chain.breaks[-1]}')
                self._odometry_frame = message.header.frame_id
                self._child_frame = message.child_frame_id
                return
            self.counts['closures'] += 1
            frame = message.relative_pose.frame
            if message.has_relative_pose and self._child_frame not in ('', frame):
                raise InputError(
                    f'the relative pose is of frame {frame!r}, the odometry of '
                    f'{self._child_frame!r}: set camera_transform of the recognition node'
                )
            closure = closure_of(message, self._appearance)
            if closure is None:
                self.counts['without relative pose'] += 1
            else:
                graph.add_closure(closure)
        except InputError as error:
            self.counts['invalid'] += 1
            self.problem = str(error)
            self.get_logger().warning(f'input rejected: {error}', throttle_duration_sec=10.0)

    def _publish_graph(self) -> None:
        with self._lock:
            if not len(self._graph.solved):
                return
            trajectory = self._graph.chain.trajectory(self._graph.solved)
            markers = edge_markers(self._graph, self._frame)
            transform = transform_message(
                self._graph.map_to_odom(), self._frame, self._odometry_frame
            )
        before, after = path_messages(self._frame, *trajectory)  # a second of long drives
        transform.header.stamp = after.header.stamp
        self._path_before.publish(before)
        self._path.publish(after)
        self._edges.publish(markers)
        self._transform.publish(transform)

    # services and diagnostics

    def _save(self, request: Any, response: Any) -> Any:
        try:
            if not request.path:
                raise StavprError("path = '' is no file: set a name that ends in .g2o or .tum")
            path = inside(self._folder, request.path)
            with self._wake:
                inbox, self._inbox = self._inbox, []
            with self._lock:
                for message in inbox:
                    self._take(message)
                self._graph.update()
                self._graph.update(final=True)
                if not len(self._graph.solved):
                    raise StavprError('the graph is empty: there was no odometry')
                response.places = save_graph(self._graph, path, request.overwrite)
            if self.state == 'active':
                self._publish_graph()
            response.success, response.message = True, f'{response.places} nodes to {path}'
        except StavprError as error:
            response.success, response.message = False, str(error)
            self.get_logger().warning(f'save failed: {error}')
        return response

    def _reset(self, request: Any, response: Any) -> Any:
        self._forget()
        response.success, response.message = True, 'the graph is empty'
        return response

    def _publish_diagnostics(self) -> None:
        graph = self._graph
        unknown = graph.counts['unknown stamp']
        values: dict[str, object] = {
            'state': self.state,
            'nodes': len(graph.chain),
            'sessions': graph.chain.sessions,
            'breaks': '; '.join(graph.chain.breaks[-3:]),
            'breaks_by_closures': graph.splits,
            'accepted_closures': graph.accepted,
            'rejected_closures': graph.rejected,
            'waiting_closures': graph.pending,
            'closures_of_unknown_stamps': unknown,
            'comparisons_left_out': graph.uncompared,
            'odometry_error_factor': f'{graph.scale:.2f}',
            'last_problem': self.problem,
            **{name.replace(' ', '_'): count for name, count in self.counts.items()},
        }
        level, text = DiagnosticStatus.OK, f'{graph.accepted} closures accepted'
        if self.state != 'active':
            text = f'the node is {self.state}'
        elif not self.counts['odometry']:
            level = DiagnosticStatus.WARN
            text = 'no odometry: remap odom to the topic of nav_msgs/Odometry'
        elif self.counts['closures'] and unknown > graph.accepted:
            level = DiagnosticStatus.WARN
            text = 'most closures have stamps without odometry: is it of the same clock?'
        elif self.counts['failed updates']:
            level, text = DiagnosticStatus.WARN, f'updates failed: {self.problem}'
        self._diagnostics.publish(one_status(self, 'graph', level, text, values))
