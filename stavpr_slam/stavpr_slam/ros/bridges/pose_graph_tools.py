# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""``pose_graph_tools_msgs/PoseGraph`` for Hydra and Kimera, with edges of opposite directions."""

from typing import Any, ClassVar

from stavpr_msgs.msg import LoopClosure
from stavpr_ros.mapping.transforms import to_poses
from stavpr_ros.ros.messages import nanoseconds, pose_message
from stavpr_slam.ros.bridges.bridge import EdgeBridge, interfaces
from stavpr_slam.ros.bridges.external_keyframes import KeyframeEdge
from std_msgs.msg import Header


class PoseGraphToolsBridge(EdgeBridge):
    """Publishes each loop closure as a ``PoseGraph`` of one edge."""

    NODES: ClassVar[str]  # topic of the nodes
    EDGES: ClassVar[str]  # topic of the edges
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
        self._publisher = self.create_publisher(kind, self.EDGES, 100)
        self.create_subscription(kind, self.NODES, self._on_graph, 100)

    def key(self, node: Any) -> int:
        """Return what an edge names a ``PoseGraphNode`` by."""
        raise NotImplementedError

    def direct(self, edge: Any, place: tuple[int, int], query: tuple[int, int]) -> None:
        """Set the ends of a ``PoseGraphEdge``, key and robot, whose pose is place_T_query."""
        raise NotImplementedError

    def _on_graph(self, message: Any) -> None:
        self.add_keyframes(
            (node.robot_id, nanoseconds(node.header.stamp), self.key(node))
            for node in message.nodes
        )

    def send(self, edge: KeyframeEdge, message: LoopClosure) -> None:
        """Publish the edge."""
        kind = self._messages.PoseGraphEdge
        header = Header(stamp=message.relative_pose.query_stamp, frame_id=message.pose_frame)
        own = kind(header=header, type=kind.LOOPCLOSE)
        own.pose = pose_message(to_poses(edge.transform))
        own.covariance = edge.covariance.ravel()
        self.direct(own, (edge.place, self.place_robot), (edge.query, self.robot))
        self._publisher.publish(self._messages.PoseGraph(header=header, edges=[own]))


class HydraBridge(PoseGraphToolsBridge):
    """
    Publishes loop closures on ``external_loop_closures`` of Hydra.

    Its keys are the stamps of its agent nodes (ns), those on ``pose_graph`` (its topic
    ``backend/pose_graph``), and its pose is to_T_from.
    """

    NAME, NODES, EDGES = 'hydra', 'pose_graph', 'external_loop_closures'

    def key(self, node: Any) -> int:
        """Return the stamp of a node, ns."""
        return nanoseconds(node.header.stamp)

    def direct(self, edge: Any, place: tuple[int, int], query: tuple[int, int]) -> None:
        """Direct the edge from the query to the place."""
        edge.key_from, edge.robot_from = query
        edge.key_to, edge.robot_to = place


class KimeraBridge(PoseGraphToolsBridge):
    """
    Publishes loop closures on ``pose_graph_incremental`` of Kimera-PGMO and Kimera-Distributed.

    Its keys are those of the nodes of Kimera-VIO on the same topic, and its pose is from_T_to.
    """

    NAME, NODES, EDGES = 'kimera', 'pose_graph_incremental', 'pose_graph_incremental'

    def key(self, node: Any) -> int:
        """Return the key of a node."""
        return int(node.key)

    def direct(self, edge: Any, place: tuple[int, int], query: tuple[int, int]) -> None:
        """Direct the edge from the place to the query."""
        edge.key_from, edge.robot_from = place
        edge.key_to, edge.robot_to = query
