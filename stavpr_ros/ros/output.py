"""What the node says: its publishers, which are silent unless the node is active."""

import math
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from sensor_msgs.msg import Image
from std_msgs.msg import Float32, Header, Int32

from stavpr_msgs.msg import Candidates, LoopClosure, PlaceMatch
from stavpr_ros.evaluation.overlay import match_image
from stavpr_ros.operation import Answer, Outcome
from stavpr_ros.operation.outcome import place_picture
from stavpr_ros.ros.lifecycle import ManagedNode
from stavpr_ros.ros.messages import (
    candidates_message,
    image_message,
    loop_closure_message,
    match_message,
    matched_pose_message,
)

DEPTH = 50  # answers kept for subscribers that are slower
PICTURES = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


class Output:
    """
    The publishers of answers.

    :param node: their node.
    :param burst: answers that may be published at once.
    """

    def __init__(self, node: ManagedNode, burst: int) -> None:
        self._node = node
        self._answers = QoSProfile(depth=max(DEPTH, burst), reliability=ReliabilityPolicy.RELIABLE)
        self.match = self._publisher(PlaceMatch, '~/match')
        self.place_index = self._publisher(Int32, '~/place_index')
        self.distance = self._publisher(Float32, '~/distance')
        self.candidates = self._publisher(Candidates, '~/candidates')
        self.pose = self._publisher(PoseWithCovarianceStamped, '~/pose')
        self.loop_closure = self._publisher(LoopClosure, '~/loop_closure')
        self.match_image = self._publisher(Image, '~/match_image', PICTURES)

    def _publisher(self, message_type: type, topic: str, qos: QoSProfile | None = None) -> Any:
        def refused(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            self._node.get_logger().warning(
                f'a subscriber of {topic} hears nothing: it asks for another {policy}; answers are reliable, '
                'volatile'
            )

        return self._node.create_lifecycle_publisher(
            message_type,
            topic,
            qos or self._answers,
            event_callbacks=PublisherEventCallbacks(incompatible_qos=refused),
        )

    def publish(self, header: Header, outcome: Outcome, frame: str = '') -> PlaceMatch:
        """
        Publish everything that is to be said of an image, its ``~/match`` last; return that.

        :param frame: of the poses.
        """
        answer = match_message(header, outcome)
        try:
            self._publish(answer, header, outcome, frame)
        except rclpy_implementation.RCLError:
            if self._node.context.ok():  # else ROS was shut down before the node: nobody hears anything
                raise
        return answer

    @property
    def wants_candidates(self) -> bool:
        """Somebody listens to them."""
        try:
            return bool(self.candidates.get_subscription_count())
        except rclpy_implementation.RCLError:
            if self._node.context.ok():
                raise
            return False

    def _publish(self, answer: PlaceMatch, header: Header, outcome: Outcome, frame: str) -> None:
        if outcome.answer is Answer.MATCH:
            self.place_index.publish(Int32(data=answer.place_index))
            self.distance.publish(Float32(data=answer.distance))
        for publisher, message in (
            (self.loop_closure, loop_closure_message(header, outcome)),
            (self.pose, matched_pose_message(header, outcome, frame)),
            (self.candidates, candidates_message(header, outcome)),
        ):
            if message is not None:
                publisher.publish(message)
        if outcome.image is not None and self.match_image.get_subscription_count():
            self.match_image.publish(image_message(header, drawn(outcome)))
        self.match.publish(answer)

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in vars(self).values():
            if hasattr(publisher, 'get_subscription_count'):
                self._node.destroy_lifecycle_publisher(publisher)


def drawn(outcome: Outcome) -> Any:
    """
    Draw an image beside the place that it is nearest to, with the verdict and the distance.

    :returns: RGB, uint8.
    """
    recognition, places, image = outcome.recognition, outcome.places, outcome.image
    assert image is not None
    nearest = recognition.nearest if recognition is not None else None
    matched = outcome.answer is Answer.MATCH
    word = outcome.answer.name.lower().replace('_', ' ')
    if recognition is None or nearest is None or places is None:
        return match_image(image, None, f'{word} {outcome.reason}'.strip(), False)
    place = recognition.newest if matched else nearest.middle
    text = f'{word}: place {place}, distance {nearest.distance:.3f}'
    if outcome.threshold is not None and not math.isnan(outcome.threshold):
        text += f' (threshold {outcome.threshold:.3f})'
    if outcome.inliers >= 0:
        text += f', {outcome.inliers} inliers'
    return match_image(image, place_picture(places, place), text, matched)
