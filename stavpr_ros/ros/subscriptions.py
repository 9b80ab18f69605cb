# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions whose QoS a user may override, the remedies for a wrong one, and odometry."""

from collections.abc import Callable
import time
from typing import Any

from nav_msgs.msg import Odometry
import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping.trajectory import Trajectory
from stavpr_ros.ros.output import nanoseconds

_REMEDIES = {
    'RELIABILITY': 'set qos_overrides.{topic}.subscription.reliability to best_effort, or make '
    'the publisher reliable',
    'DURABILITY': 'set qos_overrides.{topic}.subscription.durability to volatile, or make the '
    'publisher transient local',
}
ODOMETRY = 'nav_msgs/msg/Odometry'
OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)


def qos_remedy(topic: str, policy: str) -> str:
    """Return the remedy for a publisher with an incompatible quality of service."""
    remedy = _REMEDIES.get(policy, f'make the publisher offer at least the requested {policy}')
    return f'a publisher of {topic} offers another {policy.lower()}: ' + remedy.format(topic=topic)


def subscribe(
    node: Node,
    message_type: type,
    topic: str,
    callback: Callable[[Any], None],
    depth: int,
    **events: Callable[[Any], None],
) -> Subscription:
    """
    Subscribe with sensor-data QoS, in a callback group of its own; qos_overrides change the QoS.

    :raises SettingsError: invalid qos_overrides.
    """
    try:
        return node.create_subscription(
            message_type,
            topic,
            callback,
            # an equal copy of qos_profile_sensor_data: rclpy writes overrides into its argument
            QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT),
            callback_group=MutuallyExclusiveCallbackGroup(),
            event_callbacks=SubscriptionEventCallbacks(**events),
            qos_overriding_options=QoSOverridingOptions(OVERRIDABLE),
        )
    except UnsupportedEventTypeError:
        raise
    except (RuntimeError, ParameterException) as error:
        name = node.resolve_topic_name(topic)
        raise SettingsError(
            f'cannot subscribe to {name}: {error}; correct qos_overrides.{name}.subscription and '
            'start again'
        ) from error


def misdirected(node: Node, topic: str) -> str:
    """
    Return why no odometry can arrive on a topic; empty if it can, or if there is none anywhere.

    :param topic: after remapping.
    """
    publishers = node.get_publishers_info_by_topic(topic)
    types = sorted({info.topic_type for info in publishers})
    if ODOMETRY in types:
        return ''
    found = f'{", ".join(types)} is published' if types else 'nothing is published'
    others = [
        name
        for name, kinds in node.get_topic_names_and_types()
        if ODOMETRY in kinds and node.count_publishers(name)
    ]
    if not (types or others):
        return ''
    hint = f', odometry is on {", ".join(others)}' if others else ''
    return f'{found} on {topic}{hint}: remap odom to the topic of the odometry'


def odometry_pose(message: Odometry) -> np.ndarray:
    """Return the pose of an odometry message, shape (7,), float64."""
    p, o = message.pose.pose.position, message.pose.pose.orientation
    return np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w])


class OdometryInput:
    """
    The subscription to odometry, on the topic ``odom``.

    :param timeout: seconds for which the newest pose is valid.

    ``frame`` is the frame of the poses, ``child_frame`` the one whose poses they are.
    """

    def __init__(self, node: Node, timeout: float) -> None:
        self.trajectory = Trajectory(timeout)
        self._node, self._timeout = node, timeout
        self._arrived: float | None = None
        self.frame = self.child_frame = ''
        self._subscription = subscribe(node, Odometry, 'odom', self._on_odometry, 50)

    def freshness(self) -> str:
        """Return ``fresh``, ``stale`` or ``never``, for the diagnostics."""
        if self._arrived is None:
            return 'never'
        return 'fresh' if time.monotonic() - self._arrived < max(2.0, self._timeout) else 'stale'

    def fault(self) -> str:
        """Return why nothing can arrive, as a wrong remapping; empty = nothing known."""
        fresh = self.freshness() == 'fresh'
        return '' if fresh else misdirected(self._node, self._subscription.topic_name)

    def close(self) -> None:
        """Unsubscribe from odometry."""
        self._node.destroy_subscription(self._subscription)

    def _on_odometry(self, message: Odometry) -> None:
        try:
            self.trajectory.add(nanoseconds(message.header.stamp), odometry_pose(message))
        except InputError as error:
            self._node.get_logger().warning(
                f'odometry rejected: {error}', throttle_duration_sec=10.0
            )
            return
        self._arrived = time.monotonic()
        self.frame, self.child_frame = message.header.frame_id, message.child_frame_id
