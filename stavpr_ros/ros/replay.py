"""Publishes image records at a pace, or one by one as each is answered."""

import array
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.discovery import Introduction
from stavpr_ros.signals import signals_deferred
from stavpr_ros.sources.frame import ImageRecord

SECOND = 1_000_000_000
SLICE_SECONDS = 0.1
"""Longest time in one wait, so that Ctrl-C is heard."""


class NobodyListensError(StavprError):
    """No subscriber, or no node that answers, turned up in time."""


class NoAnswerError(StavprError):
    """A published image was neither answered nor acknowledged in time."""


@dataclass(frozen=True)
class ReplaySettings:
    """
    How to replay.

    :param publish_to: image topic; relative names are remapped and put into the node's namespace.
    :param match_topic: topic of the answers; heard only if lossless.
    :param rate: factor on the recorded pace, above 0.
    :param lossless: publish the next image when the last one is answered; the pace does not count then.
    :param timeout: seconds to wait for the answer to one image before it is sent again.
    :param wait: seconds to wait for listeners; None = for ever.
    :param tries: how often one image is sent before giving up.
    """

    publish_to: str = 'image'
    match_topic: str = 'stavpr/match'
    rate: float = 1.0
    lossless: bool = False
    timeout: float = 20.0
    wait: float | None = None
    tries: int = 3


def image_message(record: ImageRecord) -> Image:
    """Make the message of a record; its header is the recorded one."""
    message = Image(
        height=record.height,
        width=record.width,
        encoding=record.encoding,
        is_bigendian=int(record.is_bigendian),
        step=record.step,
    )
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(record.stamp_ns, SECOND)
    message.header.frame_id = record.frame_id
    data = array.array('B')  # the one type that rclpy does not check byte by byte
    data.frombytes(memoryview(record.data).cast('B'))
    message.data = data
    return message


class Replayer:
    """
    Publishes images on a node; nothing else may spin that node.

    :param node: where the publisher, and the subscription of the answers, are made.
    :param settings: pace, topics and patience.
    :param notify: called with what a user should know: waiting for whom, an image sent again.
    """

    def __init__(self, node: Node, settings: ReplaySettings, notify: Callable[[str], None]) -> None:
        self.node = node
        self.settings = settings
        self.notify = notify
        self.published = 0
        self.resent = 0
        self.dropped = 0
        reliable = QoSProfile(depth=30, reliability=ReliabilityPolicy.RELIABLE)
        self.publisher = node.create_publisher(Image, settings.publish_to, reliable)
        self.subscription = (
            node.create_subscription(PlaceMatch, settings.match_topic, self._on_match, reliable)
            if settings.lossless
            else None
        )
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._introduction = Introduction(node, self._listeners, settings.timeout)
        self._outstanding: Header | None = None
        self._start: tuple[float, int] | None = None

    def wait_for_listeners(self) -> None:
        """
        Wait until the first image will be heard, and, if lossless, its answer too.

        :raises NobodyListensError: ``wait`` seconds are over.
        """
        wait = self.settings.wait
        deadline = None if wait is None else time.monotonic() + wait
        told = ''
        while missing := self._missing():
            if missing != told:
                self.notify(f'waiting for {missing}')
                told = missing
            if deadline is not None and time.monotonic() > deadline:
                raise NobodyListensError(
                    f'waited {wait:g} s for {missing}: expected the node to be running; start it, compare '
                    'the topics (`ros2 topic list`) and ROS_DOMAIN_ID, or wait longer (--wait)'
                )
            self._spin(SLICE_SECONDS)
        self._settle()

    def send(self, record: ImageRecord) -> None:
        """
        Publish one image when its time has come; if lossless, return when it is answered.

        :raises NoAnswerError: lossless, and no answer after all tries.
        """
        message = image_message(record)
        if self.settings.lossless:
            self._send_until_answered(message)
        else:
            self._wait_until_due(record.time_ns)
            self.publisher.publish(message)
        self.published += 1

    def finish(self) -> None:
        """
        Wait until the last images have arrived, so that the node may be destroyed.

        :raises NoAnswerError: a reliable subscriber has not acknowledged them in time.
        """
        deadline = time.monotonic() + self.settings.timeout
        while not self.publisher.wait_for_all_acked(Duration(seconds=SLICE_SECONDS)):
            if time.monotonic() > deadline:
                raise NoAnswerError(
                    f'the last images on {self.publisher.topic_name} are not acknowledged after '
                    f'{self.settings.timeout:g} s: expected reliable subscribers to take them; is one stuck?'
                )
        # best-effort subscribers acknowledge nothing: an answer to a request sent after the images tells
        self._introduction.renew()
        self._settle()

    def close(self) -> None:
        """Let go of the node, which is the caller's to destroy."""
        self._executor.shutdown()

    def _spin(self, seconds: float) -> None:
        with signals_deferred():
            self._executor.spin_once(timeout_sec=max(0.0, min(seconds, SLICE_SECONDS)))

    def _missing(self) -> str:
        """Name who is not there yet; empty if all are."""
        if not self.publisher.get_subscription_count():
            return f'a subscriber of {self.publisher.topic_name}'
        if self.subscription is not None and not self.subscription.get_publisher_count():
            return f'a publisher of {self.subscription.topic_name}'
        return ''

    def _settle(self) -> None:
        """Wait until the listeners know of us: a best-effort one loses what comes before."""
        while not self._introduction.done():
            self._spin(SLICE_SECONDS)

    def _listeners(self) -> list[Any]:
        """Endpoints of those who subscribe to the images, or answer."""
        found = self.node.get_subscriptions_info_by_topic(self.publisher.topic_name)
        if self.subscription is not None:
            found += self.node.get_publishers_info_by_topic(self.subscription.topic_name)
        return found

    def _wait_until_due(self, time_ns: int) -> None:
        if self._start is None:
            self._start = time.monotonic(), time_ns
        began, first_ns = self._start
        due = began + (time_ns - first_ns) / SECOND / self.settings.rate
        if due - time.monotonic() > 10:
            self.notify(f'the next image comes in {due - time.monotonic():.0f} s, as recorded (see --rate)')
        while (left := due - time.monotonic()) > 0:
            self._spin(left)

    def _send_until_answered(self, message: Image) -> None:
        """
        Send and wait for one answer with the same header.

        Headers may all be equal (stamps of 0), so it matters that only one image is on its way. If it was
        sent again to a node that was only slow, a second answer comes; an equal header takes it for its own.
        """
        stamp = message.header.stamp
        name = f'image {self.published + 1} (stamp {stamp.sec}.{stamp.nanosec:09d})'
        timeout = self.settings.timeout
        for attempt in range(self.settings.tries):
            if attempt:
                self.resent += 1
                self.notify(f'{name}: no answer for {timeout:g} s, sent again (try {attempt + 1})')
            self._outstanding = message.header
            self.publisher.publish(message)
            deadline = time.monotonic() + timeout
            while self._outstanding is not None and (left := deadline - time.monotonic()) > 0:
                self._spin(left)
            if self._outstanding is None:
                return
        topic = self.subscription.topic_name if self.subscription else self.settings.match_topic
        raise NoAnswerError(
            f'{name} got no answer on {topic} in {self.settings.tries} tries of {timeout:g} s: expected one '
            f'message per image; is the node alive, is it subscribed to '
            f'{self.publisher.topic_name}? A slow one needs a longer --timeout'
        )

    def _on_match(self, match: PlaceMatch) -> None:
        if match.header != self._outstanding:
            return
        self._outstanding = None
        if match.status == PlaceMatch.DROPPED:
            self.dropped += 1
            self.notify(f'image {self.published + 1} was dropped by the node: is another camera publishing?')
