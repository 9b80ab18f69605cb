# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of matches, field by field, and drawn images; no node that spins."""

import math

from builtin_interfaces.msg import Time
from fixtures import route_images
import numpy as np
from places import features_of, map_of, route_strips
import pytest
from scipy.spatial.transform import Rotation
from stavpr_msgs.msg import PlaceMatch, RelativePose
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import encode_thumbnail, GrowingMap, Session
from stavpr_ros.method import Match, Path, Status
from stavpr_ros.method.match import Limits
from stavpr_ros.pipeline import ImageResult
from stavpr_ros.relative_pose.pair import matched_pair, Source
from stavpr_ros.ros.messages import (
    BESIDE,
    image_message,
    loop_closure_message,
    matched_pose_message,
    nanoseconds,
    Outcome,
    pose_message,
    Surroundings,
    time_message,
)
from stavpr_ros.ros.navigation import planar
from std_msgs.msg import Header

SECOND = 10**9
HEADER = Header(stamp=Time(sec=20, nanosec=7), frame_id='camera')
PAIRS = np.array([[0, 30], [1, 32], [2, 32], [3, 34], [4, 35]], np.int32)
WINDOW = tuple((16 + i) * SECOND + 7 for i in range(5))


def result_of(status, reason, pairs=PAIRS, place=32, candidates=(), image=None, **fields):
    path = Path(pairs, place, 0.25, second_best=50, second_best_distance=0.5)
    match = Match(status, reason, Limits(0.3), path, window_stamps=WINDOW, **fields)
    return ImageResult(match, candidates=candidates, image=image)


def accept(pairs=PAIRS, place=32, **fields):
    return result_of(Status.MATCH, '', pairs, place, **fields)


def reject(**fields):
    return result_of(Status.NO_MATCH, 'too far', **fields)


@pytest.fixture(scope='module')
def extractor():
    return FeatureExtractor('gradient', projection=8)


@pytest.fixture(scope='module')
def features(extractor):
    return extractor.extract(route_images(1))


@pytest.fixture(scope='module')
def places(extractor, features):
    """Return a route of places 10 to 59; place i: i + 1 s, at x = i, y = i squared."""
    route = GrowingMap(extractor.settings, extractor.projection, 100)
    for i in range(60):
        pose = None if i in (33, 41) else np.array([i, i * i, 0, 0, 0, 0, 1.0])
        route.add(features, (i + 1) * SECOND, f'id {i}', pose, b'')
    route.forget(10)
    return route


def test_stamps_after_2038_wrap_as_in_the_messages_of_others():
    for seconds in (0, 2**31 - 1, 2**31, 2**32 - 1):
        message = time_message(seconds * SECOND + 5)
        assert message.sec % 2**32 == seconds
        assert nanoseconds(message) == seconds * SECOND + 5


@pytest.mark.parametrize(('own', 'message'), [(Status, PlaceMatch), (Source, RelativePose)])
def test_names_equal_the_constants_of_the_message(own, message):
    constants = {name: getattr(message, name) for name in own.__members__}
    assert constants == {member.name: member.value for member in own}


def test_loop_closure_message_needs_a_match(places):
    assert loop_closure_message(Outcome(HEADER, accept()), accept().match) is None
    assert loop_closure_message(Outcome(HEADER, reject(), places), reject().match) is None


def test_matched_pose_message_has_the_spread_of_near_places(places):
    message = matched_pose_message(Outcome(HEADER, accept(), places, Surroundings('odom')))
    assert (message.header.stamp, message.header.frame_id) == (HEADER.stamp, 'odom')
    assert message.pose.pose == pose_message(np.array([35, 35**2, 0, 0, 0, 0, 1]))
    around = [34, 35, 36, 37]  # 33 has no pose
    expected = np.zeros((6, 6))
    np.fill_diagonal(expected, [np.var(around), np.var(np.square(around)), *[0.01] * 4])
    across = np.array([-(37**2 - 34**2), 3]) / math.hypot(37**2 - 34**2, 3)
    expected[:2, :2] += BESIDE**2 * np.outer(across, across)
    np.testing.assert_allclose(message.pose.covariance.reshape(6, 6), expected)
    for place, near in ((10, [10, 11, 12]), (59, [57, 58, 59])):  # the ends of the route
        at_end = accept(np.array([[4, place]], np.int32))
        message = matched_pose_message(Outcome(HEADER, at_end, places, Surroundings('odom')))
        assert message.pose.covariance[0] == pytest.approx(np.var(near) + BESIDE**2, rel=0.01)
    nowhere = accept(np.array([[4, 33]], np.int32))
    assert matched_pose_message(Outcome(HEADER, nowhere, places, Surroundings('odom'))) is None
    assert matched_pose_message(Outcome(HEADER, reject(), places, Surroundings('odom'))) is None


@pytest.mark.parametrize('newest', range(4, 11))
def test_neighbors_of_a_place_are_of_its_session(newest):
    """Three sessions 500 m apart: spread of the pose, and poses around the place of an edge."""
    n, index = 15, np.repeat(np.arange(3, dtype=np.int32), 5)
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (n, 1))
    poses[:, :2] = np.column_stack([np.arange(n), 500.0 * index])
    parts = {'sessions': tuple(map(Session, 'abc')), 'session_index': index, 'poses': poses}
    thumbnails = (encode_thumbnail(route_images(1)[0]),) * n
    merged = map_of(features_of(route_strips(0, n)), thumbnails=thumbnails, **parts)
    own = np.arange(newest // 5 * 5, newest // 5 * 5 + 5)
    path = np.column_stack([np.arange(5), np.maximum(newest + np.arange(-4, 1), own[0])])
    match = accept(path.astype(np.int32), newest)
    covariance = matched_pose_message(
        Outcome(HEADER, match, merged, Surroundings('map'))
    ).pose.covariance
    assert max(covariance[0], covariance[7]) < 5  # along and across the path
    distances = np.abs(np.subtract.outer(path[:, 1], np.arange(n)))
    pair = matched_pair(match.match, merged, None, poses[:5], lambda at: distances[:, at])
    np.testing.assert_array_equal(pair.poses, poses[own])


@pytest.mark.parametrize('heading', [0, 137])
@pytest.mark.parametrize(('spacing', 'turned'), [(0.3, 70), (2.5, 0), (0.0, 0)])
def test_pose_is_as_uncertain_beside_the_path_as_a_lane_is_wide(
    extractor, features, heading, spacing, turned
):
    """At any speed; where the poses are of positions only, or of a robot that begins at rest."""
    route, angle = GrowingMap(extractor.settings, extractor.projection, 10), math.radians(heading)
    orientation = Rotation.from_euler('z', heading + turned, degrees=True).as_quat()
    for i in range(5):
        position = [i * spacing * math.cos(angle), i * spacing * math.sin(angle), 0]
        route.add(features, pose=np.array([*position, *orientation]))
    match = accept(np.array([[4, 2]], np.int32))
    message = matched_pose_message(Outcome(HEADER, match, route, Surroundings('map')))
    covariance = message.pose.covariance.reshape(6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    across = np.array([-math.sin(angle), math.cos(angle)])
    along = np.array([across[1], -across[0]])
    sideways = across @ covariance[:2, :2] @ across
    assert 3.5 <= 2 * math.sqrt(sideways) < 4.0 + 2 * spacing
    assert along @ covariance[:2, :2] @ along < 0.02 + 2.1 * spacing**2
    flat = planar(message).pose.covariance.reshape(6, 6)
    assert across @ flat[:2, :2] @ across >= sideways


@pytest.mark.parametrize('axis', ['x', 'y', 'z'])
def test_matched_pose_message_rotates_about_the_axes_of_the_map(extractor, features, axis):
    """For a camera with axes of its own; the sign of a quaternion is arbitrary."""
    camera = Rotation.from_rotvec(np.radians(120) * np.ones(3) / math.sqrt(3))  # x to y, y to z
    route = GrowingMap(extractor.settings, extractor.projection, 10)
    degrees = [-20, -5, 0, 15, 20]
    for i, turn in enumerate(degrees):
        orientation = (Rotation.from_euler(axis, turn, degrees=True) * camera).as_quat()
        route.add(features, pose=np.array([0, 0, 0, *orientation * (-1) ** i]))
    match = accept(np.array([[4, 2]], np.int32))
    message = matched_pose_message(Outcome(HEADER, match, route, Surroundings('map')))
    expected = np.full(3, 0.01)
    expected['xyz'.index(axis)] = np.var(np.radians(degrees))
    np.testing.assert_allclose(message.pose.covariance[21::7], expected, rtol=1e-9)


def test_image_message_of_a_strided_image():
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)[:, ::2]
    message = image_message(HEADER, image)
    assert (message.height, message.width, message.step) == (6, 4, 12)
    assert bytes(message.data) == image.tobytes()
