# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""RTAB-Map: edges by its service ``add_link``, or poses on a map by its topic ``global_pose``."""

from functools import partial
from typing import Any, ClassVar

from nav_msgs.msg import Odometry
import numpy as np
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.errors import InputError
from stavpr_ros.mapping.transforms import to_poses
from stavpr_ros.ros.messages import nanoseconds, odometry_pose, transform_message
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph import body_covariance, ChainSettings, Closure, OdometryNoise
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.transforms import TRANSLATION_FIRST
from stavpr_slam.ros.bridges.bridge import Bridge, interfaces
from stavpr_slam.ros.bridges.external_keyframes import keyframe_edge, nearest
from stavpr_slam.ros.bridges.poses import PoseBridge
from stavpr_slam.ros.graph_messages import ODOMETRY_QOS

PACKAGE = 'rtabmap_msgs', 'ros-jazzy-rtabmap-msgs'
USER_CLOSURE = 4  # rtabmap::Link::kUserClosure
MAX_PENDING = 1000  # closures that wait for keyframes


class RtabmapBridge(Bridge):
    """
    Adds loop closures to the graph of RTAB-Map as user closures, between its keyframes.

    ``rtabmap/info`` has the nodes: ``ref_id`` at ``header.stamp``. RTAB-Map checks the graph with
    the new link (RGBD/OptimizeMaxError) and does not report the result.
    """

    NAME, IS_ON_MAP = 'rtabmap', False
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {
        'max_keyframe_gap': (2.0, 'seconds between an image and its keyframe at most, above 0'),
        'independent_only': (
            True,
            'only edges whose errors do not correlate with those of the edge before',
        ),
        'pnp_only': (False, 'only edges by PnP, none that are aligned by odometry'),
    }

    def __init__(self) -> None:
        self._messages: Any = interfaces(*PACKAGE, 'msg')
        self._service: Any = interfaces(*PACKAGE, 'srv').AddLink
        super().__init__()
        self._pending: list[Closure] = []
        self._sent: set[tuple[int, int]] = set()
        self._keyframes: dict[int, int] = {}  # numbers by stamp, ns
        self._odometry = KeyframeChain(ChainSettings(), OdometryNoise())
        self._client = self.create_client(self._service, 'rtabmap/add_link')
        self.create_subscription(Odometry, 'odom', self._on_odometry, ODOMETRY_QOS)
        self.create_subscription(self._messages.Info, 'rtabmap/info', self._on_info, 100)

    def on_timer(self) -> None:
        """Send what waited for RTAB-Map, and publish the diagnostics."""
        self._send_pending()
        self.counts['waiting'] = len(self._pending)
        self.counts['keyframes'] = len(self._keyframes)
        super().on_timer()

    def _on_info(self, message: Any) -> None:
        stamp = nanoseconds(message.header.stamp)
        if message.ref_id > 0 and stamp > 0:
            self._keyframes[stamp] = message.ref_id
        self._send_pending()

    def _on_odometry(self, message: Odometry) -> None:
        try:
            self._odometry.add(nanoseconds(message.header.stamp), odometry_pose(message))
        except InputError as error:
            self.counts['invalid_odometry'] += 1
            self.get_logger().warning(f'odometry rejected: {error}', throttle_duration_sec=10.0)

    def take(self, message: LoopClosure, closure: Closure) -> str:
        """Queue a closure until its keyframes are known."""
        if self.given['independent_only'] and not closure.is_independent:
            return 'not_independent'
        self._pending.append(closure)
        if len(self._pending) > MAX_PENDING:
            del self._pending[0]
            self.counts['no_keyframe'] += 1
        self._send_pending()
        return ''

    def _send_pending(self) -> None:
        """Request the links whose keyframes are known; later ones wait."""
        if not self._client.service_is_ready():
            return
        waiting, newest = [], max(self._keyframes, default=0)
        gap = round(self.given['max_keyframe_gap'] * SECOND)
        near = partial(nearest, self._keyframes, self._odometry, gap)
        for closure in self._pending:
            if closure.query_stamp > newest:
                waiting.append(closure)
                continue
            query, place = map(near, (closure.query_stamp, closure.place_stamp))
            if query is None or place is None:
                self.counts['no_keyframe'] += 1
            elif (place[0], query[0]) in self._sent or place[0] == query[0]:
                self.counts['same_keyframes'] += 1
            else:
                self._sent.add((place[0], query[0]))
                transform, covariance = keyframe_edge(closure, place[1], query[1])
                link = self._messages.Link(from_id=place[0], to_id=query[0], type=USER_CLOSURE)
                link.transform = transform_message(to_poses(transform), '', '').transform
                information = np.linalg.inv(body_covariance(covariance, transform))
                link.information = information[TRANSLATION_FIRST].ravel()
                self._client.call_async(self._service.Request(link=link))
                self.counts['sent'] += 1
        self._pending = waiting


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
