# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``pose_graph_tools_msgs/PoseGraph``, as in Kimera and Hydra."""

from typing import Any, ClassVar

from stavpr_msgs.msg import LoopClosure
from stavpr_ros.mapping.transforms import to_poses
from stavpr_ros.ros.output import nanoseconds, pose_message
from stavpr_slam.pose_graph.foreign import KeyframeEdge
from stavpr_slam.ros.bridges.bridge import EdgeBridge, interfaces
from std_msgs.msg import Header


class PoseGraphToolsBridge(EdgeBridge):
    """
    Publishes each loop closure as a ``PoseGraph`` of one edge on ``external_loop_closures``.

    The nodes are those of the graphs on ``pose_graph``: ``key`` at ``header.stamp``.
    """

    NAME = 'pose_graph_tools'
    PARAMETERS: ClassVar[dict[str, tuple[Any, str]]] = {
        **EdgeBridge.PARAMETERS,
        **EdgeBridge.ROBOTS,
    }

    def __init__(self) -> None:
        self._messages: Any = interfaces(
            'pose_graph_tools_msgs', 'https://github.com/MIT-SPARK/pose_graph_tools'
        )
        super().__init__()
        kind = self._messages.PoseGraph
        self._publisher = self.create_publisher(kind, 'external_loop_closures', 100)
        self.create_subscription(kind, 'pose_graph', self._on_graph, 100)

    def _on_graph(self, message: Any) -> None:
        for node in message.nodes:
            self.on_keyframe(node.robot_id, nanoseconds(node.header.stamp), node.key)

    def send(self, edge: KeyframeEdge, message: LoopClosure) -> None:
        """Publish the edge from the place to the query."""
        kind = self._messages.PoseGraphEdge
        header = Header(stamp=message.relative_pose.query_stamp, frame_id=message.pose_frame)
        own = kind(header=header, type=kind.LOOPCLOSE)
        own.key_from, own.key_to = edge.place, edge.query
        own.robot_from, own.robot_to = self.place_robot, self.robot
        own.pose = pose_message(to_poses(edge.transform))
        own.covariance = edge.covariance.ravel()
        self._publisher.publish(self._messages.PoseGraph(header=header, edges=[own]))
