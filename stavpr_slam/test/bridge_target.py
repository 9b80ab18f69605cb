# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Stand-in for RTAB-Map, and for the recognition node, as a process of its own.

``bridge_target.py`` publishes a drive of two laps, its keyframes in the messages of RTAB-Map, and
loop closures; it writes the edges that come back as JSON.
"""

import json
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
    result = []
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
        result.append(message)
    result[2].relative_pose.source = RelativePose.ALIGNED
    return result


class Target(Node):
    """RTAB-Map, as far as the bridge uses it."""

    def __init__(self) -> None:
        from rtabmap_msgs.msg import Info
        from rtabmap_msgs.srv import AddLink

        super().__init__('target')
        self.edges: list[dict] = []
        self.create_service(AddLink, 'rtabmap/add_link', self._add_link)
        self.keyframes = self.create_publisher(Info, 'rtabmap/info', QOS)
        self.closures = self.create_publisher(LoopClosure, 'stavpr/loop_closure', QOS)
        self.odometry = self.create_publisher(Odometry, 'odom', QOS)
        self.received = False  # the bridge has received a closure
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            counts = {pair.key: pair.value for pair in status.values}
            self.received |= int(counts.get('closures', 0)) > 0

    def _add_link(self, request, response):
        """Note an edge: the pose of the second node in the frame of the first one."""
        link = request.link
        t, o = link.transform.translation, link.transform.rotation
        covariance = np.linalg.inv(np.array(link.information).reshape(6, 6))
        self.edges.append({
            'nodes': [link.from_id, link.to_id], 'pose': [t.x, t.y, t.z, o.x, o.y, o.z, o.w],
            'type': link.type, 'deviations': np.sqrt(np.linalg.eigvalsh(covariance)).tolist(),
        })  # fmt: skip
        return response

    def publish_keyframe(self, number: int, stamp: int) -> None:
        message = self.keyframes.msg_type(ref_id=number)
        message.header.stamp = time_message(stamp)
        self.keyframes.publish(message)


def main() -> None:
    rclpy.init()
    node, drive = Target(), Drive()
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def wait_until(done) -> None:
        end = time.monotonic() + TIMEOUT
        while not done() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)

    publishers = node.keyframes, node.odometry, node.closures
    wait_until(lambda: all(endpoint.get_subscription_count() for endpoint in publishers))
    while not node.received:  # the bridge may not know these publishers yet
        node.closures.publish(LoopClosure())  # has no relative pose: becomes no edge
        executor.spin_once(timeout_sec=0.2)
    for message in closures(drive, on_map=False):
        node.closures.publish(message)
    for image in range(2 * LAP - 1):
        node.odometry.publish(odometry_message(stamp_of(image), to_poses(drive.at(image))))
        if image % KEYFRAME == 0:  # known before the odometry after it
            node.publish_keyframe(image // KEYFRAME + 1, stamp_of(image + 0.3))
        executor.spin_once(timeout_sec=0.01)
    wait_until(lambda: len(node.edges) >= EDGES)
    for _ in range(10):  # for edges too many
        executor.spin_once(timeout_sec=0.05)
    print(json.dumps(node.edges), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
