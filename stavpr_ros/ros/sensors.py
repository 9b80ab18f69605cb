# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The subscriptions to odometry and to camera_info, and the camera's place on the robot."""

from collections import deque
from collections.abc import Callable
import importlib
import time
from typing import Any

from nav_msgs.msg import Odometry
import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.camera import Camera, FORWARD, mount_of, yaw_of
from stavpr_ros.mapping.trajectory import Trajectory
from stavpr_ros.ros import REPORT_PERIOD
from stavpr_ros.ros.input import BEST_EFFORT, subscribe
from stavpr_ros.ros.messages import camera_of, nanoseconds, pose_array
from stavpr_ros.sources.oddities import RECENT, speed_oddity

ODOMETRY = 'nav_msgs/msg/Odometry'
AT_THE_BASE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # pose of a camera without an offset


class OdometryInput:
    """
    The subscription to odometry, on the topic ``odom``.

    :param timeout: seconds for which the newest pose is valid.
    :param on_rejected: called for each message with an invalid pose or stamp.

    ``frame`` is the frame of the poses, ``child_frame`` the one whose poses they are.
    """

    def __init__(
        self, node: Node, timeout: float, on_rejected: Callable[[], None] = lambda: None
    ) -> None:
        importlib.import_module('scipy.spatial.transform')  # loads slowly: not at the first pose
        self.trajectory = Trajectory(timeout)
        self._node, self._timeout, self._on_rejected = node, timeout, on_rejected
        self._arrived: float | None = None
        self._last: deque[tuple[int, np.ndarray]] = deque(maxlen=RECENT)  # stamps and poses
        self.frame = self.child_frame = ''
        qos = QoSProfile(depth=50, reliability=BEST_EFFORT)
        self._subscription = subscribe(node, Odometry, 'odom', self._on_odometry, qos)

    def freshness(self) -> str:
        """Return ``fresh``, ``stale`` or ``never``, for the diagnostics."""
        if self._arrived is None:
            return 'never'
        return 'fresh' if time.monotonic() - self._arrived < max(2.0, self._timeout) else 'stale'

    def fault(self) -> str:
        """
        Return why nothing can arrive, as a wrong remapping; empty = nothing known.

        Odometry beside a topic ``map_to_odom`` is from a pose graph: its corrections, made from
        the loop closures, must not come back as odometry.
        """
        node, topic = self._node, self._subscription.topic_name
        types = sorted({info.topic_type for info in node.get_publishers_info_by_topic(topic)})
        if self.freshness() == 'fresh' or ODOMETRY in types:
            return ''
        topics_text = f'{", ".join(types)} is published' if types else 'nothing is published'
        topics = dict(node.get_topic_names_and_types())
        others = [
            name
            for name, kinds in topics.items()
            if ODOMETRY in kinds
            and node.count_publishers(name)
            and f'{name.rpartition("/")[0]}/map_to_odom' not in topics
        ]
        if not (types or others):
            return ''
        hint = f', odometry is on {", ".join(others)}' if others else ''
        return f'{topics_text} on {topic}{hint}: remap odom to the topic of the odometry'

    def oddities(self) -> list[str]:
        """Return what is odd about the last poses, for the diagnostics."""
        rows = list(self._last)
        text = speed_oddity(*map(np.array, zip(*rows, strict=True))) if rows else ''
        return [text] if text else []

    def close(self) -> None:
        """Unsubscribe from odometry."""
        self._node.destroy_subscription(self._subscription)

    def _on_odometry(self, message: Odometry) -> None:
        stamp, pose = nanoseconds(message.header.stamp), pose_array(message.pose.pose)
        try:
            self.trajectory.add(stamp, pose)
        except InputError as error:
            self._on_rejected()
            self._node.get_logger().warning(
                f'odometry rejected: {error}', throttle_duration_sec=REPORT_PERIOD
            )
            return
        self._last.append((stamp, pose))
        self._arrived = time.monotonic()
        self.frame, self.child_frame = message.header.frame_id, message.child_frame_id


class CameraInput:
    """
    The subscription to camera_info, and the transform from the camera to the base.

    The transform is from the parameter, else from tf where tf2_ros is installed, else of a camera
    at the base that looks ahead.

    :param transform: parameter camera_transform.

    ``problem`` is why the camera is unknown, ``assumed`` whether its transform is an assumption.
    """

    def __init__(self, node: Node, transform: str) -> None:
        self._node, self._fixed_mount = node, mount_of(transform)
        self._info: CameraInfo | None = None
        self._known: tuple[Any, ...] = ()  # message, frames and camera of the last call
        self.assumed = False
        topic = camera_info_topic(node)
        self.problem = f'nothing was received on {topic}'
        qos = QoSProfile(depth=1, reliability=BEST_EFFORT)
        self._subscription = subscribe(node, CameraInfo, topic, self._on_info, qos)
        self._tf: Any = None
        self._listener: Any = None
        if self._fixed_mount is None:
            try:
                from tf2_ros import Buffer, TransformListener
            except ImportError:
                return
            self._tf = Buffer()
            self._listener = TransformListener(self._tf, node)

    def yaw(self, base: str, frame: str) -> float:
        """
        Return the yaw of the optical axis in the base, radians to the left.

        While it is unknown, also without a frame of the base, the camera looks ahead: 0.
        """
        if self._fixed_mount is None and not base:
            return 0.0
        mount = self._mount(base, frame)
        return 0.0 if mount is None else yaw_of(mount)

    @property
    def state(self) -> str:
        """Return the problem, or that camera and transform are known, for the diagnostics."""
        return self.problem or ('known, transform assumed' if self.assumed else 'known')

    def oddities(self) -> list[str]:
        """Return what is odd about the intrinsics, for the diagnostics."""
        camera = self._known[3] if self._known else None
        return [camera.oddity] if camera and camera.oddity else []

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)
        if self._listener is not None:
            self._listener.unregister()

    def camera(self, base: str, frame: str) -> Camera | None:
        """
        Return the camera; None, and the ``problem``, while it is unknown.

        :param base: frame of the poses of the odometry, '' = unknown.
        :param frame: of the images.
        """
        info = self._info
        if info is None:
            return None
        if self._known[:3] != (info, base, frame):
            mount = self._mount(base, frame)
            if mount is None:
                return None
            try:
                self._known, self.problem = (info, base, frame, camera_of(info, mount)), ''
            except InputError as error:
                self._known = info, base, frame, None
                self.problem = f'camera_info: {error}'
                self._node.get_logger().warning(self.problem, throttle_duration_sec=REPORT_PERIOD)
        return self._known[3]

    def _on_info(self, info: CameraInfo) -> None:
        info.header.stamp = Time().to_msg()  # a new stamp alone is no change
        if info != self._info:
            self._info = info

    def _mount(self, base: str, frame: str) -> tuple[float, ...] | None:
        if self._fixed_mount is not None:
            return self._fixed_mount
        if base == frame:
            return AT_THE_BASE
        if self._tf is not None:
            return self._from_tf(base, frame)
        if not self.assumed:
            self.assumed = True
            self._node.get_logger().warning(
                'the transform from the camera to the base is unknown, since tf2_ros is not '
                'installed: a camera at the base that looks ahead is assumed; set camera_transform'
            )
        return FORWARD

    def _from_tf(self, base: str, frame: str) -> tuple[float, ...] | None:
        try:
            transform = self._tf.lookup_transform(base, frame, Time()).transform
        except Exception as error:  # tf2_ros is not importable everywhere, nor are its errors
            self.problem = (
                f'no transform from {frame!r} to {base!r} on tf ({error}): publish it, or set '
                'camera_transform'
            )
            self._node.get_logger().warning(self.problem, throttle_duration_sec=REPORT_PERIOD)
            return None
        p, o = transform.translation, transform.rotation
        return p.x, p.y, p.z, o.x, o.y, o.z, o.w


def camera_info_topic(node: Node) -> str:
    """Return the topic of the intrinsics: camera_info if remapped, else beside the images."""
    topic = node.resolve_topic_name('camera_info')
    plain = f'{node.get_namespace().rstrip("/")}/camera_info'
    beside = node.resolve_topic_name('image').rpartition('/')[0] + '/camera_info'
    return topic if topic != plain else beside
