# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""RTAB-Map: edges by its service ``add_link``, or poses on a map by its topic ``global_pose``."""

from typing import Any

from geometry_msgs.msg import Transform
import numpy as np
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.mapping.transforms import to_poses
from stavpr_ros.ros.messages import nanoseconds, transform_message
from stavpr_slam.ros.bridges.bridge import EdgeBridge, interfaces
from stavpr_slam.ros.bridges.external_keyframes import body_information, KeyframeEdge
from stavpr_slam.ros.bridges.poses import PoseBridge

PACKAGE = 'rtabmap_msgs', 'ros-jazzy-rtabmap-msgs'
USER_CLOSURE = 4  # rtabmap::Link::kUserClosure


def transform_of(transform: np.ndarray) -> Transform:
    """Return a transform (4, 4) as a message."""
    return transform_message(to_poses(transform), '', '').transform


class RtabmapBridge(EdgeBridge):
    """
    Adds loop closures to the graph of RTAB-Map as user closures.

    The nodes are those of ``rtabmap/info``: ``ref_id`` at ``header.stamp``. RTAB-Map checks the
    graph with the new link (RGBD/OptimizeMaxError) and does not report the result.
    """

    NAME = 'rtabmap'

    def __init__(self) -> None:
        self._messages: Any = interfaces(*PACKAGE)
        self._service: Any = interfaces(*PACKAGE, 'srv').AddLink
        super().__init__()
        self._client = self.create_client(self._service, 'rtabmap/add_link')
        self.create_subscription(self._messages.Info, 'rtabmap/info', self._on_info, 100)

    def ready(self) -> bool:
        """Return whether the service is there."""
        return bool(self._client.service_is_ready())

    def _on_info(self, message: Any) -> None:
        if message.ref_id > 0:
            self.add_keyframe(nanoseconds(message.header.stamp), message.ref_id)

    def send(self, edge: KeyframeEdge, message: LoopClosure) -> None:
        """Request the link from the place to the query."""
        link = self._messages.Link(from_id=edge.place, to_id=edge.query, type=USER_CLOSURE)
        link.transform = transform_of(edge.transform)
        link.information = body_information(edge).ravel()
        self._client.call_async(self._service.Request(link=link))


class GlobalPoseBridge(PoseBridge):
    """
    Publishes the pose on a map as ``global_pose``, a prior of RTAB-Map; without its messages.

    RTAB-Map takes ``frame_id`` as the frame whose pose it is, and ignores priors by default
    (Optimizer/PriorsIgnored).
    """

    NAME, TOPIC = 'rtabmap_global_pose', 'global_pose'

    def frame(self, message: LoopClosure) -> str:
        """Return the frame of the base."""
        return str(message.relative_pose.frame)
