# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The node of the pose graph as a process, with laps on a circle: what a controller receives.

Delays are from the publication of an odometry to the corrected one, jumps are of the correction,
at the robot, errors are of the newest corrected pose.
"""

import argparse
from pathlib import Path
import signal
import subprocess
import tempfile
import time

from ament_index_python.packages import get_package_prefix
from nav_msgs.msg import Odometry
import numpy as np
from pose_graph import COVARIANCE, DELAY, LAP, STEP
import rclpy
from rclpy.executors import SingleThreadedExecutor
from results import commit, cpu_model
from stavpr_lab.demonstration.simulated_odometry import drifted
from stavpr_msgs.msg import LoopClosure, RelativePose
from stavpr_msgs.srv import SaveMap
from stavpr_ros.mapping.transforms import inverse, matrices, to_poses
from stavpr_ros.ros.messages import pose_message, time_message
from stavpr_ros.units import SECOND
from stavpr_slam.pose_graph.transforms import planar_poses
from stavpr_slam.ros.graph_messages import pose_array

PERIOD = 0.02  # seconds between two odometries while all is solved


class Drive:
    """Publishes a drive image by image to a node that runs, and receives its odometry."""

    def __init__(self, nodes: int, drift: float) -> None:
        count = nodes + LAP
        angle = np.arange(count) * 2 * np.pi / LAP
        radius = STEP * LAP / (2 * np.pi)
        truth = np.column_stack(
            [radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2]
        )
        self._dice = np.random.default_rng(1)
        self.truth = matrices(planar_poses(truth))
        self.poses = planar_poses(drifted(truth, np.ones(count, bool), self._dice, drift))
        self.node = rclpy.create_node('live_graph')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._odometry = self.node.create_publisher(Odometry, 'odom', 1000)
        self._closures = self.node.create_publisher(LoopClosure, 'stavpr/loop_closure', 1000)
        self._received: dict[int, np.ndarray] = {}
        self.node.create_subscription(Odometry, 'pose_graph/odometry', self._on_odometry, 1000)

    def _on_odometry(self, message: Odometry) -> None:
        self._received[message.header.stamp.sec - 1] = pose_array(message.pose.pose)

    def wait(self, condition) -> None:
        while not condition():
            self._executor.spin_once(timeout_sec=0.1)

    def wait_for_node(self) -> None:
        """Wait until the first odometry comes back."""
        self.wait(self._closures.get_subscription_count)
        while not self._received:
            self._publish(0)
            self._executor.spin_once(timeout_sec=0.1)

    def _publish(self, i: int) -> None:
        message = Odometry(child_frame_id='base_link')
        message.header.stamp = time_message((i + 1) * SECOND)
        message.header.frame_id = 'odom'
        message.pose.pose = pose_message(self.poses[i])
        self._odometry.publish(message)

    def step(self, i: int, period: float) -> float:
        """Publish an odometry, and the closure that is known by then; return the delay, s."""
        if i - DELAY >= LAP and self._dice.random() < 0.85:
            self._closures.publish(self._closure(i - DELAY))
        began = time.monotonic()
        self._publish(i)
        self.wait(lambda: i in self._received)
        delay = time.monotonic() - began
        time.sleep(max(period - delay, 0))
        return delay

    def _closure(self, query: int) -> LoopClosure:
        measured = inverse(self.truth[query - LAP]) @ self.truth[query]
        measured[:2, 3] += self._dice.normal(size=2) * 0.12
        edge = RelativePose(source=RelativePose.PNP, frame='base_link')
        edge.is_independent = query % 5 == 0
        edge.query_stamp = time_message((query + 1) * SECOND)
        edge.place_stamp = time_message((query - LAP + 1) * SECOND)
        edge.pose.pose, edge.pose.covariance = pose_message(to_poses(measured)), COVARIANCE.ravel()
        return LoopClosure(query_index=query, has_relative_pose=True, relative_pose=edge)

    def jumps_and_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the correction moved the robot at each image, m, and its errors, m."""
        count = len(self._received)
        received = matrices(np.array([self._received[i] for i in range(count)]))
        steps = inverse(matrices(self.poses[: count - 1])) @ matrices(self.poses[1:count])
        jumps = np.linalg.norm((received[:-1] @ steps)[:, :3, 3] - received[1:, :3, 3], axis=1)
        start = matrices(self.poses[0]) @ inverse(self.truth[0])
        return jumps, np.linalg.norm((start @ self.truth[:count] - received)[:, :3, 3], axis=1)


def measure(nodes: int, drift: float, speed: float, period: float) -> str:
    """Return a row of the table."""
    with tempfile.TemporaryDirectory() as folder:
        command = [f'{get_package_prefix("stavpr_slam")}/lib/stavpr_slam/pose_graph', '--ros-args']
        for name, value in (('maps_folder', folder), ('max_correction_speed', speed)):
            command += ['-p', f'{name}:={value}']
        drive = Drive(nodes, drift)
        save = drive.node.create_client(SaveMap, 'pose_graph/save')
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            drive.wait_for_node()
            drive.wait(save.service_is_ready)
            fed = [drive.step(i, period) for i in range(1, nodes)]
            solved, began = [], time.monotonic()
            saving = save.call_async(SaveMap.Request(path='drive.tum'))
            while not saving.done() and len(solved) < LAP:
                solved.append(drive.step(nodes + len(solved), PERIOD))
            seconds = time.monotonic() - began
            saving = save.call_async(SaveMap.Request(path='other.tum'))
            drive.step(nodes + len(solved), 2 * PERIOD)
            began = time.monotonic()
            process.send_signal(signal.SIGTERM)
            process.wait()
            ended = time.monotonic() - began
            assert Path(folder, 'drive.tum').is_file(), 'the graph was not saved'
        finally:
            process.kill()
            drive.node.destroy_node()
    jumps, errors = drive.jumps_and_errors()
    return (
        f'| {nodes} | {np.median(fed) * 1e3:.0f} | {max(fed) * 1e3:.0f} | {seconds:.1f} | '
        f'{max(solved) * 1e3:.0f} | {ended:.1f} | {jumps.max():.2f} | {(jumps > 0.5).sum()} | '
        f'{errors.max():.1f} |'
    )


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--nodes', type=int, nargs='+', default=[3000])
    parser.add_argument('--drift', type=float, default=0.3, help='of the odometry (%(default)s)')
    parser.add_argument('--speed', type=float, default=0.0, help='max_correction_speed, m/s')
    parser.add_argument('--period', type=float, default=0.01, help='s between two odometries')
    options = parser.parse_args()
    rclpy.init()
    print(f'{cpu_model()}, {commit()}: delays in ms, seconds, jumps and errors in m\n')
    print('| nodes | delay | most | solve all | most | SIGTERM | jump | above .5 | error |')
    print('|---|---|---|---|---|---|---|---|---|')
    for nodes in options.nodes:
        print(measure(nodes, options.drift, options.speed, options.period), flush=True)


if __name__ == '__main__':
    main()
