# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions whose QoS a user may override: to images, as reliable as possible; to odometry."""

from collections import deque
from collections.abc import Callable
import threading
import time
from typing import Any

from nav_msgs.msg import Odometry
import numpy as np
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import qos_policy_name_from_kind, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping.trajectory import Trajectory
from stavpr_ros.ros.output import nanoseconds
from stavpr_ros.ros.rclpy_workarounds import ManagedNode

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
_REMEDIES = {
    'RELIABILITY': 'remove qos_overrides.{topic}.subscription.reliability, or make the publisher '
    'reliable',
    'DURABILITY': 'set qos_overrides.{topic}.subscription.durability to volatile, or make the '
    'publisher transient local',
}
ODOMETRY = 'nav_msgs/msg/Odometry'
OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.DURABILITY)
MEMORY = 32  # images that are remembered, so that none is delivered by two subscriptions in turn


def qos_remedy(topic: str, policy: str) -> str:
    """Return the remedy for a publisher with an incompatible quality of service."""
    remedy = _REMEDIES.get(policy, f'make the publisher offer at least the requested {policy}')
    return f'a publisher of {topic} offers another {policy.lower()}: ' + remedy.format(topic=topic)


def subscribe(
    node: Node,
    message_type: type,
    topic: str,
    callback: Callable[..., None],
    qos: QoSProfile,
    *,
    overridable: tuple[QoSPolicyKind, ...] = (*OVERRIDABLE, QoSPolicyKind.RELIABILITY),
    group: CallbackGroup | None = None,
    **events: Callable[[Any], None],
) -> Subscription:
    """
    Subscribe, in a callback group of its own unless one is given; qos_overrides change the QoS.

    :param qos: of the caller; rclpy writes the overrides into it.
    :param events: callbacks of the middleware; those that it does not support are left out.
    :raises SettingsError: invalid qos_overrides.
    """
    group = group or MutuallyExclusiveCallbackGroup()
    while True:
        try:
            return node.create_subscription(
                message_type,
                topic,
                callback,
                qos,
                callback_group=group,
                event_callbacks=SubscriptionEventCallbacks(**events),
                qos_overriding_options=QoSOverridingOptions(overridable),
            )
        except UnsupportedEventTypeError:
            events.popitem()
        except (RuntimeError, ParameterException) as error:
            name = node.resolve_topic_name(topic)
            raise SettingsError(
                f'cannot subscribe to {name}: {error}; correct qos_overrides.{name}.subscription '
                'and start again'
            ) from error


class AdaptiveSubscription:
    """
    A subscription that is reliable when every publisher offers it, and best effort otherwise.

    A reliable one receives nothing of best-effort publishers, and a best-effort one loses large
    images of reliable publishers. The publishers are followed as they come and go: a second
    subscription is made first, and the old one is destroyed when the new one is matched. Without
    a publisher the last choice stays, at first reliable: then no image of a reliable publisher is
    lost before it is discovered. The parameter qos_overrides...reliability takes precedence.

    :param depth: of the queue of the middleware.
    :param callback: called with each image once, in the order of arrival.
    :param on_lost: called with the number of images lost between publisher and subscription.
    :param on_refused: called with the policy of an incompatible publisher.
    :raises SettingsError: invalid qos_overrides.
    """

    def __init__(
        self,
        node: ManagedNode,
        message_type: type,
        topic: str,
        depth: int,
        callback: Callable[[Any], None],
        on_lost: Callable[[int], None],
        on_refused: Callable[[str], None],
    ) -> None:
        self._node, self._type, self._depth = node, message_type, depth
        self._callback, self._on_lost, self._on_refused = callback, on_lost, on_refused
        self.topic = node.resolve_topic_name(topic)
        self._override = f'qos_overrides.{self.topic}.subscription.reliability'
        self.overridden = self._override in node.parameter_overrides
        self._group = MutuallyExclusiveCallbackGroup()
        self._seen: deque[tuple[int, int | None]] = deque(maxlen=MEMORY)
        self._sequence: int | None = None  # number of the last image of the only publisher
        self._publishers = 0  # that are matched
        self._reported = self._missing = self._lost = 0  # images
        self._closed = False
        self._newest = 0  # number of the current subscription
        self._previous: Subscription | None = None  # until the current one is matched
        self._lock = threading.RLock()  # events come on other threads, even before this returns
        with self._lock:
            reliability, self._reason = self._choose(RELIABLE)
            self._current = self._subscribe(reliability)
            self._log()

    @property
    def qos(self) -> QoSProfile:
        """Return the requested quality of service."""
        return self._current.qos_profile

    @property
    def choice(self) -> str:
        """Return the reliability in use, and the reason."""
        return f'{self.qos.reliability.name.lower().replace("_", " ")}, {self._reason}'

    @property
    def loss_remedy(self) -> str:
        """Return the first remedy for lost images."""
        if self.qos.reliability == RELIABLE:
            return 'give the publisher more shared memory'
        if self.overridden:
            return f'remove {self._override}'
        return 'make the camera driver (the publisher) reliable, or give it more shared memory'

    def follow(self) -> None:
        """Choose again; also called regularly, as an event may come before the publisher."""
        with self._lock:
            if self._closed or self._previous is not None:
                return
            before = self._reason
            reliability, self._reason = self._choose(self.qos.reliability)
            if reliability != self.qos.reliability:
                self._previous, self._current = self._current, self._subscribe(reliability)
            if before != self._reason:
                self._log()

    def close(self) -> None:
        """Unsubscribe."""
        with self._lock:
            self._closed = True
            self._finish_switch()
            self._node.destroy_subscription(self._current)

    def _choose(self, now: ReliabilityPolicy) -> tuple[ReliabilityPolicy, str]:
        """Return the reliability for the publishers that are known, and the reason."""
        if self.overridden:
            return now, f'set by {self._override}'
        infos = self._node.get_publishers_info_by_topic(self.topic)
        refusing = sum(info.qos_profile.reliability != RELIABLE for info in infos)
        if not infos:
            return now, 'no publisher is known'
        if refusing:
            return BEST_EFFORT, f'{refusing} of {len(infos)} publishers are best effort'
        return RELIABLE, 'every publisher offers it'

    def _log(self) -> None:
        self._node.get_logger().info(f'subscription to {self.topic}: {self.choice}')

    def _subscribe(self, reliability: ReliabilityPolicy) -> Subscription:
        self._newest += 1
        number = self._newest  # of this subscription
        extra = (QoSPolicyKind.RELIABILITY,) if self.overridden else ()
        return subscribe(
            self._node,
            self._type,
            self.topic,
            lambda message, info: self._on_message(number, message, info),
            QoSProfile(depth=self._depth, reliability=reliability),
            overridable=(*OVERRIDABLE, *extra),
            group=self._group,
            incompatible_qos=lambda event: self._on_incompatible(number, event),
            matched=lambda event: self._on_matched(number, event),
            message_lost=self._on_message_lost,
        )

    def _on_message(self, number: int, message: Any, info: Any) -> None:
        with self._lock:
            if number == self._newest:
                self._finish_switch()
            if not self._closed:
                self._deliver(message, info)

    def _on_matched(self, number: int, event: Any) -> None:
        with self._lock:
            if number == self._newest:
                self._finish_switch()
                self._publishers = event.current_count
                if event.current_count_change < 0:
                    self._sequence = None
                    self._reported = self._missing = self._lost
            self.follow()

    def _on_incompatible(self, number: int, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        with self._lock:
            if number == self._newest:
                self._finish_switch()
            self.follow()
        if policy != 'RELIABILITY' or self.overridden:
            self._on_refused(policy)

    def _on_message_lost(self, event: Any) -> None:
        with self._lock:
            self._reported += event.total_count_change
            self._count_lost()

    def _count_lost(self) -> None:
        """
        Call back with new losses: reported by the middleware, or missing in the sequence.

        Neither has all: the middleware does not report images that another one displaced in a
        queue, and the sequence has no end.
        """
        lost = max(self._reported, self._missing)
        if lost > self._lost:
            self._on_lost(lost - self._lost)
            self._lost = lost

    def _finish_switch(self) -> None:
        """Deliver what the previous subscription has received, and destroy it."""
        previous, self._previous = self._previous, None
        if previous is None:
            return
        with previous.handle:
            while not self._closed and (
                taken := previous.handle.take_message(previous.msg_type, False)
            ):
                self._deliver(*taken)
        self._node.destroy_subscription(previous)

    def _deliver(self, message: Any, info: Any) -> None:
        """Call back with an image, unless it was; count those between it and the last one."""
        written, sequence = info['source_timestamp'], info['publication_sequence_number']
        if written and (written, sequence) in self._seen:
            return
        self._seen.append((written, sequence))
        # the numbers of several publishers are mixed
        before = self._sequence if self._publishers == 1 else None
        self._sequence = sequence if self._publishers == 1 else None
        if before is not None and sequence is not None and sequence > before:
            self._missing += sequence - before - 1
            self._count_lost()
        self._callback(message)


def misdirected(node: Node, topic: str) -> str:
    """
    Return why no odometry can arrive on a topic; empty if it can, or if there is none anywhere.

    Odometry beside a topic ``map_to_odom`` is that of a pose graph: its corrections, made from the
    loop closures, must not come back as odometry.

    :param topic: after remapping.
    """
    publishers = node.get_publishers_info_by_topic(topic)
    types = sorted({info.topic_type for info in publishers})
    if ODOMETRY in types:
        return ''
    found = f'{", ".join(types)} is published' if types else 'nothing is published'
    topics = dict(node.get_topic_names_and_types())
    others = [
        name
        for name, kinds in topics.items()
        if ODOMETRY in kinds
        and node.count_publishers(name)
        and f'{name.rpartition("/")[0]}/map_to_odom' not in topics
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
        qos = QoSProfile(depth=50, reliability=BEST_EFFORT)
        self._subscription = subscribe(node, Odometry, 'odom', self._on_odometry, qos)

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
