# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The description of the map in use, and its publisher."""

from collections.abc import Callable
import threading

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.node import Node
from stavpr_msgs.msg import MapInfo
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, PlaceMap
from stavpr_ros.mapping.map_version2 import VERSION
from stavpr_ros.ros.output import LATCHED, origin
from std_msgs.msg import Header


def map_info_message(
    operation: str,
    state: str,
    path: str,
    places: PlaceMap | GrowingMap | None,
    extractor: FeatureExtractor | None,
    stamp: Time,
    robot_id: str = '',
) -> MapInfo:
    """Return the description of the map in use."""
    message = MapInfo(
        header=Header(stamp=stamp),
        **origin(robot_id, places),
        operation=operation,
        state=state,
        path=path,
        format_version=VERSION,
    )
    if extractor is not None:
        settings = extractor.settings
        message.features, message.settings = settings.kind, settings.to_json()
        message.feature_version = settings.feature_version
        message.strips = settings.strips
        message.projected = settings.projection is not None
    if places is not None:
        message.places = len(places)
        message.sessions = [session.id for session in places.sessions]
        if len(places):
            message.dimension = places.dimension
        message.has_stamps, message.has_ids = bool(np.any(places.stamps)), any(places.ids)
        message.has_poses = places.poses is not None and bool(np.isfinite(places.poses).any())
        message.has_thumbnails = any(places.thumbnails)
    return message


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
