# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""For navigation, off by default: the transform from map to odometry, and the initial pose."""

import threading
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from stavpr_ros.errors import UnavailableError
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.operations import NOT_A_KEYFRAME
from stavpr_ros.ros.messages import matched_pose_message, Outcome, transform_message
from stavpr_ros.ros.output import Publishers
from stavpr_ros.ros.worker import Beat

# (0.5 m)^2 and (15 degrees)^2, as RViz's 2D Pose Estimate: a place does not determine the lateral
# offset from the mapped route
MIN_VARIANCE_XY, MIN_VARIANCE_YAW = 0.25, 0.0685
TF_DEPTH = 100  # as tf2_ros has it
TF_PERIOD = 0.05  # seconds, as RTAB-Map repeats it


class Navigation(Publishers):
    """
    Publishes ``map -> odom`` on ``/tf``, and ``initialpose`` once per relocalization.

    The transform is of the last match. It is repeated on a thread of its own and stamped
    ``transform_tolerance`` later than now, so that a transform at the present time is known: tf2
    does not extrapolate. Nothing is sent before the first match. The initial pose waits for a
    subscriber while the newest keyframe matches, and is due again when the last one has gone.

    :raises UnavailableError: ``publish_tf`` is set and tf2_msgs is not installed.
    """

    def __init__(self, node: Node, settings: NodeSettings) -> None:
        super().__init__(node)
        self._settings = settings
        self._tf: Any = None
        self._beat: Beat | None = None
        self._initial_pose: Any = None
        self._tolerance = Duration(seconds=settings.transform_tolerance)
        self._lock = threading.Lock()  # of the transform and its publisher
        self._transform: TransformStamped | None = None
        self._stamp: Time | None = None  # of the last transform
        if settings.publish_tf:
            self._tf_message = tf_message()
            self._tf = self._make(self._tf_message, '/tf', TF_DEPTH)
            self._beat = Beat(node, TF_PERIOD, self.repeat, 'tf')
        if settings.publish_initialpose:
            self._initial_pose = self._make(PoseWithCovarianceStamped, 'initialpose')
        self._places: Map | None = None
        self._is_due, self._unmatched = True, 0  # the initial pose; images since the last match
        self._matched: Outcome | None = None  # the newest keyframe, where its pose is known

    @property
    def sends_transform(self) -> bool:
        """Whether the transform is being sent: there was a match since :meth:`forget`."""
        return self._transform is not None

    def publish(self, outcome: Outcome) -> None:
        """Publish transform and initial pose, in operation localization."""
        place_map = outcome.place_map
        if outcome.places is not self._places:
            self.forget()
            self._places = place_map
        if not outcome.result.cause and place_map is not None:
            self._note(outcome)
        elif outcome.result.cause != NOT_A_KEYFRAME:  # the robot may have moved meanwhile
            self._matched = None
        self._send_initial_pose()

    def _note(self, outcome: Outcome) -> None:
        """Take an image of the window, and send its transform."""
        pose, about = outcome.newest_pose, outcome.about
        self._matched = None if pose is None else outcome
        self._unmatched = 0 if outcome.match.accepted else self._unmatched + 1
        # a whole window without a match
        self._is_due |= self._unmatched >= self._settings.pipeline.sequence.length - 1
        if self._tf is not None and pose is not None and about.pose is not None:
            shift = map_to_odometry(pose, about.pose)
            transform = transform_message(shift, about.frame, about.odometry_frame)
            with self._lock:
                if self._transform is None:  # from the image on, not from the tolerance on
                    self._send_transform(transform, outcome.header.stamp)
                self._transform = transform
            self.repeat()

    def _send_initial_pose(self) -> None:
        """Send the pose of the newest keyframe where it is due, to a subscriber."""
        if self._initial_pose is None:
            return
        if not self._is_requested(self._initial_pose):
            self._is_due = True
        elif self._is_due and (message := self._matched and matched_pose_message(self._matched)):
            self._send(self._initial_pose, planar(message))
            self._is_due = False

    def repeat(self) -> None:
        """Send the last transform, if any, for the time until the next one."""
        with self._lock:
            if self._transform is not None:
                now = self._node.get_clock().now()
                self._send_transform(self._transform, (now + self._tolerance).to_msg())

    def _send_transform(self, transform: TransformStamped, stamp: Time) -> None:
        if stamp == self._stamp:  # tf2 refuses a stamp twice: a paused clock
            return
        self._stamp = transform.header.stamp = stamp
        self._send(self._tf, self._tf_message(transforms=[transform]))

    def forget(self) -> None:
        """Send no transform until the next match: another map, or the node is deactivated."""
        with self._lock:
            self._transform = None
        self._places = None
        self.reset()

    def reset(self) -> None:
        """Let the next match be the first one: the window was emptied."""
        self._is_due, self._unmatched, self._matched = True, 0, None

    def close(self) -> None:
        """End the thread, destroy the publishers, and release the map."""
        if self._beat is not None:
            self._beat.stop()
        self._places = self._matched = None
        super().close()


def map_to_odometry(place: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """Return the pose of the odometry's frame in the map, by those of the robot in both, (7,)."""
    return to_poses(matrices(place) @ inverse(matrices(odometry)))


def planar(message: PoseWithCovarianceStamped) -> PoseWithCovarianceStamped:
    """Return a pose for navigation in the plane: x, y and yaw, with their covariance alone."""
    from scipy.spatial.transform import Rotation

    result = PoseWithCovarianceStamped(header=message.header)
    pose, o = result.pose.pose, message.pose.pose.orientation
    pose.position.x, pose.position.y = message.pose.pose.position.x, message.pose.pose.position.y
    yaw = Rotation.from_quat([o.x, o.y, o.z, o.w]).as_euler('ZYX')[0]
    pose.orientation.z, pose.orientation.w = float(np.sin(yaw / 2)), float(np.cos(yaw / 2))
    for i, min_variance in ((0, MIN_VARIANCE_XY), (7, MIN_VARIANCE_XY), (35, MIN_VARIANCE_YAW)):
        result.pose.covariance[i] = max(min_variance, message.pose.covariance[i])
    result.pose.covariance[1] = result.pose.covariance[6] = message.pose.covariance[1]
    return result


def tf_message() -> Any:
    """Return the class of the messages on /tf."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        raise UnavailableError(
            'publish_tf requires the package tf2_msgs: install it (ros-jazzy-tf2-msgs) and '
            'source its environment, or leave publish_tf off'
        ) from error
    return TFMessage
