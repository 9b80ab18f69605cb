# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The example program of docs/bridges.md: poses on request for cuVSLAM and stella_vslam."""

from pathlib import Path
import re
import subprocess
import sys

from geometry_msgs.msg import PoseWithCovarianceStamped
from processes import environment, TIMEOUT
import pytest
from rclpy.qos import qos_profile_services_default
from robot import LENGTH

PAGE = Path(__file__).parents[1] / 'docs' / 'bridges.md'
HINTS = ('-r', 'trigger_hint:=visual_slam/trigger_hint')
POSES = ('-r', 'initial_pose:=visual_slam/initial_pose')


@pytest.fixture
def run_example():
    """Return a function that starts the program; it ends with the test."""
    processes = []

    def run(*options):
        code = re.search('```python\n(.*?)```', PAGE.read_text(), re.DOTALL)[1]
        command = [sys.executable, '-c', code, '--ros-args', *HINTS, *POSES, *options]
        processes.append(subprocess.Popen(command, env=environment()))

    yield run
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait(TIMEOUT)


def test_example_publishes_a_pose_at_the_start_and_on_each_request(
    robot, start, route, run_example
):
    """Of its map only; the topics have the QoS of Isaac ROS Visual SLAM 4.6."""
    kind = PoseWithCovarianceStamped
    hints = robot.listen(kind, 'visual_slam/initial_pose', qos_profile_services_default)
    requests = robot.node.create_publisher(kind, 'visual_slam/trigger_hint', 10)
    start()
    for map_id in (robot.until_map(state='loaded').map_id, '0123456789abcdef'):
        run_example('-p', 'min_probability:=0.05', '-p', f'map_id:="{map_id}"')
    robot.until(lambda: requests.get_subscription_count() == 2, 'both programs')
    assert not hints  # the window is empty
    for count, first in enumerate((0, 20, 40), 1):
        matches = robot.drive(route[first : first + 3 * LENGTH])
        if first:
            requests.publish(kind())
        robot.until(lambda count=count: len(hints) == count, 'a pose')
        places = {match.newest_index: match.header.stamp for match in matches}
        header, pose = hints[-1].header, hints[-1].pose
        assert header.frame_id == 'map'
        assert header.stamp == places[int(pose.pose.position.x)]
        assert pose.covariance[0] >= 0.01
