# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Base of all bridges: parameters, loop closures in, counts, diagnostics."""

from collections import Counter
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.checks import require_above
from stavpr_ros.errors import InputError
from stavpr_ros.ros.diagnostics import one_status
from stavpr_slam.pose_graph import Closure
from stavpr_slam.ros.graph_messages import closure_of, CLOSURE_QOS

PERIOD = 1.0  # seconds between two diagnostics
REMEDIES = {
    'without_relative_pose': 'the closures are of appearance alone, refuted by PnP, or dropped at '
    'load (relative_pose.source NONE, REFUTED, DROPPED; relative_pose.reason has the cause): set '
    'camera_info and odom of the recognition node, for REFUTED raise min_probability',
    'invalid': 'the closures are invalid, as the log states',
    'waiting': 'no keyframes of the target: is it running, and are its topics remapped?',
    'no_keyframe': 'no keyframe near the stamps of the images: is it the same clock and odometry?',
    'on_a_map': 'the places are of a map, not of this drive: use operation loop_closure',
    'not_on_a_map': 'the places are of this drive: use operation localization, a map with poses',
    'without_subscriber': 'nobody subscribes to the pose: start the filter, set its topic',
    'not_pnp': 'the closures are not by PnP: set camera_info of the recognition node',
}


class Bridge(Node):
    """
    Passes loop closures of ``stavpr/loop_closure`` on; a subclass has its target.

    :raises SettingsError: an invalid parameter.
    """

    NAME: ClassVar[str]
    IS_ON_MAP: ClassVar[bool]  # whether it passes on the closures on a map, or of the drive
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]]

    def __init__(self) -> None:
        super().__init__(f'{self.NAME}_bridge')
        rows = [(name, default) for name, (default, _) in self.PARAMETERS.items()]
        self.given = {row.name: row.value for row in self.declare_parameters('', rows)}
        for name, value in self.given.items():
            if isinstance(value, float):
                require_above(name, value, 0)
        self.counts: Counter[str] = Counter()
        self.create_subscription(LoopClosure, 'stavpr/loop_closure', self._on_closure, CLOSURE_QOS)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PERIOD, self.on_timer, clock=steady)

    def take(self, message: LoopClosure, closure: Closure) -> str:
        """Pass a valid closure on; return why it is not, empty = it is, or waits."""
        raise NotImplementedError

    def _cause(self, message: LoopClosure) -> str:
        """Return why a closure is not passed on."""
        relative, closure = message.relative_pose, closure_of(message)
        if (message.query_index < 0) != self.IS_ON_MAP or message.has_poses < self.IS_ON_MAP:
            return 'not_on_a_map' if self.IS_ON_MAP else 'on_a_map'
        if closure is None:
            return 'without_relative_pose'
        if self.given['pnp_only'] and relative.source != relative.PNP:
            return 'not_pnp'
        return self.take(message, closure.checked())

    def _on_closure(self, message: LoopClosure) -> None:
        self.counts['closures'] += 1
        try:
            cause = self._cause(message)
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
