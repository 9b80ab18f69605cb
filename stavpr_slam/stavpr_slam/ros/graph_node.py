# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The pose-graph node: odometry and loop closures in, corrected poses out."""

from collections import Counter
from dataclasses import replace
from functools import partial
import gc
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry, Path
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_msgs.srv import SaveMap
from stavpr_ros.checks import require_above, require_at_least
from stavpr_ros.errors import InputError, SettingsError, StavprError
from stavpr_ros.mapping.trajectory import normalize_pose
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.pipeline.maps_folder import inside, maps_folder
from stavpr_ros.ros.diagnostics import one_status
from stavpr_ros.ros.messages import nanoseconds, pose_array, pose_message, transform_message
from stavpr_ros.ros.navigation import tf_message
from stavpr_ros.ros.qos import LATCHED
from stavpr_ros.ros.rclpy_workarounds import ManagedNode, repeat_responses
from stavpr_slam.pose_graph import ChainSettings, GraphSettings
from stavpr_slam.ros.correction import LEVER, LimitedCorrection
from stavpr_slam.ros.graph_messages import (
    closure_of,
    CLOSURE_QOS,
    edge_markers,
    ODOMETRY_QOS,
    path_bytes,
)
from stavpr_slam.ros.graph_process import GraphProcess, RobotOdometry, Snapshot
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

PERIOD = 1.0  # seconds between two diagnostics
CONTRADICTED = 'the odometry is published: it contradicts all closures'
UNUSABLE = {  # counts of closures without a measurement, by the source of the relative pose
    RelativePose.REFUTED: 'refuted closures',
    RelativePose.DROPPED: 'dropped closures',
}
PARAMETERS = {
    'autostart': (True, 'configure and activate at the start'),
    'loop_closure_topics': (
        ['stavpr/loop_closure'],
        'topics of stavpr_msgs/LoopClosure, one for each recognition node',
    ),
    'map_frame': ('map', 'frame of the corrected poses'),
    'robots': (
        [''],
        'names of the robots of one graph; "" = one robot without a name; a robot NAME has its '
        'odometry on NAME/odom, and ~/NAME/odometry, ~/NAME/map_to_odom, ~/NAME/path; closures on '
        'a map whose place_session is another NAME join the two',
    ),
    'max_correction_speed': (
        0.0,
        'm/s at which the corrected pose of the robot moves at most when the graph changes; it '
        f'turns by at most 1/{LEVER:g} of this number in rad/s; 0 = at once',
    ),
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
    Corrects the odometry of one or several robots by loop closures.

    A lifecycle node. The graph is in a process of its own; callbacks hand over, and publish the
    newest odometry in the map frame.

    :raises StavprError: an invalid parameter.
    """

    THREADS = 5

    def __init__(self, **options: Any) -> None:
        super().__init__('pose_graph', **options)
        rows = [(name, default) for name, (default, _) in PARAMETERS.items()]
        values = {row.name: row.value for row in self.declare_parameters('', rows)}
        self._frame, self._topics = str(values['map_frame']), list(values['loop_closure_topics'])
        self._appearance = bool(values['appearance_edges'])
        self._folder = maps_folder(values['maps_folder'])
        for name in ('keyframe_distance', 'max_odometry_gap'):
            require_above(name, values[name], 0)
        self._speed, self._robots = values['max_correction_speed'], list(values['robots'])
        require_at_least('max_correction_speed', self._speed, 0, 'm/s')
        if len({*self._robots}) < max(len(self._robots), 1):
            raise SettingsError(f'robots = {self._robots}: expected different names, or one ""')
        gc.freeze()  # collecting what is imported would take .15 s, without any odometry
        keyframes = ChainSettings(values['keyframe_distance'], max_gap=values['max_odometry_gap'])
        self._settings = GraphSettings(keyframes)
        self._tf_type: Any = tf_message() if values['publish_tf'] else None
        self._graph: GraphProcess | None = None
        self._entities: list[Any] = []
        self._made_publishers: list[Any] = []
        self._forget()
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        group = MutuallyExclusiveCallbackGroup
        self.create_timer(PERIOD, self._publish_diagnostics, group(), steady)
        services = (SaveMap, '~/save', self._save), (Trigger, '~/reset', self._reset)
        for kind, name, serve in services:
            repeat_responses(self.create_service(kind, name, serve, callback_group=group()))
        self._start = self.create_timer(0.0, self._on_start, group(), steady, values['autostart'])

    def _on_start(self) -> None:
        self._start.cancel()
        if self.advance(self.trigger_configure):
            self.advance(self.trigger_activate)

    # life cycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create the publishers, and start the process of the graph."""

        def make(*arguments: Any) -> Any:
            self._made_publishers.append(self.create_lifecycle_publisher(*arguments))
            return self._made_publishers[-1]

        self._edges = make(MarkerArray, '~/edges', LATCHED)
        self._tf: Any = make(self._tf_type, '/tf', 100) if self._tf_type else None
        self._outputs, self._paths = {}, {}
        for robot in self._robots:
            name = f'~/{robot}/'.replace('//', '/')
            self._outputs[robot] = (
                make(Odometry, f'{name}odometry', 50),
                make(TransformStamped, f'{name}map_to_odom', LATCHED),
            )
            self._paths[robot] = [make(Path, name + x, LATCHED) for x in ('path_before', 'path')]
        self._graph = GraphProcess(self._settings, self._on_snapshot, self._on_lost)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe."""
        result = super().on_activate(state)
        group = MutuallyExclusiveCallbackGroup()
        subscribe = partial(self.create_subscription, callback_group=group)
        for robot in self._robots:
            topic, take = f'{robot}/odom'.lstrip('/'), partial(self._on_odometry, robot)
            self._entities.append(subscribe(Odometry, topic, take, ODOMETRY_QOS))
        for topic in self._topics:
            self._entities.append(subscribe(LoopClosure, topic, self._on_closure, CLOSURE_QOS))
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe; the graph stays."""
        self._unsubscribe()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the graph."""
        self._stop()
        self._forget()
        while self._made_publishers:
            self.destroy_publisher(self._made_publishers.pop())
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the process of the graph."""
        self._stop()
        return super().on_shutdown(state)

    def destroy_node(self) -> None:
        """End the process of the graph, and destroy the node."""
        self.ending.set()
        self._stop()
        super().destroy_node()

    def _unsubscribe(self) -> None:
        while self._entities:
            self.destroy_subscription(self._entities.pop())

    def _stop(self) -> None:
        self._unsubscribe()
        if self._graph is not None:
            self._graph.stop()

    def _forget(self) -> None:
        self._corrections = {robot: LimitedCorrection(self._speed) for robot in self._robots}
        self._child_frames = dict.fromkeys(self._robots, '')
        self._silent = {*self._robots}  # those without odometry
        self._values: dict[str, Any] = {}
        self._broken = 0  # breaks of the odometry that are logged
        self.counts: Counter[str] = Counter()
        self._problems: dict[str, str] = {}  # the last ones, by kind
        self._lost = ''  # why the graph before this one was lost

    # input

    def _on_odometry(self, robot: str, message: Odometry) -> None:
        assert self._graph is not None
        pose, stamp = pose_array(message.pose.pose), nanoseconds(message.header.stamp)
        stated = message.pose.covariance
        covariance = stated.tolist() if stated.any() else None
        self.counts['odometry'] += 1
        self._graph.add(RobotOdometry(robot, stamp, pose.tolist(), covariance))
        try:
            odometry = matrices(normalize_pose(pose))
        except InputError:
            return  # the graph counts it
        self._child_frames[robot] = message.child_frame_id
        self._silent.discard(robot)
        correction = self._corrections[robot].at(stamp, odometry)
        result = Odometry(child_frame_id=message.child_frame_id, twist=message.twist)
        result.header = Header(stamp=message.header.stamp, frame_id=self._frame)
        result.pose.pose = pose_message(to_poses(correction @ odometry))
        result.pose.covariance = message.pose.covariance
        transform = transform_message(to_poses(correction), self._frame, message.header.frame_id)
        transform.header.stamp = message.header.stamp
        for publisher, output in zip(self._outputs[robot], (result, transform), strict=True):
            publisher.publish(output)
        if self._tf is not None:
            self._tf.publish(self._tf_type(transforms=[transform]))

    def _on_closure(self, message: LoopClosure) -> None:
        assert self._graph is not None
        self.counts['closures'] += 1
        robot, edge = message.robot_id if self._robots != [''] else '', message.relative_pose
        others = {*self._robots} - {'', robot}
        expected = self._child_frames.get(robot, '')
        if robot not in self._robots:
            self._reject(
                'closures',
                f'a closure has robot_id {robot!r}: expected one of the parameter robots, '
                f'{self._robots}; set robot_id of the recognition node',
            )
        elif message.has_relative_pose and expected not in ('', edge.frame):
            self._reject(
                'closures',
                f'the relative pose is of frame {edge.frame!r}, the odometry of {expected!r}: set '
                'camera_transform of the recognition node',
            )
        elif (closure := closure_of(message, self._appearance)) is None:
            self.counts[UNUSABLE.get(edge.source, 'without relative pose')] += 1
        else:
            closure = replace(closure, query_robot=robot, place_robot=robot)
            if message.query_index < 0 and message.place_session in others:
                # the stamp of the place is of that robot's odometry, not of a map with fixed poses
                place = message.place_session
                closure = replace(closure, map_id='', place_pose=None, place_robot=place)
            self._graph.add(closure)

    def _reject(self, kind: str, problem: str) -> None:
        self.counts[f'invalid {kind}'] += 1
        self._problems[kind] = problem
        self.get_logger().warning(f'input rejected: {problem}', throttle_duration_sec=10.0)

    # the graph

    def _on_snapshot(self, snapshot: Snapshot) -> None:
        """Aim at new corrections, and publish paths and edges; on the thread of the graph."""
        for robot, correction in snapshot.corrections.items():
            breaks = sum(name == robot for name, _ in snapshot.breaks)
            self._corrections[robot].aim(correction, breaks)
        for robot, text in snapshot.breaks[self._broken :]:
            self.get_logger().warning(f'new session{robot and f" of {robot}"}: {text}')
        self._broken = len(snapshot.breaks)
        for kind, problem in snapshot.invalid:
            self._reject(kind, problem)
        self._values = snapshot.values
        if snapshot.failure:
            self.counts['failed updates'] += 1
            self._problems['updates'] = snapshot.failure
            self.get_logger().error(f'no update: {snapshot.failure}', throttle_duration_sec=10.0)
        if snapshot.values['accepted_closures']:
            self._lost = ''
        elif snapshot.values['rejected_closures']:
            self.get_logger().warning(CONTRADICTED, throttle_duration_sec=10.0)
        if snapshot.trajectories and self.state == 'active':
            for robot, (stamps, *both) in snapshot.trajectories.items():
                for publisher, poses in zip(self._paths[robot], both, strict=True):
                    publisher.publish(path_bytes(self._frame, stamps, poses))
            self._edges.publish(edge_markers(self._frame, *snapshot.edges))

    def _on_lost(self, problem: str) -> None:
        self._lost = self._problems['process'] = problem
        self.counts = Counter({'lost graphs': self.counts['lost graphs'] + 1})
        self._values, self._broken = {}, 0
        self.get_logger().error(problem)

    # services and diagnostics

    def _save(self, request: Any, response: Any) -> Any:
        try:
            path = inside(self._folder, request.path)
            if self._graph is None:
                raise StavprError(f'the node is {self.state}: configure it')
            response.places = self._graph.save(path, request.overwrite)
            response.success, response.message = True, f'{response.places} nodes to {path}'
        except StavprError as error:
            response.success, response.message = False, str(error)
            self.get_logger().warning(f'save failed: {error}')
        return response

    def _reset(self, request: Any, response: Any) -> Any:
        if self._graph is not None:
            self._graph.reset()
        self._forget()
        response.success, response.message = True, 'the graph is empty'
        return response

    def _publish_diagnostics(self) -> None:
        counts, graph = Counter(self.counts), Counter(self._values)
        if self._graph is not None and self._graph.dropped:
            counts['dropped input'] = self._graph.dropped
        values = {
            'state': self.state,
            **self._values,
            **{name.replace(' ', '_'): count for name, count in counts.items()},
            'last_problem': '; '.join(self._problems.values()),
        }
        self._diagnostics.publish(one_status(self, 'graph', *self._health(counts, graph), values))

    def _health(self, counts: Counter[str], graph: Counter[str]) -> tuple[bytes, str]:
        """Return the level of the diagnostics and the reason with its remedy."""
        usable = sum(graph[f'{name}_closures'] for name in ('accepted', 'rejected', 'waiting'))
        useless = {
            f'invalid: {self._problems.get("closures")}': counts['invalid closures'],
            'of stamps without odometry: is it of the same clock?': graph[
                'closures_of_unknown_stamps'
            ],
            'without a usable relative pose, see relative_pose.reason of the closures: check '
            'camera_info, camera_transform and the odometry': counts['without relative pose'],
            'refuted by PnP: the recognition node finds wrong places, raise its '
            'min_probability, or camera_info is not of the images': counts['refuted closures'],
            'dropped, as PnP is slower than they come: set max_rate or keyframe_distance of the '
            'recognition node, or free a processor core': counts['dropped closures'],
        }
        reason = max(useless, key=lambda text: useless[text])
        level, text = DiagnosticStatus.WARN, f'{graph["accepted_closures"]} closures accepted'
        if graph['rejected_closures'] and not graph['accepted_closures']:
            text = CONTRADICTED
        if self.state != 'active':
            level, text = DiagnosticStatus.OK, f'the node is {self.state}'
        elif self._lost:
            level, text = DiagnosticStatus.ERROR, self._lost
        elif counts['invalid odometry'] > counts['odometry'] / 2:
            text = f'most odometry is invalid: {self._problems["odometry"]}'
        elif self._silent:
            topics = ', '.join(f'{robot}/odom'.lstrip('/') for robot in sorted(self._silent))
            text = f'no odometry on {topics}: remap it to the topic of nav_msgs/Odometry'
        elif useless[reason] > usable:
            text = f'{useless[reason]} of {counts["closures"]} closures are {reason}'
        elif counts['failed updates']:
            text = f'updates failed: {self._problems["updates"]}'
        else:
            level = DiagnosticStatus.OK
        return level, text
