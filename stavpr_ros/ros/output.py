# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The publishers of results and of the description of the map."""

from collections.abc import Callable
import threading
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_policy_name_from_kind, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from stavpr_msgs.msg import LoopClosure, MapInfo, PlaceCandidates, PlaceMatch
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.pipeline.overlay import draw_match
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.relative_pose.pair import Edge
from stavpr_ros.ros.messages import (
    candidates_message,
    image_message,
    match_message,
    matched_pose_message,
    NO_FRAMES,
    PoseFrames,
)
from stavpr_ros.ros.qos import LATCHED
from stavpr_ros.ros.rclpy_workarounds import ManagedNode, until_shutdown
from std_msgs.msg import Float32, Header, Int32

DEPTH = 50  # matches kept for slower subscribers
IMAGE_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


def is_requested(node: Node, publisher: Publisher) -> bool:
    """Return whether a topic has a subscriber; not after the shutdown of ROS."""
    requested = False
    with until_shutdown(node):
        requested = publisher.get_subscription_count() > 0
    return requested


class Output:
    """
    The publishers of matches.

    :param burst: matches that may be published at once.
    :param robot_id: the parameter of this name.
    """

    def __init__(self, node: ManagedNode, burst: int, robot_id: str) -> None:
        self._node, self._robot_id = node, robot_id
        self._qos = QoSProfile(depth=max(DEPTH, burst), reliability=ReliabilityPolicy.RELIABLE)
        self._publishers: list[Any] = []
        self.match = self._publisher(PlaceMatch, '~/match')
        self.place_index = self._publisher(Int32, '~/place_index')
        self.distance = self._publisher(Float32, '~/distance')
        self.candidates = self._publisher(PlaceCandidates, '~/candidates')
        self.pose = self._publisher(PoseWithCovarianceStamped, '~/pose')
        self.loop_closure = self._publisher(LoopClosure, '~/loop_closure')
        self.match_image = self._publisher(Image, '~/match_image', IMAGE_QOS)

    def _publisher(self, message_type: type, topic: str, qos: QoSProfile | None = None) -> Any:
        def on_incompatible(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            self._node.get_logger().warning(
                f'a subscriber of {topic} receives nothing: it requests another {policy}; the '
                'publisher is reliable and volatile'
            )

        events = PublisherEventCallbacks(incompatible_qos=on_incompatible)
        publisher = self._node.create_lifecycle_publisher(
            message_type, topic, qos or self._qos, event_callbacks=events
        )
        self._publishers.append(publisher)
        return publisher

    def publish(
        self,
        header: Header,
        result: ImageResult,
        places: PlaceMap | GrowingMap | None = None,
        frames: PoseFrames = NO_FRAMES,
        edge: Edge | None = None,
    ) -> PlaceMatch:
        """
        Publish the results for one image, ``~/match`` last; return that message.

        Loop closures are not among them: they wait for their edges.

        :param places: the map that the indices of the match refer to.
        :param frames: of its poses.
        :param edge: of the middle pair, None = none.
        """
        robot_id = self._robot_id
        message = match_message(header, result, places, robot_id, edge, frames.child)
        pose = matched_pose_message(header, result, places, frames.frame)
        candidates = candidates_message(header, result, places, robot_id)
        with until_shutdown(self._node):
            if result.match.accepted and self.place_index.get_subscription_count():
                self.place_index.publish(Int32(data=message.place_index))
            if result.match.accepted and self.distance.get_subscription_count():
                self.distance.publish(Float32(data=message.distance))
            if pose is not None:
                self.pose.publish(pose)
            if candidates is not None:
                self.candidates.publish(candidates)
            if result.image is not None and self.match_image.get_subscription_count():
                self.match_image.publish(image_message(header, draw_match(result, places)))
            self.match.publish(message)
        return message

    def publish_closure(self, message: LoopClosure) -> None:
        """Publish a loop closure."""
        with until_shutdown(self._node):
            self.loop_closure.publish(message)

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in self._publishers:
            self._node.destroy_lifecycle_publisher(publisher)


class MapInfoPublisher:
    """Publishes ``~/map_info`` when it has changed, in the order of the changes."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(MapInfo, '~/map_info', LATCHED)
        self._lock = threading.RLock()
        self.last: MapInfo | None = None

    def publish(self, describe: Callable[[], MapInfo | None]) -> None:
        """Publish the description if it differs from the last one; None = there is none."""
        with self._lock:
            info = describe()
            if info is None:
                return
            info.header.stamp = self._node.get_clock().now().to_msg()
            last, self.last = self.last, info
            if last is not None:
                last.header = info.header  # a new stamp alone is no change
            if last != info and self._node.context.ok():
                self._publisher.publish(info)
