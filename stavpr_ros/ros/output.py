# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The publishers of matches; lifecycle publishers, which publish only while the node is active."""

import math
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import qos_policy_name_from_kind, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from stavpr_msgs.msg import LoopClosure, PlaceCandidates, PlaceMatch
from stavpr_ros.mapping import GrowingMap, place_thumbnail, PlaceMap
from stavpr_ros.pipeline.overlay import match_image
from stavpr_ros.recognition import Match
from stavpr_ros.ros.messages import (
    candidates_message,
    image_message,
    loop_closure_message,
    match_message,
    matched_pose_message,
)
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from std_msgs.msg import Float32, Header, Int32

DEPTH = 50  # matches kept for slower subscribers
IMAGE_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Output:
    """
    The publishers of matches.

    :param node: their node.
    :param burst: matches that may be published at once.
    """

    def __init__(self, node: ManagedNode, burst: int) -> None:
        self._node = node
        self._qos = QoSProfile(depth=max(DEPTH, burst), reliability=ReliabilityPolicy.RELIABLE)
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

        return self._node.create_lifecycle_publisher(
            message_type,
            topic,
            qos or self._qos,
            event_callbacks=PublisherEventCallbacks(incompatible_qos=on_incompatible),
        )

    def publish(
        self,
        header: Header,
        match: Match,
        places: PlaceMap | GrowingMap | None = None,
        frame: str = '',
    ) -> PlaceMatch:
        """
        Publish the results for one image, ``~/match`` last; return that message.

        :param places: the map that the indices of the match refer to.
        :param frame: of the poses.
        """
        message = match_message(header, match, places)
        try:
            if match.accepted:
                self.place_index.publish(Int32(data=message.place_index))
                self.distance.publish(Float32(data=message.distance))
            for publisher, more in (
                (self.loop_closure, loop_closure_message(header, match, places)),
                (self.pose, matched_pose_message(header, match, places, frame)),
                (self.candidates, candidates_message(header, match, places)),
            ):
                if more is not None:
                    publisher.publish(more)
            if match.image is not None and self.match_image.get_subscription_count():
                self.match_image.publish(image_message(header, draw_match(match, places)))
            self.match.publish(message)
        except rclpy_implementation.RCLError:
            if self._node.context.ok():  # else ROS was shut down before the node
                raise
        return message

    @property
    def candidates_requested(self) -> bool:
        """Whether ``~/candidates`` has a subscriber."""
        try:
            return bool(self.candidates.get_subscription_count())
        except rclpy_implementation.RCLError:
            if self._node.context.ok():
                raise
            return False

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in (
            *(self.match, self.place_index, self.distance, self.candidates),
            *(self.pose, self.loop_closure, self.match_image),
        ):
            self._node.destroy_lifecycle_publisher(publisher)


def draw_match(match: Match, places: PlaceMap | GrowingMap | None) -> np.ndarray:
    """
    Draw an image beside its nearest place, with status and distance.

    :returns: RGB, uint8.
    """
    assert match.image is not None
    if match.sequence is None or places is None:
        return match_image(
            match.image, None, f'{match.status.label} {match.reason}'.strip(), False
        )
    place = match.newest_index if match.accepted else match.sequence.middle
    text = f'{match.status.label}: place {place}, distance {match.distance:.3f}'
    if not math.isnan(match.threshold):
        text += f' (threshold {match.threshold:.3f})'
    if match.inliers >= 0:
        text += f', {match.inliers} inliers'
    return match_image(match.image, place_thumbnail(places, place), text, match.accepted)
