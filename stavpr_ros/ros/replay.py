# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes image records at a pace, or each after the result of the one before."""

import array
from collections.abc import Callable
import math
import time
from typing import Any

from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.errors import StavprError
from stavpr_ros.ros.process import Discovery
from stavpr_ros.ros.receipts import Receipts
from stavpr_ros.signals import signals_deferred
from stavpr_ros.sources.frame import ImageRecord
from std_msgs.msg import Header

SECOND = 1_000_000_000
SPIN_SECONDS = 0.1  # until a signal is noticed
TRIES = 3  # how often one image is sent
RELIABLE = QoSProfile(depth=30, reliability=ReliabilityPolicy.RELIABLE)


class NoSubscriberError(StavprError):
    """No subscriber, or no node that publishes results, was discovered in time."""


class NoResultError(StavprError):
    """A published image got neither a result nor an acknowledgment in time."""


def image_message(record: ImageRecord) -> Image:
    """Return the message of a record, with the recorded header."""
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
    Publishes images on the topic ``image`` of a node, which it spins.

    :param node: for the publisher and the subscription of the results.
    :param notify: called with messages for the user: waiting for a subscriber, an image sent
        again.
    :param rate: factor on the recorded pace, above 0; without effect with ``lossless``.
    :param lossless: publish the next image after the result of the last one on ``stavpr/match``.
    :param timeout: seconds without a result after which an image is sent again.
    :param wait: seconds to wait for subscribers; None = no limit.
    """

    def __init__(
        self,
        node: Node,
        notify: Callable[[str], None],
        rate: float,
        lossless: bool,
        timeout: float,
        wait: float | None,
    ) -> None:
        self.node, self.notify = node, notify
        self._rate, self._timeout, self._wait = rate, timeout, wait
        self.lossless = lossless
        self.published = self.resent = self.dropped = 0
        self.publisher = node.create_publisher(Image, 'image', RELIABLE)
        self.receipts = Receipts(node)
        self._match_topic = node.resolve_topic_name('stavpr/match')
        if lossless:
            node.create_subscription(PlaceMatch, 'stavpr/match', self._on_match, RELIABLE)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._discovery = Discovery(node, self._endpoints, timeout)
        self._outstanding: Header | None = None
        self._start: tuple[float, int] | None = None

    def wait_for_subscribers(self) -> None:
        """
        Wait until the first image, and if lossless its result, will be received.

        :raises NoSubscriberError: not within ``wait`` seconds.
        """
        notified = ''

        def complete() -> bool:
            nonlocal notified
            missing = self._missing()
            if missing not in ('', notified):
                self.notify(f'waiting for {missing}')
                notified = missing
            return not missing

        if not self._spin_until(complete, self._wait):
            raise NoSubscriberError(
                f'waited {self._wait:g} s for {self._missing()}: expected a running node; '
                'start it, compare the topics (`ros2 topic list`) and ROS_DOMAIN_ID, or wait '
                'longer (--wait)'
            )
        self._wait_for_discovery()

    def send(self, record: ImageRecord) -> None:
        """
        Publish one image when it is due; if lossless, return after its result.

        :raises NoResultError: lossless, and no result after all tries.
        """
        message = image_message(record)
        if self.lossless:
            self._send_until_answered(message)
        else:
            self._wait_until_due(record.time_ns)
            self.receipts.sent(message.header)
            self.publisher.publish(message)
        self.published += 1

    def finish(self) -> None:
        """
        Wait until the last images have arrived, so that the node may be destroyed.

        :raises NoResultError: a reliable subscriber has not acknowledged them in time.
        """
        timeout = self._timeout
        if not self._spin_until(lambda: self.publisher.wait_for_all_acked(Duration()), timeout):
            raise NoResultError(
                f'the last images on {self.publisher.topic_name} are not acknowledged after '
                f'{timeout:g} s: expected reliable subscribers to take them; check for a busy one'
            )
        # best-effort subscribers acknowledge nothing: a response to a later request proves it
        self._wait_for_discovery()
        self._spin_until(self.receipts.settled, None)

    def close(self) -> None:
        """Release the node; the caller destroys it."""
        self._executor.shutdown()

    def _spin_until(self, done: Callable[[], bool], seconds: float | None) -> bool:
        """Spin until ``done`` returns True; return False when the time is over."""
        end = math.inf if seconds is None else time.monotonic() + seconds
        while not done():
            left = end - time.monotonic()
            if left <= 0:
                return False
            with signals_deferred():
                self._executor.spin_once(timeout_sec=min(left, SPIN_SECONDS))
        return True

    def _missing(self) -> str:
        """Return the endpoint that is not discovered yet; empty = none."""
        if not self.publisher.get_subscription_count():
            return f'a subscriber of {self.publisher.topic_name}'
        if self.lossless and not self.node.count_publishers(self._match_topic):
            return f'a publisher of {self._match_topic}'
        return ''

    def _wait_for_discovery(self) -> None:
        """Wait until the others have discovered us: best-effort ones lose earlier images."""
        self._discovery.restart()
        self._spin_until(self._discovery.done, None)

    def _endpoints(self) -> list[Any]:
        """Return the subscriptions to the images and the publishers of results."""
        found = self.node.get_subscriptions_info_by_topic(self.publisher.topic_name)
        if self.lossless:
            found += self.node.get_publishers_info_by_topic(self._match_topic)
        return found

    def _wait_until_due(self, time_ns: int) -> None:
        if self._start is None:
            self._start = time.monotonic(), time_ns
        began, first_ns = self._start
        left = began + (time_ns - first_ns) / SECOND / self._rate - time.monotonic()
        if left > 10:
            self.notify(f'the next image is due in {left:.0f} s, as recorded (see --rate)')
        self._spin_until(lambda: False, left)

    def _send_until_answered(self, message: Image) -> None:
        """
        Send an image and wait for a result with its header.

        Headers may all be equal (stamps of 0), so only one image is outstanding. An image sent
        again to a slow node has two results; with an equal header the second counts for the next
        image.
        """
        stamp, timeout = message.header.stamp, self._timeout
        name = f'image {self.published + 1} (stamp {stamp.sec}.{stamp.nanosec:09d})'
        for attempt in range(TRIES):
            if attempt:
                self.resent += 1
                self.notify(f'{name}: no result for {timeout:g} s, sent again (try {attempt + 1})')
            self._outstanding = message.header
            self.publisher.publish(message)
            if self._spin_until(lambda: self._outstanding is None, timeout):
                return
        raise NoResultError(
            f'{name} got no result on {self._match_topic} in {TRIES} tries of '
            f'{timeout:g} s: expected one message per image; check that the node runs and '
            f'subscribes to {self.publisher.topic_name}, or give a slow one a longer --timeout'
        )

    def _on_match(self, match: PlaceMatch) -> None:
        if match.header != self._outstanding:
            return
        self._outstanding = None
        if match.status == PlaceMatch.DROPPED:
            self.dropped += 1
            self.notify(
                f'image {self.published + 1} was dropped by the node: check for another publisher'
            )
