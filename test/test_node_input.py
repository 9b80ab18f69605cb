# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of the node: transports, invalid images, odometry, QoS."""

import array

from builtin_interfaces.msg import Time
import cv2
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
import rclpy
from rclpy.qos import DurabilityPolicy, qos_profile_sensor_data, QoSProfile
from robot import RELIABLE, SECOND
from sensor_msgs.msg import CompressedImage, Image
from stavpr_msgs.msg import PlaceMatch
from std_msgs.msg import Header

WARN, ERROR = DiagnosticStatus.WARN, DiagnosticStatus.ERROR
WARMING_UP, MATCH = PlaceMatch.WARMING_UP, PlaceMatch.MATCH
INVALID, SKIPPED = PlaceMatch.INVALID_IMAGE, PlaceMatch.SKIPPED
RELIABILITY = 'qos_overrides./image.subscription.reliability'


@pytest.fixture
def publish(robot):
    """Make a publisher of images; it is destroyed with the test."""
    made = []

    def publish(kind, topic, qos=qos_profile_sensor_data):
        made.append(robot.node.create_publisher(kind, topic, qos))
        return made[-1]

    yield publish
    for publisher in made:
        robot.node.destroy_publisher(publisher)


@pytest.fixture
def stranger(context):
    """Return a node of another participant: in each, a topic has one type."""
    node = rclpy.create_node('stranger', context=context)
    yield node
    node.destroy_node()


def test_keyframes_by_distance_and_angle_use_odometry(robot, start, route):
    """On a topic with another name; poses are valid for half a second."""
    off = {'relative_pose': 'none', 'odometry_error': 0.0}
    start('-r', 'odom:=/odom', '-r', 'image:=/image', keyframe_distance=1.0, **off)
    match = robot.show(route[0])
    assert (match.status, 'no odometry' in match.reason) == (SKIPPED, True)
    assert 'never' in robot.until_diagnosed('input', WARN, 'odometry').message
    robot.until(lambda: robot.odometry.get_subscription_count() > 0, 'a subscriber of odometry')
    assert robot.show_at(5.0, route[1]).status == WARMING_UP
    assert robot.show_at(5.4, route[2]).status == SKIPPED
    assert robot.show_at(6.1, route[3]).status in (WARMING_UP, MATCH)
    assert robot.show_at(6.1, route[4], degrees=170).status == SKIPPED
    robot.set(keyframe_angle=30.0)  # its earlier name
    robot.until_logged("parameter 'keyframe_angle' is keyframe_angle_deg now")
    assert robot.show_at(6.1, route[5], degrees=40).status in (WARMING_UP, MATCH)
    assert 'no odometry' in robot.show(route[7], 3600 * SECOND).reason  # another clock

    def compared():
        robot.odometry.publish(Odometry(header=Header(stamp=Time(sec=1))))
        return 'without odometry at their stamps' in robot.diagnostics['input'].message

    robot.until(compared, 'a remark on the stamps')
    robot.until_diagnosed('input', WARN, 'has stopped')
    robot.set(keyframe_distance=0.0, keyframe_angle_deg=0.0)
    robot.until(lambda: not robot.odometry.get_subscription_count(), 'the end of odometry')


def test_a_rule_that_skips_every_image_is_a_warning_and_so_is_the_missing_map(robot, start, route):
    """By the stamps, in a replay that is faster; once for each such stretch."""
    start(map_path='', operation='mapping', keyframe_distance=0.5)
    robot.drive(route[:8])
    robot.until_logged('every image is skipped: no odometry for this image')
    assert sum('every image is skipped' in line for line in robot.log) == 1
    assert robot.transition('deactivate')
    robot.until_logged('no map written, because none of')


def test_wrongly_remapped_odometry_and_a_covered_lens_are_diagnosed(
    robot, start, publish, stranger, route
):
    """The topic with odometry is named, not that of a pose graph; a topic of another type too."""
    publish(Odometry, '/pose_graph/odometry')
    publish(TransformStamped, '/pose_graph/map_to_odom')
    start('-r', 'odom:=/wheel', keyframe_distance=1.0)
    found = 'nothing is published on /wheel, odometry is on /odom: remap odom'
    robot.until_diagnosed('input', WARN, found)
    stranger.create_publisher(Image, '/wheel', 1)
    robot.until_diagnosed('input', WARN, 'sensor_msgs/msg/Image is published on /wheel, odometry')
    robot.set(keyframe_distance=0.0)
    robot.show(np.full_like(route[0], 200))
    robot.until_diagnosed('input', WARN, 'the images show nothing (standard deviation 0.0 of 255)')


def test_compressed_images_on_a_remapped_topic_are_recognized(
    robot, start, publish, stranger, route
):
    """The topic is below the one that `image` is remapped to; the diagnostics name it."""
    start('-r', 'image:=/front/image', wait=False, image_transport='compressed')
    topic = '/front/image/compressed'
    assert topic in robot.until_diagnosed('input', WARN, 'no publisher').message
    raw = stranger.create_publisher(Image, topic, 1)
    mistyped = 'sensor_msgs/msg/Image is published there: compare image_transport'
    robot.until_diagnosed('input', ERROR, mistyped)
    stranger.destroy_publisher(raw)
    camera = publish(CompressedImage, topic)
    robot.wait_for_node(camera, CompressedImage)

    def show(data):
        message = CompressedImage(format='rgb8; jpeg compressed bgr8', data=array.array('B', data))
        return robot.show(message, publisher=camera)

    match = show(b'not an image at all')
    assert (match.status, 'rgb8' in match.reason) == (INVALID, True)
    matches = [show(cv2.imencode('.jpeg', image[:, :, ::-1])[1]) for image in route[40:46]]
    assert [match.status for match in matches] == 4 * [WARMING_UP] + 2 * [MATCH]
    assert matches[-1].newest_index == 45


def test_incompatible_publishers_are_reported(robot, start, publish, route):
    """Alone, beside a compatible one, and no longer when they are gone."""
    start(wait=False, **{RELIABILITY: 'reliable'})
    unreliable = publish(Image, 'image')
    robot.node.destroy_publisher(robot.publisher)
    remedy = f'remove {RELIABILITY}, or make the publisher reliable'
    offers = f'a publisher of /image offers another reliability: {remedy}'
    robot.until_diagnosed('input', ERROR, f'1 publisher refused for QoS: {offers}')
    robot.until_logged(f'images are not received: {offers}')
    robot.publisher = robot.node.create_publisher(Image, 'image', RELIABLE)
    robot.wait_for_node()

    def reported():
        robot.show(route[0])
        warning = '1 publisher refused for QoS, while images of others arrive'
        return warning in robot.diagnostics['input'].message

    robot.until(reported, 'a warning')
    assert robot.counts('input')['publishers_refused'] == '1'
    robot.node.destroy_publisher(unreliable)
    robot.until(lambda: robot.counts('input')['publishers_refused'] == '0', 'no refusal')


def test_durability_override_excludes_volatile_publishers(robot, start, publish):
    durability = 'qos_overrides./image.subscription.durability'
    start(wait=False, **{durability: 'transient_local'})
    robot.until_diagnosed('input', ERROR, f'{durability} to volatile, or')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot.wait_for_node(publish(Image, 'image', latched))


def test_invalid_qos_override_is_an_error(robot, start):
    start(wait=False, **{RELIABILITY: 'certain'})
    robot.until_diagnosed('map', ERROR, 'correct qos_overrides./image.subscription')
    robot.until_state('unconfigured')
    robot.until_logged('certain')
