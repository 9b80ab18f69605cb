# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The camera of the images: intrinsics from camera_info, and its place on the robot."""

import math
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo
from stavpr_ros.errors import InputError, SettingsError
from stavpr_ros.mapping.camera import Camera, FORWARD
from stavpr_ros.ros.subscriptions import subscribe

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
REPORT_PERIOD = 10.0  # seconds between repeated warnings


def mount_of(text: str) -> tuple[float, ...] | None:
    """
    Return the pose that parameter camera_transform states, None for an empty one.

    :param text: x y z and roll pitch yaw (fixed axes, radians), or a quaternion x y z w.
    :raises SettingsError: something else.
    """
    if not text.strip():
        return None
    try:
        numbers = [float(word) for word in text.replace(',', ' ').split()]
    except ValueError:
        numbers = []
    if len(numbers) == 6:
        numbers[3:] = Rotation.from_euler('xyz', numbers[3:]).as_quat().tolist()
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)) or not any(numbers[3:]):
        raise SettingsError(
            f'camera_transform = {text!r}: expected x y z roll pitch yaw, or x y z and a '
            'quaternion x y z w'
        )
    return tuple(numbers)


def camera_of(info: CameraInfo, mount: tuple[float, ...]) -> Camera:
    """
    Return the camera that a message describes, as its images are: binned, and cut out.

    :raises InputError: it is not calibrated, or the numbers are invalid.
    """
    bins, roi, k = (max(info.binning_x, 1), max(info.binning_y, 1)), info.roi, info.k
    distorted = any(info.d)
    return Camera(
        width=(roi.width or info.width) // bins[0],
        height=(roi.height or info.height) // bins[1],
        focal=(float(k[0]) / bins[0], float(k[4]) / bins[1]),
        center=(  # centers of pixels are whole numbers
            (float(k[2]) - roi.x_offset + 0.5) / bins[0] - 0.5,
            (float(k[5]) - roi.y_offset + 0.5) / bins[1] - 0.5,
        ),
        model=info.distortion_model if distorted else '',
        distortion=tuple(map(float, info.d)) if distorted else (),
        mount=mount,
    )


class CameraInput:
    """
    The subscription to camera_info, and the transform from the camera to the base.

    The transform is that of the parameter, else of tf where tf2_ros is installed, else of a camera
    at the base that looks ahead.

    :param transform: parameter camera_transform.

    ``problem`` is why the camera is unknown, ``assumed`` whether its transform is an assumption.
    """

    def __init__(self, node: Node, transform: str) -> None:
        self._node, self._given = node, mount_of(transform)
        self._info: CameraInfo | None = None
        self._known: tuple[Any, ...] = ()  # message, frames and camera of the last call
        self.assumed = False
        topic = _topic(node)
        self.problem = f'nothing was received on {topic}'
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._subscription = subscribe(node, CameraInfo, topic, self._on_info, qos)
        self._tf: Any = None
        self._listener: Any = None
        if self._given is None:
            try:
                from tf2_ros import Buffer, TransformListener
            except ImportError:
                return
            self._tf = Buffer()
            self._listener = TransformListener(self._tf, node)

    @property
    def state(self) -> str:
        """Return the problem, or that camera and transform are known, for the diagnostics."""
        return self.problem or ('known, transform assumed' if self.assumed else 'known')

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
        camera: Camera | None = self._known[3]
        return camera

    def _on_info(self, info: CameraInfo) -> None:
        info.header.stamp = Time().to_msg()  # a new stamp alone is no change
        if info != self._info:
            self._info = info

    def _mount(self, base: str, frame: str) -> tuple[float, ...] | None:
        if self._given is not None:
            return self._given
        if base == frame:
            return IDENTITY
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
            found = self._tf.lookup_transform(base, frame, Time()).transform
        except Exception as error:  # tf2_ros is not importable everywhere, nor are its errors
            self.problem = (
                f'no transform from {frame!r} to {base!r} on tf ({error}): publish it, or set '
                'camera_transform'
            )
            self._node.get_logger().warning(self.problem, throttle_duration_sec=REPORT_PERIOD)
            return None
        p, o = found.translation, found.rotation
        return p.x, p.y, p.z, o.x, o.y, o.z, o.w


def _topic(node: Node) -> str:
    """Return the topic: camera_info if that is remapped, else the one beside the images."""
    own = node.resolve_topic_name('camera_info')
    plain = f'{node.get_namespace().rstrip("/")}/camera_info'
    beside = node.resolve_topic_name('image').rpartition('/')[0] + '/camera_info'
    return own if own != plain else beside
