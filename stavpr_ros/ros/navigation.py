# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""For navigation, off by default: the transform from map to odometry, and the initial pose."""

from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
import numpy as np
from rclpy.node import Node
from stavpr_ros.errors import UnavailableError
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.recognition import Status
from stavpr_ros.ros.messages import matched_pose_message, transform_message
from stavpr_ros.ros.rclpy_workarounds import until_shutdown
from std_msgs.msg import Header

# (0.5 m)^2 and (15 degrees)^2, as RViz's 2D Pose Estimate: a place does not determine the lateral
# offset from the mapped route
MIN_VARIANCE_XY, MIN_VARIANCE_YAW = 0.25, 0.0685
TF_DEPTH = 100  # as tf2_ros has it


class Navigation:
    """
    Publishes ``map -> odom`` on ``/tf``, and ``initialpose`` once per relocalization.

    :raises UnavailableError: ``publish_tf`` is set and tf2_msgs is not installed.
    """

    def __init__(self, node: Node, settings: NodeSettings) -> None:
        self._node, self._settings = node, settings
        self._tf: Any = None
        self._initial_pose: Any = None
        if settings.publish_tf:
            self._tf = node.create_publisher(tf_message(), '/tf', TF_DEPTH)
        if settings.publish_initialpose:
            self._initial_pose = node.create_publisher(PoseWithCovarianceStamped, 'initialpose', 1)
        self._unmatched = settings.pipeline.sequence.length  # images since the last match
        self._places: PlaceMap | GrowingMap | None = None
        self._transform: TransformStamped | None = None

    def publish(
        self,
        header: Header,
        result: ImageResult,
        places: PlaceMap | GrowingMap | None,
        odometry: np.ndarray | None,
        odometry_frame: str,
    ) -> None:
        """
        Publish transform and initial pose, in operation localization; on the worker.

        :param odometry: pose at the stamp of the image, shape (7,); None = unknown.
        """
        if result.cause or not isinstance(places, PlaceMap):
            return
        if places is not self._places:
            self._places, self._transform = places, None
            self._unmatched = self._settings.pipeline.sequence.length
        map_frame = self._settings.map_frame
        pose = places.place(result.newest_index).pose if result.accepted else None
        if pose is not None and odometry is not None:
            correction = map_to_odometry(pose, odometry)
            self._transform = transform_message(correction, map_frame, odometry_frame)
        # a whole window without a match, or a new window
        length = self._settings.pipeline.sequence.length
        is_lost = self._unmatched >= length - 1
        if result.status is Status.WARMING_UP:
            self._unmatched = length
        else:
            self._unmatched = 0 if result.accepted else self._unmatched + 1
        with until_shutdown(self._node):
            if self._tf is not None and self._transform is not None:
                self._transform.header.stamp = header.stamp  # without a match, the last transform
                self._tf.publish(tf_message()(transforms=[self._transform]))
            message = matched_pose_message(header, result, places, map_frame) if is_lost else None
            if self._initial_pose is not None and message is not None:
                self._initial_pose.publish(planar(message))

    def close(self) -> None:
        """Destroy the publishers, and release the map."""
        self._places = None
        for publisher in filter(None, (self._tf, self._initial_pose)):
            self._node.destroy_publisher(publisher)


def map_to_odometry(place: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """
    Return the pose of the odometry's frame in the map.

    :param place: pose of the robot in the map, x y z and quaternion x y z w, shape (7,).
    :param odometry: pose of the robot in the odometry's frame, shape (7,).
    """
    return to_poses(matrices(place) @ inverse(matrices(odometry)))


def planar(message: PoseWithCovarianceStamped) -> PoseWithCovarianceStamped:
    """Return a pose for navigation in the plane: x, y and yaw, with their covariance alone."""
    from scipy.spatial.transform import Rotation

    result = PoseWithCovarianceStamped(header=message.header)
    pose, o = result.pose.pose, message.pose.pose.orientation
    pose.position.x, pose.position.y = message.pose.pose.position.x, message.pose.pose.position.y
    yaw = Rotation.from_quat([o.x, o.y, o.z, o.w]).as_euler('ZYX')[0]
    pose.orientation.z, pose.orientation.w = float(np.sin(yaw / 2)), float(np.cos(yaw / 2))
    for i, least in ((0, MIN_VARIANCE_XY), (7, MIN_VARIANCE_XY), (35, MIN_VARIANCE_YAW)):
        result.pose.covariance[i] = max(least, message.pose.covariance[i])
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
