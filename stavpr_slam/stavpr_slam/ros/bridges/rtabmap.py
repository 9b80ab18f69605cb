# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""RTAB-Map: edges by its service ``add_link``, or poses on a map by its topic ``global_pose``."""

from collections.abc import Mapping
from functools import partial
from pkgutil import resolve_name
from typing import Any, ClassVar

from nav_msgs.msg import Odometry
import numpy as np
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.errors import InputError, UnavailableError
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.ros.messages import nanoseconds, pose_array, transform_message
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph import body_covariance, ChainSettings, Closure, OdometryNoise
from stavpr_slam.pose_graph.keyframes import KeyframeChain
from stavpr_slam.pose_graph.transforms import adjoints, TRANSLATION_FIRST
from stavpr_slam.ros.bridges.bridge import Bridge
from stavpr_slam.ros.bridges.poses import PoseBridge
from stavpr_slam.ros.graph_messages import ODOMETRY_QOS

INTERFACES = 'rtabmap_msgs.msg:Info', 'rtabmap_msgs.msg:Link', 'rtabmap_msgs.srv:AddLink'
USER_CLOSURE = 4  # rtabmap::Link::kUserClosure
MAX_PENDING = 1000  # closures that wait for keyframes


class RtabmapBridge(Bridge):
    """
    Adds loop closures to the graph of RTAB-Map as user closures, between its keyframes.

    ``rtabmap/info`` has the nodes: ``ref_id`` at ``header.stamp``. RTAB-Map checks the graph with
    the new link (RGBD/OptimizeMaxError) and does not report the result.

    :raises UnavailableError: its messages are not installed.
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
        try:
            info, self._link, self._service = map(resolve_name, INTERFACES)
        except ImportError as error:
            raise UnavailableError(
                'this bridge requires the package rtabmap_msgs (ros-jazzy-rtabmap-msgs): install '
                'or build it, and source its workspace before the bridge is started'
            ) from error
        super().__init__()
        self._pending: list[Closure] = []
        self._sent: set[tuple[int, int]] = set()
        self._keyframes: dict[int, int] = {}  # numbers by stamp, ns
        self._odometry = KeyframeChain(ChainSettings(), OdometryNoise())
        self._client = self.create_client(self._service, 'rtabmap/add_link')
        self.create_subscription(Odometry, 'odom', self._on_odometry, ODOMETRY_QOS)
        self.create_subscription(info, 'rtabmap/info', self._on_info, 100)

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
            self._odometry.add(nanoseconds(message.header.stamp), pose_array(message.pose.pose))
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
        newest = max(self._keyframes, default=0)
        ready = [closure for closure in self._pending if closure.query_stamp <= newest]
        self._pending = [closure for closure in self._pending if closure.query_stamp > newest]
        gap = round(self.given['max_keyframe_gap'] * SECOND)
        near = partial(nearest, self._keyframes, self._odometry, gap)
        for closure in ready:
            query, place = map(near, (closure.query_stamp, closure.place_stamp))
            if query is None or place is None:
                self.counts['no_keyframe'] += 1
            elif (place[0], query[0]) in self._sent or place[0] == query[0]:
                self.counts['same_keyframes'] += 1
            else:
                self._sent.add((place[0], query[0]))
                transform, covariance = keyframe_edge(closure, place[1], query[1])
                link = self._link(from_id=place[0], to_id=query[0], type=USER_CLOSURE)
                link.transform = transform_message(to_poses(transform), '', '').transform
                link.information = np.linalg.inv(covariance)[TRANSLATION_FIRST].ravel()
                self._client.call_async(self._service.Request(link=link))
                self.counts['sent'] += 1


class GlobalPoseBridge(PoseBridge):
    """
    Publishes the pose on a map as ``global_pose``, a prior of RTAB-Map; without its messages.

    RTAB-Map takes ``frame_id`` as the frame whose pose it is, and ignores priors by default
    (Optimizer/PriorsIgnored).
    """

    NAME, TOPIC = 'rtabmap_global_pose', 'global_pose'

    def take(self, message: LoopClosure, closure: Closure) -> str:
        """Publish the pose of each independent closure."""
        if not closure.is_independent:
            return 'not_independent'
        return self.publish(message, closure, message.relative_pose.frame)


def nearest(
    keyframes: Mapping[int, int], odometry: KeyframeChain, max_gap: int, stamp: int
) -> tuple[int, np.ndarray] | None:
    """
    Return the nearest keyframe, and the transform (4, 4) from it to a stamp (ns).

    :param keyframes: their numbers by stamp, at least one.
    :param max_gap: ns between an image and its keyframe at most.
    :returns: None where the keyframe is not near, or its motion to the stamp is unknown.
    """
    best = min(keyframes, key=lambda own: abs(own - stamp))
    motion = odometry.motion(best, stamp) if best != stamp else np.eye(4)
    if abs(best - stamp) > max_gap or motion is None:
        return None
    return keyframes[best], motion


def keyframe_edge(
    closure: Closure, place: np.ndarray, query: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    Move a loop closure to the keyframes next to its images.

    :param place, query: transforms (4, 4) from the keyframe to the image, whose errors are left
        out.
    :returns: the pose of the query's keyframe in the frame of the place's, (4, 4), and its
        covariance in the axes of the query's, rotation first, (6, 6).
    """
    motion, turn = matrices(closure.pose), adjoints(query[None])[0]  # of twists in its axes
    covariance = turn @ body_covariance(closure.covariance, motion) @ turn.T
    return place @ motion @ inverse(query), covariance
