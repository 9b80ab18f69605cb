# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages of matches, field by field, and drawn images; no node that spins."""

from array import array
from dataclasses import replace
import math

from builtin_interfaces.msg import Time
from fixtures import route_images
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stavpr_msgs.msg import LoopClosure, PlaceMatch
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import encode_thumbnail, GrowingMap, Session
from stavpr_ros.pipeline import ImageResult, overlay
from stavpr_ros.recognition import Candidate, Match, Status
from stavpr_ros.relative_pose.edge import Edge, Source
from stavpr_ros.ros.messages import (
    candidates_message,
    image_message,
    loop_closure_message,
    map_info_message,
    match_message,
    matched_pose_message,
    nanoseconds,
    odometry_pose,
    pose_message,
    PoseFrames,
    time_message,
)
from std_msgs.msg import Header

SECOND = 10**9
HEADER = Header(stamp=Time(sec=20, nanosec=7), frame_id='camera')
PATH = np.array([[0, 30], [1, 32], [2, 32], [3, 34], [4, 35]], np.int32)
NEAREST = SequenceMatch(30, 35, 32, 0.25, 50, 0.5)
WINDOW = tuple((16 + i) * SECOND + 7 for i in range(5))


def result_of(status, reason, path=PATH, inliers=-1, candidates=(), image=None, **fields):
    fields = {'window_stamps': WINDOW, 'distance': 0.25} | fields
    result = ImageResult.of_match(Match(status, reason, 0.3, NEAREST, path, **fields))
    return replace(result, inliers=inliers, candidates=candidates, image=image)


def accepted(path=PATH, **fields):
    return result_of(Status.MATCH, '', path, **fields)


def rejected(**fields):
    return result_of(Status.NO_MATCH, 'too far', **fields)


@pytest.fixture(scope='module')
def extractor():
    return FeatureExtractor(projection=8)


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


BLANK = (
    dict.fromkeys(('place_index', 'newest_index', 'second_best_index', 'inliers'), -1)
    | dict.fromkeys(('sequence_first', 'sequence_last', 'sequence_middle'), -1)
    | dict.fromkeys(('distance', 'probability', 'second_best_distance'), math.nan)
    | dict.fromkeys(('window_first', 'window_middle', 'window_last'), HEADER.stamp)
    | dict.fromkeys(('place_stamp', 'newest_stamp'), Time())
    | dict.fromkeys(('place_id', 'newest_id', 'robot_id', 'map_id', 'session'), '')
    | {'path': [], 'path_probabilities': array('d'), 'has_relative_pose': False}
    | {'threshold': 0.3, 'header': HEADER}
)


def same(message, **expected):
    """Every field is as expected, and fields that are not named are blank; NaN equals NaN."""
    plain = BLANK | expected
    edge = message.relative_pose
    assert (edge.source, edge.query_index, edge.place_index, edge.inliers) == (0, -1, -1, -1)
    assert set(plain) | {'relative_pose'} == set(PlaceMatch.get_fields_and_field_types())
    for name, value in plain.items():
        field = getattr(message, name)
        if isinstance(value, float):
            assert field == pytest.approx(value, abs=1e-6, nan_ok=True), name
        else:
            assert field == value, name


# ------------------------------------------------ ~/match


@pytest.mark.parametrize(
    'status',
    [Status.INVALID_IMAGE, Status.NOT_READY, Status.DROPPED, Status.SKIPPED, Status.WARMING_UP],
)
def test_match_message_without_sequence_is_blank(status):
    match = ImageResult(status, 'because', 0.3)
    same(match_message(HEADER, match), status=status, reason='because')
    assert math.isnan(match_message(HEADER, ImageResult(status)).threshold)
    assert loop_closure_message(HEADER, match, None) is None
    assert candidates_message(HEADER, match, None) is None
    assert matched_pose_message(HEADER, match, None, 'map') is None


def test_status_equals_the_constants_of_the_message():
    constants = {name: getattr(PlaceMatch, name) for name in Status.__members__}
    assert constants == {status.name: status.value for status in Status}


SEQUENCE = {'distance': 0.25, 'sequence_first': 30, 'sequence_last': 35, 'sequence_middle': 32,
            'second_best_index': 50, 'second_best_distance': 0.5,
            'window_first': time_message(WINDOW[0]),
            'window_middle': time_message(WINDOW[2])}  # fmt: skip


@pytest.mark.parametrize(
    ('match', 'fields'),
    [
        (ImageResult(Status.MAPPED, '', 0.3, image_index=59), {'newest_index': 59}),
        (
            ImageResult.of_match(
                Match(Status.WARMING_UP, '2 of 5', 0.3, window_stamps=WINDOW[:2])
            ),
            dict.fromkeys(('window_first', 'window_middle'), time_message(WINDOW[0])),
        ),
        (
            accepted(inliers=40),
            SEQUENCE | {
                'place_index': 32, 'newest_index': 35, 'place_stamp': Time(sec=33),
                'newest_stamp': Time(sec=36), 'place_id': 'id 32', 'newest_id': 'id 35',
                'inliers': 40,
            },
        ),
        (rejected(probability=0.75), SEQUENCE | {'probability': 0.75}),
        (rejected(inliers=3), SEQUENCE | {'inliers': 3}),
    ],
    ids=['mapped', 'warming up', 'match', 'no match in mode robust', 'no match in mode paper'],
)  # fmt: skip
def test_match_message_has_the_fields_of_its_status(places, match, fields):
    message = match_message(HEADER, match, places)
    path = [(pair.query_index, pair.place_index) for pair in message.path]
    expected = [] if match.match is None else match.match.path.tolist()
    assert path == [tuple(cell) for cell in expected]
    same(message, status=match.status, reason=match.reason, path=message.path, **fields)


@pytest.mark.parametrize(('length', 'position'), [(4, 1), (5, 2)])
def test_position_of_a_match_is_the_middle_of_its_window(length, position):
    """Of two middle images the earlier one."""
    assert accepted(window_stamps=WINDOW[:length]).match.position == position


def test_match_message_has_the_probability_of_each_place_of_the_path(places):
    ratios = np.array([0.5, 1, 1, 1.2, 2])
    match = accepted(probability=0.8, path_ratios=ratios)
    message = match_message(HEADER, match, places)
    assert list(message.path_probabilities) == pytest.approx([0.4, 0.8, 0.8, 0.96, 1])
    assert len(message.path_probabilities) == len(message.path)


def test_messages_of_a_map_name_the_robot_and_the_map(small_map):
    stored = replace(small_map, map_id='0123456789abcdef')
    match = accepted(candidates=(Candidate(32, 0.25),))
    on_route = accepted(image_index=44)
    info = map_info_message('mapping', 'full', 'a', stored, None, Time(), 'r2')
    for message in (
        match_message(HEADER, match, stored, 'r2'),
        candidates_message(HEADER, match, stored, 'r2'),
        loop_closure_message(HEADER, on_route, stored, 'r2'),
        info,
    ):
        assert (message.robot_id, message.map_id) == ('r2', '0123456789abcdef')
    assert (list(info.sessions), info.feature_version) == ([], 0)


def test_match_message_with_an_edge_names_its_pair(places):
    pose = np.array([0.5, 0.1, 0, 0, 0, 0, 1])
    edge = Edge(Source.ALIGNED, 'no camera', pose, np.diag(np.arange(6.0)))
    message = match_message(HEADER, accepted(), places, edge=edge, frame='base')
    found = message.relative_pose
    assert message.has_relative_pose
    assert (found.source, found.reason, found.frame) == (found.ALIGNED, 'no camera', 'base')
    assert (found.query_index, found.query_stamp) == (-1, time_message(WINDOW[2]))
    assert (found.place_index, found.place_stamp) == (32, Time(sec=33))
    assert found.pose.pose == pose_message(pose)
    np.testing.assert_array_equal(found.pose.covariance[::7], np.arange(6.0))
    assert (found.inliers, found.is_independent) == (-1, False)
    for source in (Source.NONE, Source.REFUTED, Source.DROPPED):
        none = match_message(HEADER, accepted(), places, edge=Edge(source, 'why'), frame='base')
        assert (none.has_relative_pose, none.relative_pose.reason) == (False, 'why')


# ------------------------------------------------ candidates, loop closures, poses


@pytest.mark.parametrize(
    'probabilities', [[math.nan, math.nan], [0.75, 0.5]], ids=['mode paper', 'mode robust']
)
def test_candidates_message_lists_places(places, probabilities):
    candidates = map(Candidate, (32, 50), (0.25, 0.5), probabilities)
    match = rejected(candidates=tuple(candidates))
    message = candidates_message(HEADER, match, places)
    assert message.header == HEADER
    assert message.threshold == pytest.approx(0.3)
    rows = [(c.place_index, c.distance, c.place_stamp.sec, c.place_id) for c in message.candidates]
    assert rows == [(32, 0.25, 33, 'id 32'), (50, 0.5, 51, 'id 50')]
    found = [candidate.probability for candidate in message.candidates]
    np.testing.assert_equal(found, probabilities)


@pytest.mark.parametrize(
    ('first_image', 'has_poses', 'is_oldest'),
    [(55, True, False), (39, False, False), (55, True, True)],
)
@pytest.mark.parametrize('is_late', [False, True])
def test_loop_closure_message_of_a_match(places, first_image, has_poses, is_oldest, is_late):
    """Of the middle image of the window, or the oldest; image 41 has no pose."""
    changes = (1.0, 0.25, 0.5, 0.125, 0.75)
    match = accepted(
        image_index=first_image + 4, inliers=9, probability=0.75, is_oldest=is_oldest,
        is_late=is_late, window_changes=changes,
    )  # fmt: skip
    message = loop_closure_message(HEADER, match, places, 'r2', PoseFrames('odom', 'base'))
    assert [pair.query_change for pair in message.pairs] == [changes[q] for q in PATH[:, 0]]
    pairs = [(first_image + q, m) for q, m in PATH.tolist()]
    assert [(pair.query_index, pair.place_index) for pair in message.pairs] == pairs
    stamps = [(pair.query_stamp, pair.place_stamp) for pair in message.pairs]
    assert stamps == [(Time(sec=q + 1), Time(sec=m + 1)) for q, m in pairs]
    query = first_image + (0 if is_oldest else 2)
    expected = LoopClosure(
        header=HEADER, query_index=query, query_stamp=Time(sec=query + 1), place_index=32,
        place_stamp=Time(sec=33), has_poses=has_poses, distance=0.25, threshold=message.threshold,
        probability=0.75, inliers=9, pairs=message.pairs, robot_id='r2', is_late=is_late,
        query_session='r2', place_session='r2',
    )  # fmt: skip
    if has_poses:
        expected.pose_frame, expected.pose_child_frame = 'odom', 'base'
        expected.query_pose_frame = 'odom'
        expected.query_pose = pose_message(np.array([query, query**2, 0, 0, 0, 0, 1]))
        expected.place_pose = pose_message(np.array([32, 32**2, 0, 0, 0, 0, 1]))
    assert math.isnan(message.relative_pose.reprojection_error)
    message.relative_pose = expected.relative_pose
    assert message == expected
    assert message.threshold == pytest.approx(0.3)


def test_loop_closure_message_on_a_map_has_poses_of_two_frames(places):
    query = np.array([7.0, 8, 0, 0, 0, 0, 1])
    frames = PoseFrames('map', 'base', 'odom')
    message = loop_closure_message(HEADER, accepted(), places, 'r2', frames, query)
    assert (message.query_index, message.place_index) == (-1, 32)
    assert (message.query_session, message.place_session) == ('r2', '')
    assert (message.query_stamp, message.place_stamp) == (time_message(WINDOW[2]), Time(sec=33))
    assert {pair.query_index for pair in message.pairs} == {-1}
    assert [pair.query_stamp for pair in message.pairs] == [time_message(at) for at in WINDOW]
    assert message.has_poses
    assert (message.pose_frame, message.query_pose_frame) == ('map', 'odom')
    assert (message.pose_child_frame, message.query_pose) == ('base', pose_message(query))
    assert message.place_pose == pose_message(np.array([32, 32**2, 0, 0, 0, 0, 1]))
    assert np.isnan([pair.query_change for pair in message.pairs]).all()
    assert not loop_closure_message(HEADER, accepted(), places, 'r2', frames).has_poses


def test_loop_closure_message_needs_a_match(places):
    assert loop_closure_message(HEADER, accepted(), None) is None
    assert loop_closure_message(HEADER, rejected(image_index=59), places) is None


def test_matched_pose_message_has_the_spread_of_near_places(places):
    message = matched_pose_message(HEADER, accepted(), places, 'odom')
    assert (message.header.stamp, message.header.frame_id) == (HEADER.stamp, 'odom')
    assert message.pose.pose == pose_message(np.array([35, 35**2, 0, 0, 0, 0, 1]))
    around = [34, 35, 36, 37]  # 33 has no pose
    expected = np.zeros((6, 6))
    np.fill_diagonal(expected, [np.var(around), np.var(np.square(around)), *[0.01] * 4])
    np.testing.assert_allclose(message.pose.covariance.reshape(6, 6), expected)
    for place, near in ((10, [10, 11, 12]), (59, [57, 58, 59])):  # the ends of the route
        at_end = accepted(np.array([[4, place]], np.int32))
        message = matched_pose_message(HEADER, at_end, places, 'odom')
        assert message.pose.covariance[0] == pytest.approx(np.var(near))
    nowhere = accepted(np.array([[4, 33]], np.int32))
    assert matched_pose_message(HEADER, nowhere, places, 'odom') is None
    assert matched_pose_message(HEADER, rejected(), places, 'odom') is None


@pytest.mark.parametrize('axis', ['x', 'y', 'z'])
def test_matched_pose_message_rotates_about_the_axes_of_the_map(extractor, features, axis):
    """For a camera with axes of its own; the sign of a quaternion is arbitrary."""
    camera = Rotation.from_rotvec(np.radians(120) * np.ones(3) / math.sqrt(3))  # x to y, y to z
    route = GrowingMap(extractor.settings, extractor.projection, 10)
    degrees = [-20, -5, 0, 15, 20]
    for i, turn in enumerate(degrees):
        orientation = (Rotation.from_euler(axis, turn, degrees=True) * camera).as_quat()
        route.add(features, pose=np.array([0, 0, 0, *orientation * (-1) ** i]))
    match = accepted(np.array([[4, 2]], np.int32))
    message = matched_pose_message(HEADER, match, route, 'map')
    expected = np.full(3, 0.01)
    expected['xyz'.index(axis)] = np.var(np.radians(degrees))
    np.testing.assert_allclose(message.pose.covariance[21::7], expected, rtol=1e-9)


# ------------------------------------------------ times, poses, images, the map


@pytest.mark.parametrize('stamp', [0, SECOND - 1, 1_700_000_000 * SECOND + 123_456_789])
def test_time_message_round_trip(stamp):
    assert nanoseconds(time_message(np.int64(stamp))) == stamp


def test_pose_message_round_trip():
    pose = np.array([1.5, -2, 3, 0.1, 0.2, 0.3, 0.9])
    odometry = Odometry()
    odometry.pose.pose = pose_message(pose)
    np.testing.assert_array_equal(odometry_pose(odometry), pose)


def test_image_message_of_a_strided_image():
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)[:, ::2]
    message = image_message(HEADER, image)
    assert (message.height, message.width, message.step) == (6, 4, 12)
    assert bytes(message.data) == image.tobytes()


FLAGS = 'projected', 'has_stamps', 'has_ids', 'has_poses', 'has_thumbnails'


def test_map_info_message_of_a_map(small_map):
    extractor = small_map.extractor()
    info = map_info_message('mapping', 'full', 'a', small_map, extractor, Time(sec=3))
    assert (info.operation, info.state, info.path) == ('mapping', 'full', 'a')
    assert (info.header.stamp.sec, info.feature_version, info.format_version) == (3, 1, 2)
    assert (info.places, info.features, info.strips, info.dimension) == (60, 'gradient', 7, 64)
    assert info.settings == small_map.settings.to_json()
    assert all(getattr(info, name) for name in FLAGS)


def test_messages_name_the_session_of_the_place(small_map):
    index = np.repeat(np.array([0, 1], np.int32), 30)
    both = replace(small_map, sessions=(Session('day'), Session('night')), session_index=index)
    assert match_message(HEADER, accepted(), both).session == 'night'
    assert match_message(HEADER, rejected(), both).session == ''
    match = rejected(candidates=(Candidate(29, 0.25), Candidate(30, 0.5)))
    candidates = candidates_message(HEADER, match, both).candidates
    assert [candidate.session for candidate in candidates] == ['day', 'night']
    info = map_info_message('localization', 'loaded', 'a', both, None, Time())
    assert info.sessions == ['day', 'night']


def test_map_info_message_of_a_growing_map_and_of_none(extractor, features):
    growing = GrowingMap(features.settings, extractor.projection, 10)
    for expected in ((0, 0), (1, 8)):
        info = map_info_message('mapping', 'growing', '', growing, FeatureExtractor(), Time())
        assert (info.places, info.dimension) == expected
        assert not any(getattr(info, name) for name in FLAGS)
        growing.add(features)
    info = map_info_message('localization', 'none', '', None, None, Time())
    assert (info.places, info.features, info.strips) == (0, '', 0)


# ------------------------------------------------ drawn images


def test_draw_match_has_the_text_and_the_thumbnail_of_the_place(monkeypatch, extractor, features):
    query, image = route_images(2)
    route = GrowingMap(extractor.settings, extractor.projection, 40)
    for i in range(40):
        route.add(features, thumbnail=encode_thumbnail(image) if i != 35 else b'')
    monkeypatch.setattr(overlay, 'match_image', lambda query, place, *text: (place, text))
    for match, has_place, words, place in (
        (accepted(image=query, inliers=20), False, 'distance 0.250 (threshold 0.300), 20', 35),
        (rejected(image=query), True, 'distance 0.250 (threshold 0.300)', 32),
        (rejected(image=query, probability=0.934), True, 'p 0.93', 32),
    ):
        thumbnail, (text, is_match, label) = overlay.draw_match(match, route)
        assert (thumbnail is not None, label) == (has_place, f'map place {place}')
        assert (words in text, is_match) == (True, match.accepted)
    skipped = ImageResult(Status.SKIPPED, 'because', image=query)
    assert overlay.draw_match(skipped, None) == (None, ('skipped because', False))
