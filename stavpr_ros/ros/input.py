# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The subscriptions: images, raw or compressed, and odometry."""

from collections.abc import Callable
import threading
import time
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import (
    qos_check_compatible,
    qos_policy_name_from_kind,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping.trajectory import Trajectory
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.stamps import StampWatch
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.ros.messages import nanoseconds, odometry_pose

_REMEDIES = {
    'RELIABILITY': 'set qos_overrides.{topic}.subscription.reliability to best_effort, or make '
    'the publisher reliable',
    'DURABILITY': 'set qos_overrides.{topic}.subscription.durability to volatile, or make the '
    'publisher transient local',
}
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


def _subscribe(
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


class ImageInput:
    """
    The subscription to images.

    :param node: its node.
    :param settings: transport, maximum rate, and the longest gap of stamps.
    :param statistics: counts images, gaps, jumps and losses.
    :param enqueue: called with a message and its time of arrival, seconds.
    :param reject: called with a message that exceeds ``max_rate``, and the reason.
    :param restart: called with the reason when the next images do not continue those before.

    ``topic`` is the resolved topic, ``remedy`` the remedy for the last incompatible publisher, ''
    = none.
    """

    def __init__(
        self,
        node: Node,
        settings: NodeSettings,
        statistics: Statistics,
        enqueue: Callable[[Any, float], None],
        reject: Callable[[Any, str], None],
        restart: Callable[[str], None],
    ) -> None:
        self._node, self._statistics = node, statistics
        self._enqueue, self._reject, self._restart = enqueue, reject, restart
        self.stamps = StampWatch(settings.max_stamp_gap)
        self.max_rate = settings.max_rate
        self.remedy = ''
        self._last: float | None = None  # seconds, of the last image within the rate
        self._lock = threading.Lock()  # close() waits for the image of another thread
        self._closed = False
        # as in image_transport, the compressed topic is below the one that `image` is remapped to
        compressed = node.resolve_topic_name('image') + '/compressed'
        kinds = {'raw': (Image, 'image'), 'compressed': (CompressedImage, compressed)}
        message_type, name = kinds[settings.image_transport]
        self._type = f'sensor_msgs/msg/{message_type.__name__}'
        self.topic = node.resolve_topic_name(name)  # before events, which come on another thread
        self._subscription = self._subscribe(message_type, name)

    @property
    def publishers(self) -> int:
        """Number of publishers of the topic, compatible or not."""
        return self._node.count_publishers(self.topic)

    @property
    def incompatible(self) -> int:
        """Number of publishers of the topic with an incompatible QoS."""
        requested = self._subscription.qos_profile
        return sum(
            qos_check_compatible(info.qos_profile, requested)[0] == QoSCompatibility.ERROR
            for info in self._node.get_publishers_info_by_topic(self.topic)
            if info.topic_type == self._type
        )

    @property
    def mistyped(self) -> str:
        """Other message types on the topic, which the middleware does not report."""
        infos = self._node.get_publishers_info_by_topic(self.topic)
        return ', '.join(sorted({info.topic_type for info in infos} - {self._type}))

    def close(self) -> None:
        """Unsubscribe from images, including one that another thread has just taken."""
        with self._lock:
            self._closed = True
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, message_type: type, topic: str) -> Subscription:
        events = {'incompatible_qos': self._on_incompatible, 'message_lost': self._on_lost}
        try:
            return _subscribe(self._node, message_type, topic, self.on_image, 5, **events)
        except UnsupportedEventTypeError:  # not every middleware reports lost messages
            del events['message_lost']
            return _subscribe(self._node, message_type, topic, self.on_image, 5, **events)

    def _on_incompatible(self, event: Any) -> None:
        self.remedy = qos_remedy(self.topic, qos_policy_name_from_kind(event.last_policy_kind))
        self._node.get_logger().error(f'images are not received: {self.remedy}')

    def _on_lost(self, event: Any) -> None:
        self._statistics.dropped('lost in transport', event.total_count_change)

    def on_image(self, message: Any) -> None:
        """Enqueue an image, or reject it for its rate; the callback of the subscription."""
        with self._lock:
            if self._closed:
                return
            arrival = time.monotonic()
            self._statistics.received()
            stamp = nanoseconds(message.header.stamp)
            self._check_stamp(stamp)
            if reason := self._exceeds_rate(stamp, arrival):
                self._reject(message, reason)
            else:
                self._enqueue(message, arrival)

    def _check_stamp(self, stamp: int) -> None:
        """Count gaps of the stamps; restart after a jump back."""
        event = self.stamps.see(stamp)
        if event is not None and event.kind == 'gap':
            self._statistics.gap(event.seconds)
        elif event is not None:
            self._statistics.jump_back(event.seconds)
            self._last = None
            self._restart(f'the stamps of the images jumped back by {event.seconds:.3f} s')

    def _exceeds_rate(self, stamp: int, arrival: float) -> str:
        """Return why an image exceeds ``max_rate``, by stamps, or by arrival without them."""
        if not self.max_rate:
            return ''
        now, last = stamp / 1e9 if stamp else arrival, self._last
        # a tolerance of a tenth of the period: a camera of exactly this rate has jitter; an image
        # that was overtaken in transport, and has an earlier stamp, must not restart the count
        if last is not None and abs(now - last) < 0.9 / self.max_rate:
            return (
                f'{now - last:.3f} s after the last image: exceeds max_rate = {self.max_rate:g} Hz'
            )
        self._last = now
        return ''


class OdometryInput:
    """
    The subscription to odometry, on the topic ``odom``.

    :param timeout: seconds for which the newest pose is valid.

    ``frame`` is the frame of the poses.
    """

    def __init__(self, node: Node, timeout: float) -> None:
        self.trajectory = Trajectory(timeout)
        self._node, self._timeout = node, timeout
        self._arrived: float | None = None
        self.frame = ''
        self._subscription = _subscribe(node, Odometry, 'odom', self._on_odometry, 50)

    def freshness(self) -> str:
        """Return ``fresh``, ``stale`` or ``never``, for the diagnostics."""
        if self._arrived is None:
            return 'never'
        return 'fresh' if time.monotonic() - self._arrived < max(2.0, self._timeout) else 'stale'

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
        self._arrived, self.frame = time.monotonic(), message.header.frame_id
