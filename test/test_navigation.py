# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The transform from map to odometry, and the initial pose."""

from dataclasses import replace
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
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from stavpr_ros.mapping.transforms import matrices
from stavpr_ros.method import Match, Status
from stavpr_ros.method import match as match_module
from stavpr_ros.pipeline.result import ImageResult
from stavpr_ros.ros.messages import matched_pose_message, Outcome, pose_message, Surroundings
from stavpr_ros.ros.navigation import map_to_odometry, Navigation, planar
from test_visualization import header, Publishers

ABOUT = Surroundings('map', odometry_frame='odom')


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


def test_pose_is_turned_by_the_mountings_of_the_cameras(small_map):
    poses = np.tile(posed(0, 0, 30), (len(small_map), 1))
    poses[:, 0] = np.arange(len(poses))
    places = replace(small_map, poses=poses)
    path = match_module.Path(np.column_stack([np.arange(4), np.arange(10, 6, -1)]), 9)
    result = ImageResult(Match(Status.MATCH, path=path), relative_yaw=math.pi)
    message = matched_pose_message(Outcome(header(0), result, places, Surroundings('map')))
    o = message.pose.pose.orientation
    assert message.pose.pose.position.x == 7
    assert abs(np.array([o.x, o.y, o.z, o.w]) @ posed(0, 0, 210)[3:]) == pytest.approx(1)
    assert message.pose.covariance[35] == 0.01


def test_planar_keeps_yaw_and_has_the_covariance_of_x_y_and_yaw_only():
    tilted = Rotation.from_euler('ZYX', [40, 20, 10], degrees=True).as_quat()
    given = PoseWithCovarianceStamped()
    given.pose.pose = pose_message(np.array([1, 2, 3, *tilted]))
    given.pose.covariance[::7] = [0.01, 4.0, 0.3, 0.3, 0.3, 0.01]
    given.pose.covariance[1] = given.pose.covariance[6] = 0.2
    flat = planar(given).pose
    position, o = flat.pose.position, flat.pose.orientation
    assert (position.x, position.y, position.z) == (1, 2, 0)
    assert math.degrees(2 * math.atan2(o.z, o.w)) == pytest.approx(40)
    expected = np.zeros(36)
    expected[[0, 1, 6, 7, 35]] = 0.25, 0.2, 0.2, 4, 0.0685
    np.testing.assert_array_equal(flat.covariance, expected)


@pytest.fixture
def publishing(map_file, monkeypatch):
    """
    Return a function that shows images to a localizing pipeline and publishes.

    Image i is stamped i + 1 s and processed at ``clock.time``, 0.5 s later; ``beats`` has the
    function that the thread calls.
    """
    clock, beats = SimpleNamespace(time=0.0), []

    class TFMessage:
        def __init__(self, transforms):
            stamps = [t.header.stamp for t in transforms]
            self.transforms = [
                (stamp.sec + stamp.nanosec / SECOND, t.transform)
                for stamp, t in zip(stamps, transforms, strict=True)
            ]
            self.frames = [(t.header.frame_id, t.child_frame_id) for t in transforms]

    module = ModuleType('tf2_msgs.msg')
    module.TFMessage = TFMessage
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', module)
    monkeypatch.setattr(
        'stavpr_ros.ros.navigation.Beat',
        lambda node, period, act, name: beats.append(act) or SimpleNamespace(stop=lambda: None),
    )
    pipeline = localizing(map_file)
    settings = SimpleNamespace(
        publish_tf=True, publish_initialpose=True, map_frame='map', pipeline=pipeline.settings,
        transform_tolerance=0.25,
    )  # fmt: skip
    publishers = Publishers(())
    publishers.get_clock = lambda: SimpleNamespace(now=lambda: Time(seconds=clock.time))
    navigation = Navigation(publishers, settings)

    def show(images, first=0):
        statuses = []
        for i, image in enumerate(images, first):
            clock.time = i + 1.5
            match = pipeline.operation.process(message(image), (i + 1) * SECOND)
            navigation.publish(
                Outcome(header(i), match, pipeline.places, replace(ABOUT, pose=at(i - 10)))
            )
            statuses.append(match.match.accepted)
        return statuses

    return SimpleNamespace(
        show=show, pipeline=pipeline, navigation=navigation, clock=clock, beats=beats,
        tf=publishers.by_topic['/tf'].messages,
        initial=publishers.by_topic['initialpose'].messages,
    )  # fmt: skip


def test_transform_is_sent_from_the_first_match_on_and_post_dated(publishing, route):
    (beat,) = publishing.beats
    accepted = publishing.show(route[:10])
    beat()
    first = accepted.index(True)
    stamps = [sent.transforms[0][0] for sent in publishing.tf]
    # the first also at the stamp of its image, which is before the tolerance
    assert stamps == [first + 1, *(i + 1.75 for i in range(first, 10) if accepted[i])]
    for sent in publishing.tf:
        ((_, transform),) = sent.transforms
        assert sent.frames == [('map', 'odom')]
        assert transform.translation.x == pytest.approx(10, abs=1)  # odometry is at x - 10
        assert transform.rotation.w == pytest.approx(1)


def test_transform_is_repeated_until_the_map_or_the_state_changes(publishing, route):
    (beat,), clock = publishing.beats, publishing.clock
    beat()
    assert not publishing.tf  # nothing before the first match
    publishing.show(route[:10])
    _, last = publishing.tf[-1].transforms[0]
    count, lost = len(publishing.tf), ImageResult(Match(Status.NO_MATCH, 'lost'))
    places = publishing.pipeline.places
    publishing.navigation.publish(Outcome(header(30), lost, places, replace(ABOUT, pose=at(0))))
    for clock.time in (40.0, 40.0, 40.05):  # a paused clock sends no stamp twice
        beat()
    repeated = [sent.transforms[0] for sent in publishing.tf[count:]]
    assert repeated == [(40.25, last), (pytest.approx(40.3), last)]
    assert publishing.navigation.sends_transform
    publishing.navigation.forget()
    clock.time += 1
    beat()
    assert len(publishing.tf) == count + 2
    assert not publishing.navigation.sends_transform


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
