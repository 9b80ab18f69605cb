"""What the node hears: images, raw or compressed, and odometry; what goes wrong with either is counted."""

import threading
import time
from collections.abc import Callable
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import (
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CompressedImage, Image

from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping.trajectory import Trajectory
from stavpr_ros.pipeline.stamps import StampWatch
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.ros.messages import nanoseconds, odometry_pose

_REMEDIES = {
    'RELIABILITY': 'set qos_overrides.{topic}.subscription.reliability to best_effort, or make the publisher '
    'reliable',
    'DURABILITY': 'set qos_overrides.{topic}.subscription.durability to volatile, or make the publisher '
    'transient local',
}
OVERRIDABLE = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)


def qos_remedy(topic: str, policy: str) -> str:
    """Say in words what to do about a publisher whose quality of service this node does not accept."""
    remedy = _REMEDIES.get(policy, f'make the publisher offer at least what the node asks for ({policy})')
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
    Subscribe as to sensor data, in a callback group of its own; qos_overrides change it.

    :raises SettingsError: qos_overrides that do not do.
    """
    try:
        return node.create_subscription(
            message_type,
            topic,
            callback,
            # not qos_profile_sensor_data, which is like this: rclpy writes overrides into what it is given
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
            f'cannot subscribe to {name}: {error}; correct qos_overrides.{name}.subscription and start again'
        ) from error


class ImageInput:
    """
    The subscription of images.

    :param node: its node.
    :param transport: ``raw`` or ``compressed``.
    :param hand_over: called with a message and the time of its arrival, seconds.
    :param skip: called with a message that comes faster than ``max_rate``, and the reason.
    :param restart: called with the reason when the images that come now do not follow those before.

    ``topic`` is its topic, resolved.
    """

    def __init__(
        self,
        node: Node,
        transport: str,
        statistics: Statistics,
        hand_over: Callable[[Any, float], None],
        skip: Callable[[Any, str], None],
        restart: Callable[[str], None],
        max_stamp_gap: float,
        max_rate: float,
    ) -> None:
        self._node, self._statistics = node, statistics
        self._hand_over, self._skip, self._restart = hand_over, skip, restart
        self.stamps = StampWatch(max_stamp_gap)
        self.max_rate = max_rate
        self.remedy = ''
        self._last: float | None = None  # seconds, of the last image handed over
        self._lock = threading.Lock()  # an image is handed over whole before this is closed, or not at all
        self._closed = False
        # as image_transport has it, the compressed topic follows where `image` is remapped to
        compressed = node.resolve_topic_name('image') + '/compressed'
        kinds = {'raw': (Image, 'image'), 'compressed': (CompressedImage, compressed)}
        message_type, name = kinds[transport]
        self._type = f'sensor_msgs/msg/{message_type.__name__}'
        self.topic = node.resolve_topic_name(name)  # events, on another thread, may ask for it at once
        self._subscription = self._subscribe(message_type, name)

    @property
    def publishers(self) -> int:
        """Publishers of the topic, whether they are heard or not."""
        return self._node.count_publishers(self.topic)

    @property
    def incompatible(self) -> int:
        """Publishers of the topic that are not heard because of their QoS."""
        asked, infos = self._subscription.qos_profile, self._node.get_publishers_info_by_topic(self.topic)
        statuses = (
            qos_check_compatible(info.qos_profile, asked)[0]
            for info in infos
            if info.topic_type == self._type
        )
        return sum(status == QoSCompatibility.ERROR for status in statuses)

    @property
    def mistyped(self) -> str:
        """Other types than ours that are published on the topic; the middleware does not tell of them."""
        infos = self._node.get_publishers_info_by_topic(self.topic)
        return ', '.join(sorted({info.topic_type for info in infos} - {self._type}))

    def close(self) -> None:
        """Hear nothing more, not even what is on another thread now."""
        with self._lock:
            self._closed = True
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, message_type: type, topic: str) -> Subscription:
        events = {'incompatible_qos': self._on_incompatible, 'message_lost': self._on_lost}
        try:
            return _subscribe(self._node, message_type, topic, self._on_image, 5, **events)
        except UnsupportedEventTypeError:  # not every middleware tells of lost messages
            del events['message_lost']
            return _subscribe(self._node, message_type, topic, self._on_image, 5, **events)

    def _on_incompatible(self, event: Any) -> None:
        self.remedy = qos_remedy(self.topic, qos_policy_name_from_kind(event.last_policy_kind))
        self._node.get_logger().error(f'images are not heard: {self.remedy}')

    def _on_lost(self, event: Any) -> None:
        self._statistics.dropped('lost in transport', event.total_count_change)

    def _on_image(self, message: Any) -> None:
        with self._lock:
            if not self._closed:
                self._take(message)

    def _take(self, message: Any) -> None:
        arrival = time.monotonic()
        self._statistics.received()
        stamp = nanoseconds(message.header.stamp)
        event = self.stamps.see(stamp)
        if event is not None and event.kind == 'gap':
            self._statistics.gap(event.seconds)
        elif event is not None:
            self._statistics.jump_back(event.seconds)
            self._last = None
            self._restart(f'the stamps of the images jumped back by {event.seconds:.3f} s')
        if reason := self._too_fast(stamp, arrival):
            self._skip(message, reason)
        else:
            self._hand_over(message, arrival)

    def _too_fast(self, stamp: int, arrival: float) -> str:
        """Say why an image is skipped for ``max_rate``; by stamps, or by arrival where there are none."""
        if not self.max_rate:
            return ''
        now, last = stamp / 1e9 if stamp else arrival, self._last
        # a tenth of the period is forgiven: a camera of exactly this rate jitters; and an image that was
        # overtaken on its way, so that it lies before the last one, is no reason to start counting anew
        if last is not None and abs(now - last) < 0.9 / self.max_rate:
            return f'{now - last:.3f} s after the last image: faster than max_rate = {self.max_rate:g} Hz'
        self._last = now
        return ''


class OdometryInput:
    """
    The subscription of odometry, on the topic ``odom``.

    :param patience: seconds for which the newest pose holds.
    """

    def __init__(self, node: Node, patience: float) -> None:
        self.trajectory = Trajectory(patience)
        self._node, self._patience = node, patience
        self._arrived: float | None = None
        self.frame = ''  # that its poses are in
        self.subscription = _subscribe(node, Odometry, 'odom', self._on_odometry, 50)

    def freshness(self) -> str:
        """Return ``fresh``, ``stale`` or ``never``, as the diagnostics tell it."""
        if self._arrived is None:
            return 'never'
        return 'fresh' if time.monotonic() - self._arrived < max(2.0, self._patience) else 'stale'

    def close(self) -> None:
        """Hear nothing more."""
        self._node.destroy_subscription(self.subscription)

    def _on_odometry(self, message: Odometry) -> None:
        try:
            self.trajectory.add(nanoseconds(message.header.stamp), odometry_pose(message))
        except InputError as error:
            self._node.get_logger().warning(f'odometry ignored: {error}', throttle_duration_sec=10.0)
            return
        self._arrived, self.frame = time.monotonic(), message.header.frame_id
