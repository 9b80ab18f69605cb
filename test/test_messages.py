"""Between outcomes and messages, field by field, and when pictures are drawn; no node that spins."""

import math

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from conftest import route_images
from nav_msgs.msg import Odometry
from processes import DOMAIN, Bench
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from stavpr_msgs.msg import LoopClosure, PlaceMatch
from stavpr_ros.alignment import SequenceSettings
from stavpr_ros.alignment.lm_dtw import SequenceMatch
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, encode_thumbnail
from stavpr_ros.pipeline import Pipeline, PipelineSettings
from stavpr_ros.recognition import Match, Status
from stavpr_ros.recognition.candidates import Candidate
from stavpr_ros.ros import output
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
    time_message,
)

SECOND = 10**9
HEADER = Header(stamp=Time(sec=20, nanosec=7), frame_id='camera')
PATH = np.array([[0, 30], [1, 32], [2, 32], [3, 34], [4, 35]], np.int32)
NEAREST = SequenceMatch(30, 35, 32, 0.25, 50, 0.5)
MATCHED = Match(Status.MATCH, '', NEAREST, PATH, 0.3)
REJECTED = Match(Status.NO_MATCH, 'too far', NEAREST, PATH, 0.2)
WINDOW = tuple((16 + i) * SECOND + 7 for i in range(5))


def of(answer, recognition=None, **fields):
    reason = recognition.reason if recognition is not None else 'because'
    return Outcome(answer, reason, 0.3, recognition, **fields)


def turned(axis, degrees):
    """Quaternion x y z w of a rotation about an axis of the map."""
    half = math.radians(degrees) / 2
    return [*(math.sin(half) * np.array(axis, float)), math.cos(half)]


def product(a, b):
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


@pytest.fixture(scope='module')
def features():
    return FeatureExtractor(projection=8).extract(route_images(1))


@pytest.fixture(scope='module')
def grown(features):
    """A route of places 10 to 59, the ones before it forgotten; place i: i + 1 s, at x = i, y = i squared."""
    extractor = FeatureExtractor(projection=8)
    route = GrowingMap(extractor.settings, extractor.projection, 100)
    for i in range(60):
        pose = None if i in (33, 41) else np.array([i, i * i, 0, 0, 0, 0, 1.0])
        route.add(features, (i + 1) * SECOND, f'id {i}', pose, b'')
    route.forget(10)
    return route


BLANK = (
    dict.fromkeys(('place_index', 'newest_index', 'second_best_index', 'inliers'), -1)
    | dict.fromkeys(('sequence_first', 'sequence_last', 'sequence_middle'), -1)
    | dict.fromkeys(('distance', 'second_best_distance'), math.nan)
    | dict.fromkeys(('window_first', 'window_middle', 'window_last'), HEADER.stamp)
    | dict.fromkeys(('place_stamp', 'newest_stamp'), Time())
    | dict.fromkeys(('place_id', 'newest_id'), '')
    | {'threshold': 0.3, 'header': HEADER, 'path': []}
)


def same(message, **expected):
    """Every field is as expected, and those that are not named as a message is made; NaN is NaN."""
    plain = BLANK | expected
    assert set(plain) == set(PlaceMatch.get_fields_and_field_types())
    for name, value in plain.items():
        told = getattr(message, name)
        if isinstance(value, float):
            assert told == pytest.approx(value, abs=1e-6, nan_ok=True), name
        else:
            assert told == value, name


# ------------------------------------------------ ~/match


@pytest.mark.parametrize(
    'answer', [Status.INVALID_IMAGE, Status.NOT_READY, Status.DROPPED, Status.SKIPPED, Status.WARMING_UP]
)
def test_answers_that_name_no_place(answer):
    same(match_message(HEADER, of(answer)), status=answer.value, reason='because')
    unset = Outcome(answer, 'because')
    assert math.isnan(match_message(HEADER, unset).threshold)
    for other in (loop_closure_message(HEADER, unset), candidates_message(HEADER, unset),
                  matched_pose_message(HEADER, unset, 'map')):  # fmt: skip
        assert other is None


def test_the_words_of_the_answers_are_those_of_the_message():
    constants = {name: getattr(PlaceMatch, name) for name in Status.__members__}
    assert constants == {answer.name: answer.value for answer in Status}


def test_an_image_that_became_a_place(grown):
    message = match_message(HEADER, Outcome(Status.MAPPED, '', 0.3, newest=59, places=grown))
    same(message, status=PlaceMatch.MAPPED, reason='', newest_index=59)


def test_a_window_that_is_not_full():
    warming = Match(Status.WARMING_UP, '2 of 5', None, PATH[:0], 0.3)
    message = match_message(HEADER, of(Status.WARMING_UP, warming, window=WINDOW[:2]))
    first = time_message(WINDOW[0])
    same(message, status=PlaceMatch.WARMING_UP, reason='2 of 5', window_first=first, window_middle=first)


SEEN = {'distance': 0.25, 'sequence_first': 30, 'sequence_last': 35, 'sequence_middle': 32,
        'second_best_index': 50, 'second_best_distance': 0.5,
        'window_first': time_message(WINDOW[0]), 'window_middle': time_message(WINDOW[2])}  # fmt: skip


def path_of(message):
    pairs = [(pair.query_index, pair.map_index) for pair in message.path]
    assert pairs == [tuple(cell) for cell in PATH.tolist()]
    return message.path


def test_a_match(grown):
    message = match_message(HEADER, of(Status.MATCH, MATCHED, window=WINDOW, places=grown, inliers=40))
    same(message, **SEEN, status=PlaceMatch.MATCH, reason='', path=path_of(message), place_index=32,
         newest_index=35, place_stamp=Time(sec=33), newest_stamp=Time(sec=36), place_id='id 32',
         newest_id='id 35', inliers=40)  # fmt: skip


def test_no_match_names_the_nearest_sequence_but_no_place(grown):
    message = match_message(HEADER, of(Status.NO_MATCH, REJECTED, window=WINDOW, places=grown, inliers=3))
    same(message, **SEEN, status=PlaceMatch.NO_MATCH, reason='too far', path=path_of(message), inliers=3)


# ------------------------------------------------ candidates, loop closures, poses


def test_candidates(grown):
    listed = Candidate(32, 0.25), Candidate(50, 0.5)
    outcome = of(Status.NO_MATCH, REJECTED, window=WINDOW, places=grown, candidates=listed)
    message = candidates_message(HEADER, outcome)
    assert message.header == HEADER
    assert message.threshold == pytest.approx(0.3)
    told = [(c.place_index, c.distance, c.place_stamp.sec, c.place_id) for c in message.candidates]
    assert told == [(32, 0.25, 33, 'id 32'), (50, 0.5, 51, 'id 50')]


@pytest.mark.parametrize(('first_image', 'has_poses'), [(55, True), (39, False)])
def test_a_loop_closure(grown, first_image, has_poses):
    """The window's middle is image first + 2; that of 39 has no pose."""
    outcome = of(Status.MATCH, MATCHED, window=WINDOW, places=grown, first_image=first_image, inliers=9)
    message = loop_closure_message(HEADER, outcome)
    pairs = [(first_image + q, m) for q, m in PATH.tolist()]
    assert [(pair.query_index, pair.place_index) for pair in message.pairs] == pairs
    stamps = [(pair.query_stamp, pair.place_stamp) for pair in message.pairs]
    assert stamps == [(Time(sec=q + 1), Time(sec=m + 1)) for q, m in pairs]
    query = first_image + 2
    expected = LoopClosure(
        header=HEADER, query_index=query, query_stamp=Time(sec=query + 1), place_index=32,
        place_stamp=Time(sec=33), has_poses=has_poses, distance=0.25, threshold=message.threshold, inliers=9,
        pairs=message.pairs,
    )  # fmt: skip
    if has_poses:
        expected.query_pose = pose_message(np.array([query, query**2, 0, 0, 0, 0, 1]))
        expected.place_pose = pose_message(np.array([32, 32**2, 0, 0, 0, 0, 1]))
    assert message == expected
    assert message.threshold == pytest.approx(0.3)


def test_what_is_no_loop_closure(grown):
    fixed = of(Status.MATCH, MATCHED, window=WINDOW, places=grown)
    rejected = of(Status.NO_MATCH, REJECTED, window=WINDOW, places=grown, first_image=55)
    assert loop_closure_message(HEADER, fixed) is loop_closure_message(HEADER, rejected) is None


def test_the_pose_of_a_match_and_its_spread(grown):
    message = matched_pose_message(HEADER, of(Status.MATCH, MATCHED, places=grown), 'odom')
    assert (message.header.stamp, message.header.frame_id) == (HEADER.stamp, 'odom')
    assert message.pose.pose == pose_message(np.array([35, 35**2, 0, 0, 0, 0, 1]))
    around = [34, 35, 36, 37]  # 33 has no pose
    expected = np.zeros((6, 6))
    np.fill_diagonal(expected, [np.var(around), np.var(np.square(around)), *[0.01] * 4])
    np.testing.assert_allclose(message.pose.covariance.reshape(6, 6), expected)
    nowhere = Match(Status.MATCH, '', NEAREST, np.array([[4, 33]], np.int32), 0.3)
    assert matched_pose_message(HEADER, of(Status.MATCH, nowhere, places=grown), 'odom') is None
    assert matched_pose_message(HEADER, of(Status.NO_MATCH, REJECTED, places=grown), 'odom') is None


@pytest.mark.parametrize(('place', 'around'), [(10, [10, 11, 12]), (59, [57, 58, 59])])
def test_poses_at_the_ends_of_a_route(grown, place, around):
    newest = Match(Status.MATCH, '', NEAREST, np.array([[4, place]], np.int32), 0.3)
    message = matched_pose_message(HEADER, of(Status.MATCH, newest, places=grown), 'map')
    assert message.pose.covariance[0] == pytest.approx(np.var(around))


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_turns_are_about_the_axes_of_the_map(features, axis):
    """Of a camera that looks along an axis of its own; a quaternion's sign says nothing."""
    camera = turned(np.ones(3) / math.sqrt(3), 120)  # x to y, y to z, z to x
    extractor = FeatureExtractor(projection=8)
    route = GrowingMap(extractor.settings, extractor.projection, 10)
    degrees = [-20, -5, 0, 15, 20]
    for i, turn in enumerate(degrees):
        orientation = np.array(product(turned(np.eye(3)[axis], turn), camera)) * (-1) ** i
        route.add(features, pose=np.array([0, 0, 0, *orientation]))
    newest = Match(Status.MATCH, '', NEAREST, np.array([[4, 2]], np.int32), 0.3)
    message = matched_pose_message(HEADER, of(Status.MATCH, newest, places=route), 'map')
    expected = np.full(3, 0.01)
    expected[axis] = np.var(np.radians(degrees))
    np.testing.assert_allclose(message.pose.covariance[21::7], expected, rtol=1e-9)


# ------------------------------------------------ the small ones


@pytest.mark.parametrize('stamp', [0, 1, SECOND - 1, SECOND, 1_700_000_000 * SECOND + 123_456_789])
def test_times_there_and_back(stamp):
    assert nanoseconds(time_message(stamp)) == stamp
    assert time_message(np.int64(stamp)).nanosec == stamp % SECOND


def test_poses_there_and_back():
    pose = np.array([1.5, -2, 3, 0.1, 0.2, 0.3, 0.9])
    odometry = Odometry()
    odometry.pose.pose = pose_message(pose)
    np.testing.assert_array_equal(odometry_pose(odometry), pose)


def test_an_image_there():
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)[:, ::2]
    message = image_message(HEADER, image)
    assert message == Image(header=HEADER, height=6, width=4, step=12, encoding='rgb8', data=message.data)
    assert bytes(message.data) == image.tobytes()


def test_what_is_said_of_a_map(small_map, features):
    extractor = small_map.extractor()
    full = map_info_message('mapping', 'full', 'a', small_map, extractor, Time(sec=3))
    assert (full.operation, full.state, full.path, full.header.stamp.sec) == ('mapping', 'full', 'a', 3)
    assert (full.places, full.features, full.strips, full.dimension, full.format_version) == (
        60, 'gradient', 7, 64, 1
    )  # fmt: skip
    assert full.settings == small_map.settings.to_json()
    assert all((full.projected, full.has_stamps, full.has_ids, full.has_poses, full.has_thumbnails))
    growing = GrowingMap(features.settings, FeatureExtractor(projection=8).projection, 10)
    names = 'projected', 'has_stamps', 'has_ids', 'has_poses', 'has_thumbnails'
    for expected in ((0, 0), (1, 8)):
        info = map_info_message('mapping', 'growing', '', growing, FeatureExtractor(), Time())
        assert (info.places, info.dimension) == expected
        assert not any(getattr(info, name) for name in names)
        growing.add(features)
    nothing = map_info_message('localization', 'none', '', None, None, Time())
    assert (nothing.places, nothing.features, nothing.strips) == (0, '', 0)


# ------------------------------------------------ pictures


def test_a_picture_is_drawn_only_when_somebody_listens(monkeypatch):
    drawn = []
    real = output.drawn
    monkeypatch.setattr(output, 'drawn', lambda outcome: drawn.append(outcome) or real(outcome))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    node = LifecycleNode('stavpr', context=context, enable_communication_interface=False)
    said = output.Output(node, burst=5)
    node.trigger_configure()
    node.trigger_activate()
    bench = Bench()
    outcome = Outcome(Status.NOT_READY, 'no map', image=route_images(1)[0])
    try:
        for _ in range(3):
            assert said.publish(HEADER, outcome).reason == 'no map'
        assert drawn == []
        heard = bench.listen(Image, '/stavpr/match_image')
        bench.until(lambda: said.match_image.get_subscription_count() > 0, 'a listener')
        said.publish(HEADER, Outcome(Status.DROPPED, 'newer ones came'))  # never decoded: nothing to draw
        assert drawn == []

        def hears():
            said.publish(HEADER, outcome)
            return bool(heard)

        bench.until(hears, 'a picture')
        assert heard[0].header == HEADER
        assert len(drawn) >= 1
    finally:
        bench.close()
        said.close()
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_what_a_picture_shows():
    """The words that are written below, for each kind of answer."""
    texts = []
    query, place = route_images(2)
    route = Pipeline(PipelineSettings(sequence=SequenceSettings(5)), 'mapping').places
    for i in range(40):
        route.add(FeatureExtractor().extract([place]), thumbnail=encode_thumbnail(place) if i != 35 else b'')

    def draw(image, picture, text, accepted):
        texts.append((picture is not None, text, accepted))
        assert image is query

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output, 'match_image', draw)
        output.drawn(of(Status.MATCH, MATCHED, places=route, image=query, inliers=20))
        output.drawn(of(Status.NO_MATCH, REJECTED, places=route, image=query))
        output.drawn(of(Status.SKIPPED, image=query))
    assert texts == [
        (False, 'match: place 35, distance 0.250 (threshold 0.300), 20 inliers', True),
        (True, 'no match: place 32, distance 0.250 (threshold 0.300)', False),
        (False, 'skipped because', False),
    ]
