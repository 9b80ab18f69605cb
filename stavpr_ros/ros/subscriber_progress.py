# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Counts how many of the published images a node has received, by its results."""

from collections import Counter
from collections.abc import Callable
import time

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from stavpr_msgs.msg import LoopClosure, MapInfo, PlaceMatch
from stavpr_ros.ros.qos import LATCHED
from std_msgs.msg import Header

RESULTS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
MAX_BEHIND = 8  # loop closures that may follow their matches later; a node drops more than 16
QUIET = 2.0  # seconds after the last result: then outstanding images count as lost
RECORDER, READY = 'stavpr_record', 'recording'  # node; its topic while it misses nothing


class SubscriberProgress:
    """
    Compares the headers of published images with the headers of results on ``stavpr/match``.

    The recognition node publishes one result for each image that it receives, processed or not.

    :param node: for the subscription; the caller spins it.

    ``status`` is the last result's; ``expects_closures``: one loop closure for each match;
    ``on_match`` is called with each match, of any image.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._topic = node, node.resolve_topic_name('stavpr/match')
        self._info_topic, self._has_info = node.resolve_topic_name('stavpr/map_info'), False
        self._outstanding: Counter[tuple[int, int, str]] = Counter()
        self._sent = self._received = 0
        self._last = time.monotonic()  # event
        self.status = PlaceMatch.NOT_READY
        self._matches = self._closures = 0
        self.expects_closures = False
        self.on_match: Callable[[PlaceMatch], object] = lambda match: None
        node.create_subscription(PlaceMatch, 'stavpr/match', self._on_match, RESULTS)
        topic = 'stavpr/loop_closure'
        node.create_subscription(LoopClosure, topic, self._on_closure, RESULTS)
        node.create_subscription(MapInfo, 'stavpr/map_info', self._on_map_info, LATCHED)

    def knows_operation(self) -> bool:
        """Return whether ``expects_closures`` is the node's, or no node publishes it."""
        return self._has_info or not self._node.count_publishers(self._info_topic)

    def count_sent(self, header: Header) -> None:
        """Count an image; to be called before it is published."""
        self._sent += 1
        self._outstanding[_key(header)] += 1
        self._last = time.monotonic()

    def is_complete(self) -> bool:
        """Return whether each image has its result."""
        return self._received == self._sent

    def keeps_up(self) -> bool:
        """Return whether a node in operation loop_closure keeps up with its edges."""
        return not self.expects_closures or self._matches - self._closures <= MAX_BEHIND

    def is_settled(self) -> bool:
        """Return whether no more results are expected."""
        if self.is_complete() or not self._node.count_publishers(self._topic):
            return True
        return time.monotonic() - self._last > QUIET

    def report(self) -> str:
        """Return how many images were received; empty without a node that publishes results."""
        if not self._received and not self._node.count_publishers(self._topic):
            return ''
        text = f'{self._received} of {self._sent} received by the node'
        losses = self._sent - self._received
        return text + (f', {losses} lost: see docs/troubleshooting.md' if losses else '')

    def _on_match(self, match: PlaceMatch) -> None:
        self.on_match(match)
        key = _key(match.header)
        if self._outstanding[key] > 0:
            self._outstanding[key] -= 1
            self._received += 1
            self.status = match.status
            self._last = time.monotonic()
        self._matches += match.status == PlaceMatch.MATCH

    def _on_map_info(self, info: MapInfo) -> None:
        self._has_info = True
        self.expects_closures = info.operation == 'loop_closure'

    def _on_closure(self, _: LoopClosure) -> None:
        self._closures += 1


def _key(header: Header) -> tuple[int, int, str]:
    return header.stamp.sec, header.stamp.nanosec, header.frame_id
