# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What all bridges have in common: parameters, loop closures in, counts, diagnostics."""

from collections import Counter
import importlib
import math
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.errors import InputError, SettingsError, UnavailableError
from stavpr_ros.ros.diagnostics import one_status
from stavpr_ros.ros.messages import nanoseconds, odometry_pose
from stavpr_slam.pose_graph import Closure
from stavpr_slam.ros.bridges.external_keyframes import (
    ExternalKeyframes,
    keyframe_edge,
    KeyframeEdge,
)
from stavpr_slam.ros.graph_messages import closure_of, CLOSURE_QOS, ODOMETRY_QOS

PERIOD = 1.0  # seconds between two diagnostics
MAX_PENDING = 1000  # closures that wait for keyframes
REMEDIES = {
    'without_relative_pose': 'the closures are of appearance alone, refuted by PnP, or dropped at '
    'load (relative_pose.source NONE, REFUTED, DROPPED; relative_pose.reason has the cause): set '
    'camera_info and odom of the recognition node, for REFUTED raise min_probability',
    'invalid': 'the closures are invalid, as the log states',
    'waiting': 'no keyframes of the target: is it running, and are its topics remapped?',
    'no_keyframe': 'no keyframe near the stamps of the images: is it the same clock and odometry?',
    'on_a_map': 'the places are of a map, not of this drive: use operation loop_closure',
    'not_on_a_map': 'the places are of this drive: use operation localization, a map with poses',
    'not_pnp': 'the closures are not by PnP: set camera_info of the recognition node',
}


def interfaces(package: str, source: str, kind: str = 'msg') -> Any:
    """
    Import the interfaces of another package.

    :param source: where the package is from.
    :param kind: 'msg' or 'srv'.
    :raises UnavailableError: it is not installed.
    """
    try:
        return importlib.import_module(f'{package}.{kind}')
    except ImportError as error:
        raise UnavailableError(
            f'this bridge requires the package {package} ({source}): install or build it, and '
            'source its workspace before the bridge is started'
        ) from error


class Bridge(Node):
    """
    Passes loop closures of ``stavpr/loop_closure`` on; a subclass has its target.

    :raises UnavailableError: the messages of the target are not installed.
    :raises SettingsError: an invalid parameter.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]]

    def __init__(self) -> None:
        super().__init__(f'{self.NAME}_bridge')
        self.given = {
            name: self.declare_parameter(name, default).value
            for name, (default, _) in self.PARAMETERS.items()
        }
        self.counts: Counter[str] = Counter()
        self.create_subscription(LoopClosure, 'stavpr/loop_closure', self._on_closure, CLOSURE_QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD, self.on_timer, clock=steady)

    def seconds(self, name: str) -> float:
        """
        Return a parameter.

        :raises SettingsError: it is not a number above 0.
        """
        value = self.given[name]
        if not (math.isfinite(value) and value > 0):
            raise SettingsError(f'{name} = {value}: expected a number of seconds above 0')
        return float(value)

    def take(self, message: LoopClosure) -> str:
        """Pass a closure on; return why it is not, empty = it is, or waits."""
        raise NotImplementedError

    def _on_closure(self, message: LoopClosure) -> None:
        self.counts['closures'] += 1
        try:
            cause = self.take(message)
        except InputError as error:
            cause = 'invalid'
            self.get_logger().warning(f'closure rejected: {error}', throttle_duration_sec=10.0)
        if cause:
            self.counts[cause] += 1

    def status(self) -> tuple[bytes, str]:
        """Return the level of the diagnostics, and their sentence."""
        counts = self.counts
        causes = [(counts[cause], cause) for cause in REMEDIES if counts[cause]]
        if not counts['closures']:
            topic = self.resolve_topic_name('stavpr/loop_closure')
            return DiagnosticStatus.WARN, f'no closures on {topic}: remap it'
        if not counts['sent'] and causes:
            return DiagnosticStatus.WARN, REMEDIES[max(causes)[1]]
        return DiagnosticStatus.OK, f'{counts["sent"]} closures sent'

    def on_timer(self) -> None:
        """Publish the diagnostics."""
        self._diagnostics.publish(one_status(self, 'bridge', *self.status(), self.counts))


class EdgeBridge(Bridge):
    """Passes loop closures on as edges between the keyframes of the target."""

    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {
        'max_keyframe_gap': (2.0, 'seconds between an image and its keyframe at most, above 0'),
        'independent_only': (
            True,
            'only edges whose errors do not correlate with those of the edge before',
        ),
        'pnp_only': (False, 'only edges by PnP, none that are aligned by odometry'),
    }

    def __init__(self) -> None:
        super().__init__()
        self._pending: list[tuple[LoopClosure, Closure]] = []
        self._sent: set[tuple[int, int]] = set()
        self.keyframes = ExternalKeyframes(self.seconds('max_keyframe_gap'))
        self.create_subscription(Odometry, 'odom', self._on_odometry, ODOMETRY_QOS)

    def send(self, edge: KeyframeEdge, message: LoopClosure) -> None:
        """Pass an edge on."""
        raise NotImplementedError

    def ready(self) -> bool:
        """Return whether the target takes edges; they wait until it does."""
        return True

    def add_keyframe(self, stamp: int, number: int) -> None:
        """Add a keyframe of the target, stamp in ns, and send the closures that waited for it."""
        if stamp > 0:
            self.keyframes.add(stamp, number)
        self._send_pending()

    def on_timer(self) -> None:
        """Send what waited for the target, and publish the diagnostics."""
        self._send_pending()
        self.counts['waiting'] = len(self._pending)
        self.counts['keyframes'] = len(self.keyframes)
        super().on_timer()

    def _on_odometry(self, message: Odometry) -> None:
        try:
            self.keyframes.odometry.add(nanoseconds(message.header.stamp), odometry_pose(message))
        except InputError as error:
            self.counts['invalid_odometry'] += 1
            self.get_logger().warning(f'odometry rejected: {error}', throttle_duration_sec=10.0)

    def take(self, message: LoopClosure) -> str:
        """Let an edge wait for its keyframes."""
        relative = message.relative_pose
        if message.query_index < 0:
            return 'on_a_map'
        closure = closure_of(message, appearance=False)
        if closure is None:
            return 'without_relative_pose'
        if self.given['pnp_only'] and relative.source != relative.PNP:
            return 'not_pnp'
        if self.given['independent_only'] and not relative.is_independent:
            return 'not_independent'
        self._pending.append((message, closure.checked()))
        if len(self._pending) > MAX_PENDING:
            del self._pending[0]
            self.counts['no_keyframe'] += 1
        self._send_pending()
        return ''

    def _send_pending(self) -> None:
        """Send the edges whose keyframes are known; those of later stamps wait."""
        keyframes = self.keyframes
        if not self.ready():
            return
        waiting = []
        for message, closure in self._pending:
            if closure.query_stamp > keyframes.newest:
                waiting.append((message, closure))
                continue
            query, place = map(keyframes.near, (closure.query_stamp, closure.place_stamp))
            if query is None or place is None:
                self.counts['no_keyframe'] += 1
            elif (place[0], query[0]) in self._sent or place[0] == query[0]:
                self.counts['same_keyframes'] += 1
            else:
                self._sent.add((place[0], query[0]))
                self.send(keyframe_edge(closure, place, query), message)
                self.counts['sent'] += 1
        self._pending = waiting
