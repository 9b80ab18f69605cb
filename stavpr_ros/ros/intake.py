# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The way in: the subscriptions of an active node, and what they know of an image."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import Map
from stavpr_ros.mapping.camera import FORWARD, mount_of, yaw_of
from stavpr_ros.pipeline import NodeSettings
from stavpr_ros.pipeline.statistics import Statistics
from stavpr_ros.ros.input import ImageInput
from stavpr_ros.ros.messages import nanoseconds, Places, Surroundings
from stavpr_ros.ros.rclpy_workarounds import ManagedNode
from stavpr_ros.ros.sensors import CameraInput, OdometryInput
from std_msgs.msg import Header


class Intake:
    """
    The subscriptions to images, odometry and camera_info, each while it is needed.

    :param callbacks: enqueue, reject and restart of :class:`stavpr_ros.ros.input.ImageInput`.

    ``problem`` is the error of the last subscription to odometry, '' = none.
    """

    def __init__(
        self, node: ManagedNode, statistics: Statistics, *callbacks: Callable[..., None]
    ) -> None:
        self._node, self._statistics, self._callbacks = node, statistics, callbacks
        self.images: ImageInput | None = None
        self.odometry: OdometryInput | None = None
        self.camera: CameraInput | None = None
        self.problem = ''

    def open(self, settings: NodeSettings, places: Places) -> None:
        """
        Subscribe; images last.

        :param places: in use.
        :raises SettingsError: invalid qos_overrides.
        """
        self.follow_odometry(settings, places)
        if settings.relative_pose in ('auto', 'pnp'):
            self.camera = CameraInput(self._node, settings.camera_transform)
        self.images = ImageInput(self._node, settings, self._statistics, *self._callbacks)

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in (self.images, self.odometry, self.camera):
            if subscription is not None:
                subscription.close()
        self.images = self.odometry = self.camera = None

    def change(self, settings: NodeSettings, places: Places) -> None:
        """Apply live parameters; an error of odometry is logged and kept as the problem."""
        if self.images is None:
            return
        self.images.max_rate = settings.max_rate
        self.images.stamps.gap = settings.max_stamp_gap
        try:
            self.follow_odometry(settings, places)
            self.problem = ''
        except SettingsError as error:
            self.problem = str(error)
            self._node.get_logger().error(self.problem)

    def clear(self) -> None:
        """Forget the poses of the odometry: the stamps jumped back."""
        if (odometry := self.odometry) is not None:  # another thread may unsubscribe
            odometry.trajectory.clear()

    def surroundings(self, header: Header, settings: NodeSettings, on_route: bool) -> Surroundings:
        """
        Return what is known of an image; another thread may unsubscribe meanwhile.

        :param on_route: the places have the poses of the odometry.
        """
        odometry, camera = self.odometry, self.camera
        about = Surroundings(settings.map_frame)
        if odometry is not None:
            about = Surroundings(
                odometry.frame if on_route else settings.map_frame,
                odometry.child_frame,
                odometry.frame,
                odometry.trajectory.at(nanoseconds(header.stamp)),
            )
        image_camera = None if camera is None else camera.camera(about.child, header.frame_id)
        return replace(about, camera=image_camera)

    def yaw(self, base: str, frame: str, settings: NodeSettings) -> float:
        """Return the yaw of the camera of these frames in the base, radians to the left."""
        if (camera := self.camera) is None:
            return yaw_of(mount_of(settings.camera_transform) or FORWARD)
        return camera.yaw(base, frame)

    def odometry_fault(self) -> str:
        """Return why no odometry can arrive, '' = nothing known."""
        odometry = self.odometry  # another thread may unsubscribe
        return '' if odometry is None else odometry.fault()

    def state(self) -> dict[str, Any]:
        """Return the fields of :class:`stavpr_ros.ros.health.Health` on the subscriptions."""
        images, odometry, camera = self.images, self.odometry, self.camera
        fields: dict[str, Any] = {'odometry_fault': self.odometry_fault()}
        if images is not None:
            fields['input'] = images.status()
        if odometry is not None:
            fields['odometry'] = odometry.freshness()
        if camera is not None:
            fields['camera'] = camera.state
        inputs = [part for part in (images, odometry, camera) if part is not None]
        return fields | {'oddities': tuple(text for part in inputs for text in part.oddities())}

    def follow_odometry(self, settings: NodeSettings, places: Places) -> None:
        """Subscribe to odometry while it is needed."""
        is_compared = settings.pipeline.compares_odometry
        needs_odometry = settings.needs_odometry or (  # edges to places of a map, and their paths
            (settings.relative_pose in ('auto', 'aligned') or is_compared)
            and isinstance(places, Map)
            and places.has_poses
        )
        if needs_odometry and self.odometry is None:
            on_rejected = self._statistics.add_odometry_rejected
            self.odometry = OdometryInput(self._node, settings.odometry_timeout, on_rejected)
        elif not needs_odometry and self.odometry is not None:
            self.odometry.close()
            self.odometry = None
