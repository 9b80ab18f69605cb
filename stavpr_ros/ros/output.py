# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The publishers of results."""

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_policy_name_from_kind, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from stavpr_msgs.msg import LoopClosure, PlaceCandidates, PlaceMatch
from stavpr_ros.pipeline.overlay import draw_match
from stavpr_ros.ros.messages import (
    candidates_message,
    image_message,
    match_message,
    matched_pose_message,
    Outcome,
)
from stavpr_ros.ros.rclpy_workarounds import ManagedNode, until_shutdown
from std_msgs.msg import Float32, Int32

DEPTH = 50  # matches kept for slower subscribers
IMAGE_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Publishers:
    """Publishers of the outcome of each image, which are made and destroyed together."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._create: Callable[..., Any] = node.create_publisher
        self._destroy: Callable[[Any], object] = node.destroy_publisher
        self._publishers: list[Publisher] = []

    def publish(self, outcome: Outcome) -> None:
        """Publish the outcome of an image; on the worker."""
        raise NotImplementedError

    def reset(self) -> None:
        """Let nothing before the next image count: the window was emptied."""

    def close(self) -> None:
        """Destroy the publishers, and release the map."""
        for publisher in self._publishers:
            self._destroy(publisher)

    def _make(
        self, kind: type, topic: str, qos: QoSProfile | int = 1, **options: Any
    ) -> Publisher:
        """Make the publisher of a topic."""
        self._publishers.append(self._create(kind, topic, qos, **options))
        return self._publishers[-1]

    def _send(self, publisher: Publisher, message: Any) -> None:
        """Publish a message; not after the shutdown of ROS."""
        with until_shutdown(self._node):
            publisher.publish(message)

    def _is_requested(self, *publishers: Publisher) -> bool:
        """Return whether one of these topics has a subscriber; not after the shutdown of ROS."""
        has_subscriber = False
        with until_shutdown(self._node):
            has_subscriber = any(publisher.get_subscription_count() for publisher in publishers)
        return has_subscriber


class Output(Publishers):
    """
    The publishers of matches, and of loop closures, which wait for their edges.

    :param burst: matches that may be published at once.
    """

    def __init__(self, node: ManagedNode, burst: int) -> None:
        super().__init__(node)
        self._create = node.create_lifecycle_publisher
        self._destroy = node.destroy_lifecycle_publisher
        qos = QoSProfile(depth=max(DEPTH, burst), reliability=ReliabilityPolicy.RELIABLE)
        self._match = self._make(PlaceMatch, '~/match', qos)
        self._place_index = self._make(Int32, '~/place_index', qos)
        self._distance = self._make(Float32, '~/distance', qos)
        self._candidates = self._make(PlaceCandidates, '~/candidates', qos)
        self._pose = self._make(PoseWithCovarianceStamped, '~/pose', qos)
        self._loop_closure = self._make(LoopClosure, '~/loop_closure', qos)
        self._match_image = self._make(Image, '~/match_image', IMAGE_QOS)

    def _make(
        self, kind: type, topic: str, qos: QoSProfile | int = 1, **options: Any
    ) -> Publisher:
        def on_incompatible(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            self._node.get_logger().warning(
                f'a subscriber of {topic} receives nothing: it requests another {policy}; the '
                'publisher is reliable and volatile'
            )

        events = PublisherEventCallbacks(incompatible_qos=on_incompatible)
        return super()._make(kind, topic, qos, event_callbacks=events, **options)

    @property
    def needs_candidates(self) -> bool:
        """Whether candidates have a subscriber."""
        return self._is_requested(self._candidates)

    def publish(self, outcome: Outcome) -> None:
        """Publish the results for one image, ``~/match`` last."""
        result = outcome.result
        message = match_message(outcome)
        pose, candidates = matched_pose_message(outcome), candidates_message(outcome)
        if result.match.accepted and self._is_requested(self._place_index):
            self._send(self._place_index, Int32(data=message.place_index))
        if result.match.accepted and self._is_requested(self._distance):
            self._send(self._distance, Float32(data=message.distance))
        if pose is not None:
            self._send(self._pose, pose)
        if candidates is not None:
            self._send(self._candidates, candidates)
        if result.image is not None and self._is_requested(self._match_image):
            image = draw_match(result, outcome.places)
            self._send(self._match_image, image_message(outcome.header, image))
        self._send(self._match, message)

    def publish_closure(self, message: LoopClosure) -> None:
        """Publish a loop closure."""
        self._send(self._loop_closure, message)
