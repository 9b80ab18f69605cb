# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses on a map, for filters and priors: ``geometry_msgs/PoseWithCovarianceStamped``."""

from typing import Any, ClassVar

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from stavpr_msgs.msg import LoopClosure
from stavpr_ros.mapping.transforms import matrices, to_poses
from stavpr_ros.ros.messages import pose_message
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph import Closure
from stavpr_slam.ros.bridges.bridge import Bridge


class PoseBridge(Bridge):
    """
    Publishes the pose of the query in the frame of the map, by the place and the relative pose.

    The covariance is of the relative pose; the poses of the map count as exact.
    """

    TOPIC: ClassVar[str]
    IS_ON_MAP = True
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {
        'pnp_only': (False, 'only poses by PnP, none that are aligned by odometry'),
    }

    def __init__(self) -> None:
        super().__init__()
        self._publisher = self.create_publisher(PoseWithCovarianceStamped, self.TOPIC, 10)

    def publish(self, message: LoopClosure, closure: Closure, frame: str) -> str:
        """Publish the pose of a closure on a map, in a frame of this name; return no cause."""
        assert closure.place_pose is not None
        place = matrices(closure.place_pose)
        turn = np.kron(np.eye(2), place[:3, :3])
        result = PoseWithCovarianceStamped()
        result.header.stamp = message.relative_pose.query_stamp
        result.header.frame_id = frame
        result.pose.pose = pose_message(to_poses(place @ matrices(closure.pose)))
        result.pose.covariance = (turn @ closure.covariance @ turn.T).ravel()
        self._publisher.publish(result)
        self.counts['sent'] += 1
        return ''


class RobotLocalizationBridge(PoseBridge):
    """
    Publishes ``~/pose`` for a ``poseN`` of robot_localization, once per relocalization.

    It waits for a subscriber. Errors of successive poses correlate: a filter that fuses each of
    them becomes too certain.
    """

    NAME, TOPIC = 'robot_localization', '~/pose'
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {
        **PoseBridge.PARAMETERS,
        'relocalization_gap': (
            10.0,
            'seconds without a match on the map after which the next one is published, above 0',
        ),
    }

    def __init__(self) -> None:
        super().__init__()
        self._gap = round(self.given['relocalization_gap'] * SECOND)
        self._last = -self._gap - 1

    def take(self, message: LoopClosure, closure: Closure) -> str:
        """Publish the pose of the first closure after a gap."""
        stamp = closure.query_stamp
        is_new = not 0 <= stamp - self._last <= self._gap
        if not self._publisher.get_subscription_count():  # a filter that starts later needs one
            self._last = -self._gap - 1
            return 'without_subscriber'
        self._last = stamp
        return self.publish(message, closure, message.pose_frame) if is_new else 'not_relocalized'
