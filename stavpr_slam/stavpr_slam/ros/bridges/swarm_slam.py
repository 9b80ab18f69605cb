# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Swarm-SLAM: loop closures within a robot and between two."""

from typing import Any, ClassVar

from stavpr_msgs.msg import LoopClosure
from stavpr_ros.ros.messages import nanoseconds
from stavpr_slam.ros.bridges.bridge import EdgeBridge, interfaces
from stavpr_slam.ros.bridges.external_keyframes import KeyframeEdge
from stavpr_slam.ros.bridges.rtabmap import transform_of


class SwarmSlamBridge(EdgeBridge):
    """
    Publishes loop closures by PnP as those of Swarm-SLAM.

    Its messages have no covariance, and its back end gives all closures the same (0.1 m and 0.01
    rad): those that are aligned by odometry are less accurate, and always left out. The keyframes
    are those of ``cslam/keyframe_odom``, for another robot of ``/rN/cslam/keyframe_odom``.
    """

    NAME = 'swarm_slam'
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {
        'max_keyframe_gap': EdgeBridge.PARAMETERS['max_keyframe_gap'],
        'independent_only': EdgeBridge.PARAMETERS['independent_only'],
        **EdgeBridge.ROBOTS,
    }

    def __init__(self) -> None:
        self._messages: Any = interfaces(
            'cslam_common_interfaces', 'https://github.com/lajoiepy/cslam_interfaces'
        )
        super().__init__()
        self.given['pnp_only'] = True
        kinds, own, other = self._messages, self.robot, self.place_robot
        self._intra = self.create_publisher(
            kinds.IntraRobotLoopClosure, 'cslam/intra_robot_loop_closure', 100
        )
        self._inter = self.create_publisher(
            kinds.InterRobotLoopClosure, '/cslam/inter_robot_loop_closure', 100
        )
        topics = {other: f'/r{other}/cslam/keyframe_odom', own: 'cslam/keyframe_odom'}
        for robot, topic in topics.items():
            self.create_subscription(
                kinds.KeyframeOdom,
                topic,
                lambda message, robot=robot: self._on_keyframe_odom(message, robot),
                1000,
            )

    def _on_keyframe_odom(self, message: Any, robot: int) -> None:
        self.add_keyframes([(robot, nanoseconds(message.odom.header.stamp), message.id)])

    def send(self, edge: KeyframeEdge, message: LoopClosure) -> None:
        """Publish the closure; keyframe 0 is the place."""
        transform = transform_of(edge.transform)
        if self.place_robot == self.robot:
            self._intra.publish(
                self._messages.IntraRobotLoopClosure(
                    keyframe0_id=edge.place,
                    keyframe1_id=edge.query,
                    success=True,
                    transform=transform,
                )
            )
            return
        self._inter.publish(
            self._messages.InterRobotLoopClosure(
                robot0_id=self.place_robot,
                robot0_keyframe_id=edge.place,
                robot1_id=self.robot,
                robot1_keyframe_id=edge.query,
                success=True,
                transform=transform,
            )
        )
