# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The subscription to images, as reliable as possible: stamps, rate and losses."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
import threading
import time
from typing import Any

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
from stavpr_ros.errors import ImageError, SettingsError, UnavailableError
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.statistics import StampWatch, Statistics
from stavpr_ros.ros.messages import message_class, nanoseconds
from stavpr_ros.ros.parameters import transport_remedy, TRANSPORTS
from stavpr_ros.ros.rclpy_workarounds import ManagedNode, ReceivedGroup, Receiver
from stavpr_ros.sources.oddities import source_of, StreamWatch
from stavpr_ros.sources.video_topic import is_packet, VideoImage, VideoStream
from stavpr_ros.units import SECOND
from std_msgs.msg import Header

QUEUE, PACKETS = 10, 100  # images, packets of video, in the middleware while the executor is busy
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
_REMEDIES = {
    'RELIABILITY': 'remove qos_overrides.{topic}.subscription.reliability, or make the publisher '
    'reliable',
    'DURABILITY': 'set qos_overrides.{topic}.subscription.durability to volatile, or make the '
    'publisher transient local',
}
OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.DURABILITY)
MEMORY = 32  # images that are remembered, so that none is delivered by two subscriptions in turn


@dataclass(frozen=True)
class InputStatus:
    """The topic of the images and its publishers."""

    topic: str = ''  # after remapping
    publishers: int = 0  # of any QoS and type
    incompatible: int = 0  # not received because of their QoS
    mistyped: str = ''  # other message types on the topic
    remedy: str = ''  # for incompatible publishers, or publishers of the other transport
    loss_remedy: str = ''  # for lost images
    reliability: str = ''  # of the subscription, with the reason


class ImageInput:
    """
    The subscription to images.

    :param settings: transport, maximum rate, and the longest gap of stamps.
    :param statistics: counts images, gaps, jumps and losses.
    :param enqueue: called with a message and its time of arrival, seconds.
    :param reject: called with a message that exceeds ``max_rate``, and the reason.
    :param restart: called with the reason when the next images do not continue those before.

    ``topic`` is the resolved topic, ``remedy`` that for the last refused publisher, '' = none.
    """

    def __init__(
        self,
        node: ManagedNode,
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
        self._watch = StreamWatch()
        self._last: float | None = None  # seconds, of the last image within the rate
        self._lock = threading.Lock()  # close() waits for the image of another thread
        self._closed = False
        self._type, ending = TRANSPORTS[settings.image_transport]
        self._is_video = self._type not in (TRANSPORTS['raw'][0], TRANSPORTS['compressed'][0])
        self._video = VideoStream() if self._is_video else None
        self._lost = self._counted = 0  # images between publisher and subscription; in statistics
        # as in image_transport, other topics are below the one that `image` is remapped to
        name = node.resolve_topic_name('image') + ending if ending else 'image'
        self.topic = node.resolve_topic_name(name)  # before events, which come on another thread
        self._subscription = AdaptiveSubscription(
            node,
            message_class(self._type),
            name,
            PACKETS if self._is_video else QUEUE,
            self.on_image,
            self._on_lost,
            self._on_refused,
        )

    def status(self) -> InputStatus:
        """Return the topic and its publishers, for the diagnostics."""
        subscription = self._subscription
        subscription.follow()
        infos = self._node.get_publishers_info_by_topic(self.topic)
        incompatible = sum(
            qos_check_compatible(info.qos_profile, subscription.qos)[0] == QoSCompatibility.ERROR
            for info in infos
            if info.topic_type == self._type
        )
        # the middleware does not report other types
        mistyped = ', '.join(sorted({info.topic_type for info in infos} - {self._type}))
        return InputStatus(
            self.topic,
            len(infos),
            incompatible,
            mistyped,
            self.remedy or ('' if infos else transport_remedy(self._node, self.topic)),
            subscription.loss_remedy,
            subscription.choice,
        )

    def oddities(self) -> list[str]:
        """Return what is odd about the last images, for the diagnostics."""
        infos = self._node.get_publishers_info_by_topic(self.topic)
        count = sum(info.topic_type == self._type for info in infos)
        text = f'images of {count} publishers are mixed on {self.topic}: a topic for each'
        return [text] * (count > 1) + self._watch.oddities(has_epoch=False)

    def close(self) -> None:
        """Unsubscribe from images, including one that another thread has just taken."""
        with self._lock:
            self._closed = True
        self._subscription.close()

    def _on_refused(self, policy: str) -> None:
        remedy = _REMEDIES.get(policy, f'make the publisher offer at least the requested {policy}')
        offer = f'a publisher of {self.topic} offers another {policy.lower()}'
        self.remedy = f'{offer}: {remedy.format(topic=self.topic)}'
        self._node.get_logger().error(f'images are not received: {self.remedy}')

    def _on_lost(self, count: int) -> None:
        self._lost += count
        if self._video is not None:
            self._video.interrupt()
        self._count_lost()

    def _count_lost(self) -> None:
        """Count lost images: the middleware and the publisher's numbers may each miss one."""
        lost = max(self._lost, self._video.lost if self._video else 0)
        if lost > self._counted:
            self._statistics.add_drop('lost in transport', lost - self._counted)
            self._counted = lost

    def on_image(self, message: Any) -> None:
        """Enqueue an image, or reject it for its rate; the callback of the subscription."""
        with self._lock:
            if self._closed:
                return
            arrival = time.monotonic()
            self._statistics.add_image()
            message = self._decode(message)
            stamp = nanoseconds(message.header.stamp)
            self._watch.add(stamp, round(arrival * SECOND), source_of(message))
            ahead, missing = self.stamps.update(stamp)
            self._statistics.add_stamp_jump(ahead, missing)
            if ahead < 0:
                self._last = None
                self._restart(f'the stamps of the images jumped back by {-ahead:.3f} s')
            if reason := self._exceeds_rate(stamp, arrival):
                self._reject(message, reason)
            else:
                self._enqueue(message, arrival)

    def _decode(self, message: Any) -> Any:
        """Return the image of a packet of video, on which later ones depend; else the message."""
        if not (self._is_video or is_packet(message)):
            return message
        try:
            self._video = self._video or VideoStream()
        except UnavailableError as error:  # PyAV is missing, and the format came as a surprise
            return VideoImage(message.header, ImageError(str(error), kind='encoding'), lambda _: _)
        image = self._video.read(message, Header)
        self._count_lost()
        return image

    def _exceeds_rate(self, stamp: int, arrival: float) -> str:
        """Return why an image exceeds ``max_rate``, by stamps, or by arrival without them."""
        if not self.max_rate:
            return ''
        now, last = stamp / SECOND if stamp else arrival, self._last
        # a tolerance of a tenth of the period: a camera of exactly this rate has jitter; an image
        # that was overtaken in transport, and has an earlier stamp, must not restart the count
        if last is not None and abs(now - last) < 0.9 / self.max_rate:
            return (
                f'{now - last:.3f} s after the last image: exceeds max_rate = {self.max_rate:g} Hz'
            )
        self._last = now
        return ''


def subscribe(
    node: Node,
    message_type: type,
    topic: str,
    callback: Callable[..., None],
    qos: QoSProfile,
    *,
    overridable: tuple[QoSPolicyKind, ...] = (*OVERRIDABLE, QoSPolicyKind.RELIABILITY),
    **events: Callable[[Any], None],
) -> Subscription:
    """
    Subscribe, and call back on a thread of this subscription; qos_overrides change the QoS.

    :param qos: of the caller; rclpy writes the overrides into it.
    :param events: callbacks of the middleware; those that it does not support are left out.
    :raises SettingsError: invalid qos_overrides.
    """
    while True:
        try:
            subscription = node.create_subscription(
                message_type,
                topic,
                callback,
                qos,
                callback_group=ReceivedGroup(),
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
        else:
            Receiver(subscription, node.context)
            return subscription


class AdaptiveSubscription:
    """
    A subscription that is reliable when every publisher offers it, and best effort otherwise.

    A reliable one receives nothing of best-effort publishers, and a best-effort one loses large
    images of reliable publishers. The old subscription is destroyed when the new one is matched.
    Without a publisher the last choice stays, at first reliable: see docs/node_guide.md.

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
        count = max(self._reported, self._missing)
        if count > self._lost:
            self._on_lost(count - self._lost)
            self._lost = count

    def _finish_switch(self) -> None:
        """Deliver the remaining images of the previous subscription, and destroy it."""
        previous, self._previous = self._previous, None
        if previous is None:
            return
        with previous.handle:
            while not self._closed and (
                message := previous.handle.take_message(previous.msg_type, False)
            ):
                self._deliver(*message)
        self._node.destroy_subscription(previous)

    def _deliver(self, message: Any, info: Any) -> None:
        """Call back with an image, unless it was; count those between it and the last one."""
        stamp, sequence = info['source_timestamp'], info['publication_sequence_number']
        if stamp and (stamp, sequence) in self._seen:
            return
        self._seen.append((stamp, sequence))
        # the numbers of several publishers are mixed
        before = self._sequence if self._publishers == 1 else None
        self._sequence = sequence if self._publishers == 1 else None
        if before is not None and sequence is not None and sequence > before:
            self._missing += sequence - before - 1
            self._count_lost()
        self._callback(message)
