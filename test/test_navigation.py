# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transform from map to odometry, and the initial pose."""

import math
from pathlib import Path
import re
import subprocess
import sys
from types import ModuleType, SimpleNamespace

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from pipelines import at, LENGTH, localizing, message, SECOND
from processes import environment, TIMEOUT
import pytest
from rclpy.qos import qos_profile_services_default
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import matrices
from stavpr_ros.ros.messages import pose_message
from stavpr_ros.ros.navigation import map_to_odometry, Navigation, planar
from test_visualization import header, Publishers


def posed(x, y, degrees):
    return np.array([x, y, 0, *Rotation.from_euler('z', degrees, degrees=True).as_quat()])


def test_map_to_odometry_takes_the_pose_of_odometry_to_that_of_the_map():
    place, odometry = posed(5, 2, 90), posed(1, 0, 0)
    np.testing.assert_allclose(map_to_odometry(place, odometry), posed(5, 1, 90), atol=1e-12)
    # the odometry's frame in the map, then the robot in that: the robot in the map
    rng = np.random.default_rng(0)
    place, odometry = (
        np.concatenate([rng.normal(size=3), Rotation.random(rng=rng).as_quat()]) for _ in range(2)
    )
    found = matrices(map_to_odometry(place, odometry)) @ matrices(odometry)
    np.testing.assert_allclose(found, matrices(place), atol=1e-12)


def test_planar_keeps_yaw_and_has_the_covariance_of_x_y_and_yaw_only():
    tilted = Rotation.from_euler('ZYX', [40, 20, 10], degrees=True).as_quat()
    given = PoseWithCovarianceStamped()
    given.pose.pose = pose_message(np.array([1, 2, 3, *tilted]))
    given.pose.covariance[::7] = [0.01, 4.0, 0.3, 0.3, 0.3, 0.01]
    flat = planar(given).pose
    position, o = flat.pose.position, flat.pose.orientation
    assert (position.x, position.y, position.z) == (1, 2, 0)
    assert math.degrees(2 * math.atan2(o.z, o.w)) == pytest.approx(40)
    expected = np.zeros(36)
    expected[[0, 7, 35]] = 0.25, 4, 0.0685
    np.testing.assert_array_equal(flat.covariance, expected)


@pytest.fixture
def publishing(map_file, monkeypatch):
    """Return a function that shows images to a localizing pipeline and publishes."""

    class TFMessage:
        def __init__(self, transforms):
            self.transforms = [(t.header.stamp.sec, t.transform) for t in transforms]
            self.frames = [(t.header.frame_id, t.child_frame_id) for t in transforms]

    module = ModuleType('tf2_msgs.msg')
    module.TFMessage = TFMessage
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', module)
    pipeline = localizing(map_file)
    settings = SimpleNamespace(
        publish_tf=True, publish_initialpose=True, map_frame='map', pipeline=pipeline.settings
    )
    publishers = Publishers(())
    navigation = Navigation(publishers, settings)

    def show(images, first=0):
        statuses = []
        for i, image in enumerate(images, first):
            match = pipeline.operation.process(message(image), (i + 1) * SECOND)
            navigation.publish(header(i), match, pipeline.places, at(i - 10), 'odom')
            statuses.append(match.accepted)
        return statuses

    return SimpleNamespace(
        show=show, pipeline=pipeline, tf=publishers.by_topic['/tf'].messages,
        initial=publishers.by_topic['initialpose'].messages,
    )  # fmt: skip


def test_transform_is_that_of_the_last_match_with_the_stamp_of_the_image(publishing, route):
    accepted = publishing.show(route[:10])
    first = accepted.index(True)
    assert len(publishing.tf) == 10 - first
    for i, sent in enumerate(publishing.tf, first):
        ((stamp, transform),) = sent.transforms
        assert (stamp, sent.frames) == (i + 1, [('map', 'odom')])
        assert transform.translation.x == pytest.approx(10, abs=1)  # odometry is at x - 10
        assert transform.rotation.w == pytest.approx(1)


def test_initial_pose_is_published_once_for_each_relocalization(publishing, route):
    accepted = publishing.show(route[:20])
    assert sum(accepted) > 10
    (pose,) = publishing.initial
    first = accepted.index(True)
    assert pose.header.stamp.sec == first + 1
    assert pose.pose.pose.position.x == pytest.approx(first, abs=1)
    publishing.pipeline.operation.reset()  # a new window
    assert publishing.show(route[30:45], 30)[:: LENGTH - 1][:2] == [False, True]
    assert len(publishing.initial) == 2
    assert publishing.initial[-1].header.stamp.sec > 30


def test_navigation_on_a_growing_route_publishes_nothing(publishing, route):
    publishing.pipeline.change(operation='mapping')
    publishing.show(route[:10])
    assert not publishing.tf
    assert not publishing.initial


def test_node_with_publish_tf_without_tf2_msgs_explains_it(robot, start, monkeypatch):
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)
    start(wait=False, publish_tf=True)
    robot.until_logged('publish_tf requires the package tf2_msgs: install it')
    robot.until_state('unconfigured')


def test_example_of_bridges_publishes_a_pose_at_the_start_and_on_each_request(robot, start, route):
    """Of its map only; the topics have the QoS of Isaac ROS Visual SLAM 4.6."""
    page = Path(__file__).parents[1] / 'docs' / 'bridges.md'
    code = re.search('```python\n(.*?)```', page.read_text(), re.DOTALL)[1]
    command = [sys.executable, '-c', code, '--ros-args', '-p', 'min_probability:=0.05']
    kind = PoseWithCovarianceStamped
    hints = robot.listen(kind, 'initial_pose', qos_profile_services_default)
    requests = robot.node.create_publisher(kind, 'trigger_hint', 10)
    start()
    ids = (robot.until_map(state='loaded').map_id, '0123456789abcdef')
    programs = [
        subprocess.Popen([*command, '-p', f'map_id:="{each}"'], env=environment()) for each in ids
    ]
    try:
        robot.until(lambda: requests.get_subscription_count() == len(ids), 'both programs')
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
    finally:
        for program in programs:
            program.terminate()
            program.wait(TIMEOUT)
