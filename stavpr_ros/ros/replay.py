# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes the records of a bag at a pace, or each image after the result of the last one."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
import math
import time
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.messages import message_class, record_message, time_message
from stavpr_ros.ros.process import Discovery
from stavpr_ros.ros.subscriber_progress import READY, RECORDER, SubscriberProgress
from stavpr_ros.signals import signals_deferred
from stavpr_ros.sources.frame import ImageRecord, MessageRecord, RecordedTopic
from stavpr_ros.units import SECOND
from std_srvs.srv import Trigger

SIGNAL_POLL = 0.1  # seconds until a signal is noticed
TRIES = 3  # how often one image is sent
RELIABLE_QOS = QoSProfile(depth=30, reliability=ReliabilityPolicy.RELIABLE)
OTHERS_DEPTH = 1000  # messages of one topic between two images


class NoSubscriberError(StavprError):
    """No subscriber, or no node that publishes results, was discovered in time."""


class NoResultError(StavprError):
    """A published image got neither a result nor an acknowledgment in time."""


@dataclass(frozen=True)
class ReplayOptions:
    """
    How records are published.

    :param rate: factor on the recorded pace, above 0; without effect with ``lossless``.
    :param lossless: publish the next image after the result of the last one on ``stavpr/match``.
    :param timeout: seconds without a result after which an image is sent again.
    :param wait: seconds to wait for subscribers; None = no limit.
    :param paused: wait for a step before the first image.
    :param clock: messages per second on ``/clock``, 0 = none.
    """

    rate: float = 1.0
    lossless: bool = False
    timeout: float = 20.0
    wait: float | None = None
    paused: bool = False
    clock: float = 0.0


class Playback:
    """
    Maps the time of recording to the time of this machine; it can be paused and stepped.

    :param rate: recorded seconds per second, above 0; None = items are due at once, and the last
        item determines the time.
    :param steady: returns seconds; replaced in tests.
    """

    def __init__(
        self, rate: float | None, paused: bool, steady: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate, self._steady = rate, steady
        self.paused = paused
        self._steps = 0
        self._position: int | None = None  # recorded time at the anchor, ns
        self._anchor = 0.0

    def start(self, time_ns: int) -> None:
        """Start at a recorded time, or start again."""
        self._position, self._anchor = time_ns, self._steady()

    @property
    def is_started(self) -> bool:
        """Whether :meth:`start` was called."""
        return self._position is not None

    def now_ns(self) -> int:
        """Return the recorded time, ns; 0 before the start."""
        if self._position is None:
            return 0
        if self.paused or self._rate is None:
            return self._position
        return self._position + round((self._steady() - self._anchor) * self._rate * SECOND)

    def seconds_until(self, time_ns: int) -> float:
        """Return the seconds until an item of a recorded time is due; inf while paused."""
        if self.paused:
            return 0.0 if self._steps else math.inf
        return 0.0 if self._rate is None else (time_ns - self.now_ns()) / SECOND / self._rate

    def note_published(self, time_ns: int, is_step: bool) -> None:
        """Note that an item was published; while paused, time follows the items."""
        if self.paused or self._rate is None:
            self._position = max(self._position or 0, time_ns)
        if is_step and self._steps:
            self._steps -= 1

    def pause(self, paused: bool) -> None:
        """Pause, or resume."""
        if self._position is not None:
            self._position, self._anchor = self.now_ns(), self._steady()
        self.paused, self._steps = paused, 0

    def step(self) -> bool:
        """Make the items up to the next image due; return whether it is paused, as it must be."""
        self._steps += self.paused
        return self.paused


class Replayer:
    """
    Publishes images on the topic ``image`` of a node, which it spins, and other messages.

    :param node: for the publishers, the services and the subscription of the results.
    :param notify: called with messages for the user: waiting for a subscriber, an image sent
        again.
    :param topics: further topics, topic of the bag to topic of ROS.
    :raises UnavailableError: a message type is not installed.
    """

    def __init__(
        self,
        node: Node,
        notify: Callable[[str], None],
        options: ReplayOptions,
        topics: Mapping[RecordedTopic, str],
    ) -> None:
        self.node, self.notify, self.options = node, notify, options
        self.published = self.resent = self.dropped = 0
        self.publisher = node.create_publisher(Image, 'image', RELIABLE_QOS)
        self.progress = SubscriberProgress(node)
        self._others = {topic.name: self._publish_on(topic, to) for topic, to in topics.items()}
        self._match_topic = node.resolve_topic_name('stavpr/match')
        self.playback = Playback(None if options.lossless else options.rate, options.paused)
        self._serve()
        self._clock: Publisher | None = None
        if options.clock:
            self._clock = node.create_publisher(ClockMessage, '/clock', RELIABLE_QOS)
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            node.create_timer(1 / options.clock, self._publish_clock, clock=steady)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._discovery = Discovery(node, self._endpoints, options.timeout)

    @property
    def topics(self) -> Collection[str]:
        """Return the topics of the bag that are published beside the images."""
        return self._others.keys()

    def wait_for_subscribers(self) -> None:
        """
        Wait until the first image, and if lossless its result, will be received.

        :raises NoSubscriberError: not within ``wait`` seconds.
        """
        last_notice = ''

        def complete() -> bool:
            nonlocal last_notice
            missing = self._missing()
            if missing not in ('', last_notice):
                self.notify(f'waiting for {missing}')
                last_notice = missing
            return not missing

        for _ in range(2):  # a recorder may be discovered with the others
            if self._spin_until(complete, self.options.wait):
                self._wait_for_discovery()
                continue
            raise NoSubscriberError(
                f'waited {self.options.wait:g} s for {self._missing()}: expected a running node; '
                'start it, compare the topics (`ros2 topic list`) and ROS_DOMAIN_ID, or wait '
                'longer (--wait)'
            )
        if self.options.lossless:
            self._spin_until(self.progress.knows_operation, self.options.timeout)

    def play(self, records: Iterable[ImageRecord | MessageRecord]) -> None:
        """
        Publish each record when it is due; if lossless, an image after the last one's result.

        :raises NoResultError: lossless, and no result after all tries.
        """
        for i, record in enumerate(records):
            if i == 0:
                self.playback.start(record.time_ns)
            self._send(record)

    def _send(self, record: ImageRecord | MessageRecord) -> None:
        is_image = isinstance(record, ImageRecord)
        if is_image:
            self._spin_once(0.0)  # also while late: pause is served
        self._wait_until_due(record.time_ns)
        self.playback.note_published(record.time_ns, is_image)
        self._publish_clock()
        if isinstance(record, MessageRecord):
            self._others[record.topic].publish(record.content)
            return
        message = record_message(record)
        self.progress.count_sent(message.header)
        if self.options.lossless:
            self._send_until_answered(message)
        else:
            self.publisher.publish(message)
        self.published += 1

    def finish(self) -> None:
        """
        Wait until the last images have arrived, so that the node may be destroyed.

        :raises NoResultError: a reliable subscriber has not acknowledged them in time.
        """
        timeout = self.options.timeout
        if not self._spin_until(
            lambda: all(p.wait_for_all_acked(Duration()) for p in self._publishers), timeout
        ):
            raise NoResultError(
                f'the last images on {self.publisher.topic_name} are not acknowledged after '
                f'{timeout:g} s: expected reliable subscribers to take them; check for a busy one'
            )
        # best-effort subscribers acknowledge nothing: a response to a later request proves it
        self._wait_for_discovery()
        self._spin_until(self.progress.is_settled, None)

    def close(self) -> None:
        """Release the node; the caller destroys it."""
        self._executor.shutdown()

    def _spin_until(self, is_done: Callable[[], bool], seconds: float | None) -> bool:
        """Spin until ``is_done`` returns True; return False when the time is over."""
        end = math.inf if seconds is None else time.monotonic() + seconds
        while not is_done():
            rest = end - time.monotonic()
            if rest <= 0:
                return False
            self._spin_once(rest)
        return True

    def _spin_once(self, seconds: float) -> None:
        """Serve one callback, or wait for one at most so long."""
        with signals_deferred():
            self._executor.spin_once(timeout_sec=min(seconds, SIGNAL_POLL))

    def _missing(self) -> str:
        """Return the endpoint that is not discovered yet; empty = none."""
        if not self.publisher.get_subscription_count():
            return f'a subscriber of {self.publisher.topic_name}'
        if self.options.lossless and not self.node.count_publishers(self._match_topic):
            return f'a publisher of {self._match_topic}'
        return self._unready_recorder() if self.options.lossless else ''

    def _unready_recorder(self) -> str:
        """Return the recorder that would still miss matches; empty = none."""
        for info in self.node.get_subscriptions_info_by_topic(self._match_topic):
            name = f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            if info.node_name == RECORDER and not self.node.count_publishers(f'{name}/{READY}'):
                return f'{name} to be ready'
        return ''

    def _wait_for_discovery(self) -> None:
        """Wait until the others have discovered us: best-effort ones lose earlier images."""
        self._discovery.restart()
        self._spin_until(self._discovery.done, None)

    def _endpoints(self) -> list[Any]:
        """Return the subscriptions to our topics and the publishers of results."""
        endpoints = [
            info
            for publisher in self._publishers
            for info in self.node.get_subscriptions_info_by_topic(publisher.topic_name)
        ]
        if self.options.lossless:
            endpoints += self.node.get_publishers_info_by_topic(self._match_topic)
        return endpoints

    def _wait_until_due(self, time_ns: int) -> None:
        has_notified = False
        while (seconds := self.playback.seconds_until(time_ns)) > 0:
            if 10 < seconds < math.inf and not has_notified:
                self.notify(f'the next image is due in {seconds:.0f} s, as recorded (see --rate)')
                has_notified = True
            self._spin_once(seconds)

    def _send_until_answered(self, message: Image) -> None:
        """
        Send an image and wait for a result with its header, and for loop closures far behind.

        Headers may all be equal (stamps of 0), so only one image is outstanding. An image sent
        again to a slow node has two results; with an equal header the second counts for the next
        image.
        """
        stamp, timeout = message.header.stamp, self.options.timeout
        name = f'image {self.published + 1} (stamp {stamp.sec}.{stamp.nanosec:09d})'
        for attempt in range(TRIES):
            if attempt:
                self.resent += 1
                self.notify(f'{name}: no result for {timeout:g} s, sent again (try {attempt + 1})')
            self.publisher.publish(message)
            if self._spin_until(self.progress.is_complete, timeout):
                follow = self.progress.keeps_up
                self.progress.expects_closures &= self._spin_until(follow, timeout)
                break
        else:
            raise NoResultError(
                f'{name} got no result on {self._match_topic} in {TRIES} tries of '
                f'{timeout:g} s: expected one message per image; check that the node runs and '
                f'subscribes to {self.publisher.topic_name}, or give a slow one a longer --timeout'
            )
        if self.progress.status == PlaceMatch.DROPPED:
            self.dropped += 1
            self.notify(
                f'image {self.published + 1} was dropped by the node: check for another publisher'
            )

    @property
    def _publishers(self) -> list[Publisher]:
        return [self.publisher, *self._others.values()]

    def _publish_on(self, topic: RecordedTopic, name: str) -> Publisher:
        profile = QoSProfile(depth=OTHERS_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        if topic.latched:
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        return self.node.create_publisher(message_class(topic.message_type), name, profile)

    def _publish_clock(self) -> None:
        if self._clock is not None and self.playback.is_started:
            self._clock.publish(ClockMessage(clock=time_message(self.playback.now_ns())))

    def _serve(self) -> None:
        """Serve the services of ``ros2 bag play``, by the same names."""
        playback = self.playback
        for name, act in (
            ('pause', lambda: playback.pause(True)),
            ('resume', lambda: playback.pause(False)),
            ('toggle_paused', lambda: playback.pause(not playback.paused)),
            ('play_next', playback.step),
        ):
            self.node.create_service(Trigger, f'~/{name}', partial(self._on_request, act))

    def _on_request(self, act: Callable[[], Any], _: Any, response: Any) -> Any:
        response.success = act() is not False
        response.message = 'paused' if self.playback.paused else 'playing'
        return response
