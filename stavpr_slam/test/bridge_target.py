# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Stand-in for the targets of the bridges, and for the recognition node, as a process of its own.

``bridge_target.py TARGET`` publishes a drive of two laps, its keyframes in the messages of the
target, and loop closures; it writes the edges that come back as JSON.
"""

import json
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.ros.messages import pose_message, time_message
from stavpr_slam.ros.graph_messages import pose_array
from test_pose_graph import circle, LAP, planar_poses, SECOND
from test_pose_graph_node import odometry_message

EDGES = 10
AHEAD = 3  # images that the place is ahead of the query
KEYFRAME = 4  # images, and a keyframe is 0.3 s after an image
DEVIATIONS = np.array([0.2, 0.1, 0.3, 0.01, 0.02, 0.03])
TIMEOUT = 120.0
QOS = QoSProfile(depth=1000)


def stamp_of(image: float) -> int:
    return round((image + 1) * SECOND)


class Drive:
    """Poses of two laps at any fraction of an image."""

    def __init__(self) -> None:
        self._poses = matrices(planar_poses(circle()))

    def at(self, image: float) -> np.ndarray:
        whole = int(image)
        angle = (image - whole) * 2 * np.pi / LAP
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        moved: np.ndarray = turn @ self._poses[whole]  # the circle is around the origin
        return moved


def closures(drive: Drive, on_map: bool) -> list[LoopClosure]:
    """Return closures with known errors; every other one is not independent, one is aligned."""
    found = []
    for i, query in enumerate(range(LAP + 1, LAP + 1 + 2 * EDGES * KEYFRAME, KEYFRAME)):
        place = query - LAP + AHEAD
        message = LoopClosure(query_index=-1 if on_map else query, place_index=place)
        message.has_relative_pose = message.has_poses = True
        message.query_pose = pose_message(to_poses(drive.at(query)))
        message.place_pose = pose_message(to_poses(drive.at(place)))
        message.pose_frame, relative = 'map', message.relative_pose
        relative.source, relative.is_independent = RelativePose.PNP, i % 2 == 0
        relative.query_stamp = message.query_stamp = time_message(stamp_of(query))
        relative.place_stamp = message.place_stamp = time_message(stamp_of(place))
        relative.frame = 'base_link'
        relative.pose.pose = pose_message(to_poses(inverse(drive.at(place)) @ drive.at(query)))
        relative.pose.covariance = np.diag(DEVIATIONS**2).ravel()
        found.append(message)
    found[2].relative_pose.source = RelativePose.ALIGNED
    return found


class Target(Node):
    """The target of one bridge."""

    def __init__(self, target: str) -> None:
        super().__init__('target')
        self.edges: list[dict] = []
        targets = {'rtabmap': self._rtabmap, 'hydra': self._hydra, 'kimera': self._kimera}
        self.keyframes = targets.get(target, self._swarm)()
        self.closures = self.create_publisher(LoopClosure, 'stavpr/loop_closure', QOS)
        self.odometry, self.other = (
            self.create_publisher(Odometry, topic, QOS) for topic in ('odom', 'place_odom')
        )
        self.received = False  # the bridge has received a closure
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            counts = {pair.key: pair.value for pair in status.values}
            self.received |= int(counts.get('closures', 0)) > 0

    def _rtabmap(self):
        from rtabmap_msgs.msg import Info
        from rtabmap_msgs.srv import AddLink

        def add_link(request, response):
            link = request.link
            t, o = link.transform.translation, link.transform.rotation
            pose = [t.x, t.y, t.z, o.x, o.y, o.z, o.w]
            information = np.array(link.information).reshape(6, 6)
            self._add(link.from_id, link.to_id, pose, np.linalg.inv(information), link.type)
            return response

        self.create_service(AddLink, 'rtabmap/add_link', add_link)
        publisher = self.create_publisher(Info, 'rtabmap/info', QOS)

        def publish(number: int, stamp: int, pose) -> None:
            message = Info(ref_id=number)
            message.header.stamp = time_message(stamp)
            publisher.publish(message)

        return publisher, publish

    def _hydra(self):
        """
        Interpret edges as Hydra does: between the nodes nearest to two stamps, within 1 s.

        MIT-SPARK/Hydra src/backend/external_loop_closure_receiver.cpp: key_from, key_to are stamps
        in ns, the pose is to_T_from; src/backend/backend_module.cpp: a between factor (to, from).
        """

        def add(edge) -> None:
            def nearest(key: int) -> int:
                assert key <= max(self.stamps.values())
                found = min(self.stamps, key=lambda number: abs(self.stamps[number] - key))
                assert abs(self.stamps[found] - key) < SECOND
                return found

            self._add_graph_edge(nearest(edge.key_to), nearest(edge.key_from), edge)

        return self._graph('pose_graph', 'external_loop_closures', add)

    def _kimera(self):
        """
        Interpret edges as Kimera does.

        MIT-SPARK/Kimera-PGMO kimera_pgmo/src/kimera_pgmo_interface.cpp: key_from, key_to are keys
        of nodes, the pose is from_T_to, a between factor (from, to).
        """

        def add(edge) -> None:
            assert {edge.key_from, edge.key_to} <= self.stamps.keys()
            self._add_graph_edge(edge.key_from, edge.key_to, edge)

        return self._graph('pose_graph_incremental', 'pose_graph_incremental', add)

    def _add_graph_edge(self, first: int, second: int, edge) -> None:
        assert (edge.robot_from, edge.robot_to, edge.type) == (3, 3, edge.LOOPCLOSE)
        covariance = np.array(edge.covariance).reshape(6, 6)
        self._add(first, second, pose_array(edge.pose), covariance, edge.type)

    def _graph(self, nodes: str, edges: str, add):
        from pose_graph_tools_msgs.msg import PoseGraph, PoseGraphNode

        self.stamps: dict[int, int] = {}  # of nodes, by their numbers

        def on_graph(message) -> None:
            for edge in message.edges:
                add(edge)

        self.create_subscription(PoseGraph, edges, on_graph, QOS)
        publisher = self.create_publisher(PoseGraph, nodes, QOS)

        def publish(number: int, stamp: int, pose) -> None:
            self.stamps[number] = stamp
            known = [PoseGraphNode(robot_id=robot, key=number + robot - 3) for robot in (3, 4)]
            for node in known:
                node.header.stamp = time_message(stamp)
            publisher.publish(PoseGraph(nodes=known))

        return publisher, publish

    def _swarm(self):
        from cslam_common_interfaces.msg import (
            InterRobotLoopClosure,
            IntraRobotLoopClosure,
            KeyframeOdom,
        )

        def on_closure(message) -> None:
            t, o = message.transform.translation, message.transform.rotation
            pose, within = [t.x, t.y, t.z, o.x, o.y, o.z, o.w], hasattr(message, 'keyframe0_id')
            assert message.success
            if within:
                numbers = message.keyframe0_id, message.keyframe1_id
            else:
                assert (message.robot0_id, message.robot1_id) == (1, 0)
                numbers = message.robot0_keyframe_id, message.robot1_keyframe_id
            self._add(*numbers, pose, np.eye(6), 0 if within else 1)

        for kind, topic in (
            (IntraRobotLoopClosure, 'cslam/intra_robot_loop_closure'),
            (InterRobotLoopClosure, '/cslam/inter_robot_loop_closure'),
        ):
            self.create_subscription(kind, topic, on_closure, QOS)
        publishers = [
            self.create_publisher(KeyframeOdom, topic, QOS)
            for topic in ('cslam/keyframe_odom', '/r1/cslam/keyframe_odom')
        ]

        def publish(number: int, stamp: int, pose) -> None:
            message = KeyframeOdom(id=number)
            message.odom = odometry_message(stamp, to_poses(pose))
            for publisher in publishers:
                publisher.publish(message)

        return publishers[0], publish

    def _add(self, first: int, second: int, pose, covariance: np.ndarray, kind: int) -> None:
        """Note an edge; pose: of the second node in the frame of the first one."""
        deviations = np.sqrt(np.linalg.eigvalsh(covariance)).tolist()
        self.edges.append(
            {
                'nodes': [first, second], 'pose': np.asarray(pose).tolist(), 'type': kind,
                'deviations': deviations,
            }
        )  # fmt: skip


def main(target: str, on_map: bool) -> None:
    rclpy.init()
    node, drive = Target(target), Drive()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    publisher, publish = node.keyframes

    def wait_until(done) -> None:
        end = time.monotonic() + TIMEOUT
        while not done() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)

    wait_until(
        lambda: all(
            each.get_subscription_count() for each in (publisher, node.odometry, node.closures)
        )
    )
    while not node.received:  # the bridge may not know these publishers yet
        node.closures.publish(LoopClosure())  # has no relative pose: becomes no edge
        executor.spin_once(timeout_sec=0.2)
    for message in closures(drive, on_map):
        node.closures.publish(message)
    for image in range(2 * LAP - 1):
        for each in (node.odometry, node.other):
            each.publish(odometry_message(stamp_of(image), to_poses(drive.at(image))))
        if image % KEYFRAME == 0:  # known before the odometry after it
            publish(image // KEYFRAME + 1, stamp_of(image + 0.3), drive.at(image + 0.3))
        executor.spin_once(timeout_sec=0.01)
    expected = EDGES - (target == 'swarm_slam')
    wait_until(lambda: len(node.edges) >= expected)
    for _ in range(10):  # for edges too many
        executor.spin_once(timeout_sec=0.05)
    print(json.dumps(node.edges), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main(sys.argv[1], 'map' in sys.argv[2:])
