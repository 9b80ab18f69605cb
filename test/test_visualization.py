# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Topics for viewers and navigation: by a stand-in for the publishers, and of the node."""

from dataclasses import replace
from itertools import pairwise
import json
import math
from pathlib import Path as Pathname
import re
import subprocess
import sys
import threading
from types import ModuleType, SimpleNamespace

from ament_index_python.packages import get_package_share_directory
from builtin_interfaces.msg import Time
import cv2
from fixtures import route_images
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
import numpy as np
from pipelines import at, LENGTH, localizing, message, process, record, SECOND
from processes import environment, TIMEOUT
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import qos_profile_services_default
from rclpy.time import Time as RclTime
from robot import LATCHED
from scipy.spatial.transform import Rotation
from stavpr_msgs.msg import PlaceMatch
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import GrowingMap, save_map
from stavpr_ros.mapping.transforms import matrices
from stavpr_ros.method import Match, Status
from stavpr_ros.method import match as match_module
from stavpr_ros.pipeline import ImageResult
from stavpr_ros.pipeline.operations import NOT_A_KEYFRAME
from stavpr_ros.pipeline.overlay import draw_match, draw_window
from stavpr_ros.ros.messages import matched_pose_message, Outcome, pose_message, Surroundings
from stavpr_ros.ros.navigation import map_to_odometry, Navigation, planar
from stavpr_ros.ros.visualization import color, GROWTH, Visualization
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray
import yaml

TOPICS = {'map_path', 'matched_path', 'markers', 'match_image/compressed', 'window_image'}
TOPICS |= {'distances'}


class Publisher:
    def __init__(self, is_requested):
        self.is_requested, self.messages = is_requested, []
        self.publish = self.messages.append

    def get_subscription_count(self):
        return int(self.is_requested)


class Publishers:
    """Makes publishers for a visualization; only the topics of ``requested`` have a subscriber."""

    def __init__(self, requested):
        self.requested, self.by_topic = requested, {}
        self.context = SimpleNamespace(ok=lambda: True)

    def create_publisher(self, kind, topic, qos, event_callbacks=None):
        topic = topic.removeprefix('~/')
        self.by_topic[topic] = Publisher(topic in self.requested)
        return self.by_topic[topic]

    def destroy_publisher(self, publisher):
        """Nothing is left of it."""

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=Time))

    def messages(self, topic):
        return self.by_topic[topic].messages


def views_of(*requested):
    publishers = Publishers(requested)
    return Visualization(publishers, lambda: None, lambda: None), publishers


def show(views, header, result, operation, frame, odometry=None):
    """Publish a result of an operation."""
    views.operation = lambda: operation
    about = Surroundings(frame, pose=odometry)
    views.publish(Outcome(header, result, operation.matched_places, about))


def header(i=0):
    return Header(stamp=Time(sec=i + 1), frame_id='camera')


@pytest.fixture
def localization(map_file, route):
    """Return a pipeline whose window is matched, and the match of the last image."""
    pipeline = localizing(map_file)
    return pipeline, process(pipeline, route[: LENGTH + 4])[-1]


def test_visualization_without_subscribers_publishes_and_draws_nothing(localization):
    pipeline, match = localization
    pipeline.operation.recognizer.newest_row = lambda: pytest.fail('not requested')
    views, publishers = views_of()
    show(views, header(), match, pipeline.operation, 'map')
    views.publish_route(pipeline.places, 'map')
    assert set(publishers.by_topic) == TOPICS
    assert not any(publisher.messages for publisher in publishers.by_topic.values())
    assert not views.needs_candidates


def test_visualization_of_a_match_publishes_routes_and_markers(localization):
    pipeline, result = localization
    match = result.match
    assert match.accepted
    views, publishers = views_of('map_path', 'matched_path', 'markers')
    for i in range(2):
        show(views, header(i), result, pipeline.operation, 'map')
    (route,) = publishers.messages('map_path')  # it has not changed
    assert route.header.frame_id == 'map'
    assert [stamped.pose.position.x for stamped in route.poses] == list(range(60))
    last = publishers.messages('matched_path')[-1].poses
    place = float(match.newest)
    assert [(p.header.stamp.sec, p.pose.position.x) for p in last] == [(1, place), (2, place)]
    assert views.needs_candidates
    clear, ball, *candidates, text = publishers.messages('markers')[-1].markers
    assert clear.action == Marker.DELETEALL
    assert (ball.type, ball.pose.position.x) == (Marker.SPHERE, place)
    assert ball.color == color(match.probability)
    assert len(candidates) == len(result.candidates)
    assert text.text == f'place {match.newest}, p {match.probability:.2f}'
    shown = [clear, ball, *candidates, text]
    assert len({marker.id for marker in shown}) == len(shown)


def test_visualization_of_an_image_without_a_match_shows_no_place(localization):
    pipeline, _ = localization
    views, publishers = views_of(*TOPICS)
    show(views, header(), ImageResult(Match(Status.DROPPED, 'because')), pipeline.operation, 'map')
    assert [m.action for m in publishers.messages('markers')[0].markers] == [Marker.DELETEALL]
    assert not publishers.messages('matched_path')
    assert not publishers.messages('match_image/compressed')


def test_visualization_of_loop_closures_connects_query_and_place(route):
    pipeline = record(route, 'loop_closure')
    views, publishers = views_of('markers', 'map_path')
    matches = process(pipeline, route[:30], first=30, poses=True)
    for i, match in enumerate(matches):
        show(views, header(i), match, pipeline.operation, 'odom')
    accepted = [result.match for result in matches if result.match.accepted]
    lines = publishers.messages('markers')[-1].markers[1]
    assert lines.type == Marker.LINE_LIST
    assert len(lines.points) == len(lines.colors) == 2 * len(accepted) > 0
    last = pipeline.places.place(accepted[-1].newest).pose[0]
    assert lines.points[-1].x == last
    assert all(message.header.frame_id == 'odom' for message in publishers.messages('map_path'))


def test_visualization_on_a_map_connects_odometry_and_place(map_file, route):
    """The odometry drifts by .1 m an image, across; the frames differ by a quarter turn."""
    pipeline = localizing(map_file)
    views, publishers = views_of('markers')
    matches = process(pipeline, route[: LENGTH + 4])
    for i, match in enumerate(matches):
        odometry = np.array([0.1 * i, i, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)])
        show(views, header(i), match, pipeline.operation, 'map', odometry)
    accepted = [result.match for result in matches if result.match.accepted]
    assert len(accepted) > 2
    lines = publishers.messages('markers')[-1].markers[1]
    assert lines.type == Marker.LINE_LIST
    assert len(lines.points) == len(lines.colors) == 2 * len(accepted) - 2
    assert lines.colors[-1] == color(accepted[-1].probability)
    query, place = lines.points[-2:]
    pose = pipeline.places.place(accepted[-1].newest).pose
    assert place.x == pose[0]
    assert np.hypot(query.x - place.x, query.y - place.y) == pytest.approx(0.1, abs=1e-6)
    show(views, header(99), matches[0], localizing(map_file).operation, 'map', odometry)
    assert len(publishers.messages('markers')[-1].markers) == 1  # another map: deleted


def test_visualization_of_a_growing_route_is_published_when_it_has_grown(route):
    pipeline = record(route, count=30)
    views, publishers = views_of('map_path')
    for i in range(30, 60):
        (match,) = process(pipeline, route[i : i + 1], i, True)
        show(views, header(), match, pipeline.operation, '')
    sizes = [len(message.poses) for message in publishers.messages('map_path')]
    assert sizes[0] == 31
    assert all(b >= a * GROWTH for a, b in pairwise(sizes))
    assert 5 < len(sizes) < 20


def test_visualization_of_distances_is_the_newest_row(localization):
    pipeline, match = localization
    views, publishers = views_of('distances', 'window_image', 'match_image/compressed')
    show(views, header(), match, pipeline.operation, 'map')
    (row,) = publishers.messages('distances')
    assert (row.encoding, row.width) == ('32FC2', 60)
    values, numbers = np.frombuffer(row.data, np.float32).reshape(-1, 2).T
    assert numbers.tolist() == list(range(60))
    np.testing.assert_array_equal(values, pipeline.operation.recognizer.newest_row())
    assert values.argmin() == match.match.newest
    assert len(publishers.messages('window_image')) == 1
    (jpeg,) = publishers.messages('match_image/compressed')
    drawn = cv2.imdecode(np.frombuffer(jpeg.data, np.uint8), cv2.IMREAD_COLOR)
    expected = draw_match(match, pipeline.places).astype(int)
    error, swapped = (np.abs(drawn[..., ::step] - expected).mean() for step in (-1, 1))
    assert error < 10 < swapped


def test_visualization_of_distances_states_the_places_after_an_eviction():
    extractor = FeatureExtractor('gradient', projection=8)
    features = extractor.extract(route_images(1))
    route = GrowingMap(extractor.settings, extractor.projection, 1200)
    for _ in range(1200):
        route.add(features)
    route.first = 3000
    row = np.arange(1200, dtype=np.float32)
    views, publishers = views_of('distances')
    recognizer = SimpleNamespace(window_fill=1, newest_row=lambda: row)
    operation = SimpleNamespace(matched_places=route, recognizer=recognizer)
    show(views, header(), ImageResult(Match(Status.NO_MATCH)), operation, 'map')
    (message,) = publishers.messages('distances')
    values, numbers = np.frombuffer(message.data, np.float32).reshape(-1, 2).T
    assert (message.width, numbers[0]) == (512, 3000)
    np.testing.assert_array_equal(numbers, values + 3000)


@pytest.mark.parametrize('places', [1, 40, 300])
def test_draw_window_shows_the_path_over_its_places(places):
    rows = np.ones((5, places), np.float32)
    rows[:, places // 2] = 0
    rows[:, 0] = np.inf
    pairs = np.array([[i, places // 2] for i in range(5)], np.int32)
    path = match_module.Path(pairs, places // 2)
    match = Match(Status.MATCH, path=path, probability=0.9)
    drawn = draw_window(rows, 0, match)
    without = draw_window(rows, 0, Match(Status.WARMING_UP))
    assert 200 < drawn.shape[1] < 1400
    assert (drawn == 255).all(axis=2).any()
    if places <= 40:
        assert drawn.shape == without.shape
        assert (drawn != without).any()


DISPLAYS = {
    'Path': 'nav_msgs/msg/Path',
    'MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'PoseWithCovariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    'Image': 'sensor_msgs/msg/Image',
}


def test_node_publishes_for_viewers_and_navigation(robot, start, route):
    """The topics of the layouts; the route for a late subscriber, others with the first match."""
    start(publish_initialpose=True)
    config = Pathname(get_package_share_directory('stavpr_ros')) / 'config'
    rviz = yaml.safe_load((config / 'stavpr.rviz').read_text())['Visualization Manager']
    named = {
        (display['Topic']['Value'], DISPLAYS[display['Class'].partition('/')[2]])
        for display in rviz['Displays']
        if 'Topic' in display
    }
    assert len(named) >= 6
    foxglove = json.loads((config / 'foxglove.json').read_text())
    topics = set(re.findall(r'"(/stavpr/[a-z_/]+)', json.dumps(foxglove)))
    assert len(topics) >= 7

    def topic_types():
        return dict(robot.node.get_publisher_names_and_types_by_node('stavpr', '/'))

    robot.until(lambda: topics <= topic_types().keys(), f'publishers of {sorted(topics)}')
    for topic, kind in named:
        assert topic_types()[topic] == [kind]

    def panels(part):
        return {part} if isinstance(part, str) else panels(part['first']) | panels(part['second'])

    assert panels(foxglove['layout']) == set(foxglove['configById'])
    routes = robot.listen(Path, '/stavpr/map_path', LATCHED)
    robot.until(lambda: routes, 'the route')
    assert (len(routes[0].poses), routes[0].header.frame_id) == (60, 'map')
    markers = robot.listen(MarkerArray, '/stavpr/markers')
    poses = robot.listen(PoseWithCovarianceStamped, '/initialpose')
    robot.until(lambda: robot.node.count_publishers('/initialpose') == 1, 'the publisher')
    shown = iter(route)
    robot.until(lambda: robot.show(next(shown)).status == PlaceMatch.MATCH, 'a match')
    robot.until(lambda: markers and poses, 'the markers and the initial pose')
    assert poses[0].header.frame_id == 'map'


ABOUT = Surroundings('map', odometry_frame='odom')


def pose_of(x, y, degrees):
    return np.array([x, y, 0, *Rotation.from_euler('z', degrees, degrees=True).as_quat()])


def test_map_to_odometry_takes_the_pose_of_odometry_to_that_of_the_map():
    place, odometry = pose_of(5, 2, 90), pose_of(1, 0, 0)
    np.testing.assert_allclose(map_to_odometry(place, odometry), pose_of(5, 1, 90), atol=1e-12)
    # the odometry's frame in the map, then the robot in that: the robot in the map
    rng = np.random.default_rng(0)
    place, odometry = (
        np.concatenate([rng.normal(size=3), Rotation.random(rng=rng).as_quat()]) for _ in range(2)
    )
    result = matrices(map_to_odometry(place, odometry)) @ matrices(odometry)
    np.testing.assert_allclose(result, matrices(place), atol=1e-12)


def test_pose_is_turned_by_the_mountings_of_the_cameras(small_map):
    poses = np.tile(pose_of(0, 0, 30), (len(small_map), 1))
    poses[:, 0] = np.arange(len(poses))
    places = replace(small_map, poses=poses)
    path = match_module.Path(np.column_stack([np.arange(4), np.arange(10, 6, -1)]), 9)
    result = ImageResult(Match(Status.MATCH, path=path), relative_yaw=math.pi)
    message = matched_pose_message(Outcome(header(0), result, places, Surroundings('map')))
    o = message.pose.pose.orientation
    assert message.pose.pose.position.x == 7
    assert abs(np.array([o.x, o.y, o.z, o.w]) @ pose_of(0, 0, 210)[3:]) == pytest.approx(1)
    assert message.pose.covariance[35] == 0.01


def test_planar_keeps_yaw_and_has_the_covariance_of_x_y_and_yaw_only():
    tilted = Rotation.from_euler('ZYX', [40, 20, 10], degrees=True).as_quat()
    message = PoseWithCovarianceStamped()
    message.pose.pose = pose_message(np.array([1, 2, 3, *tilted]))
    message.pose.covariance[::7] = [0.01, 4.0, 0.3, 0.3, 0.3, 0.01]
    message.pose.covariance[1] = message.pose.covariance[6] = 0.2
    flat = planar(message).pose
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
    publishers = Publishers({'initialpose'})
    publishers.get_clock = lambda: SimpleNamespace(now=lambda: RclTime(seconds=clock.time))
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
        subscriber=publishers.by_topic['initialpose'],
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
    publishing.navigation.reset()
    assert publishing.show(route[30:45], 30)[:: LENGTH - 1][:2] == [False, True]
    assert len(publishing.initial) == 2
    assert publishing.initial[-1].header.stamp.sec > 30


W, N, M, X, S = 'warming up', 'no match', 'match', 'no pose', 'skipped'


def publish_statuses(publishing, statuses, first=0):
    """Publish an image of each status at the place of its number."""
    places = publishing.pipeline.places
    for i, status in enumerate(statuses, first):
        code = {W: Status.WARMING_UP, N: Status.NO_MATCH, M: Status.MATCH, X: Status.MATCH}
        cause = '' if status in code else NOT_A_KEYFRAME if status == S else status
        path = match_module.Path(np.array([[LENGTH - 1, i]]), i)
        result = ImageResult(Match(code.get(status, Status.SKIPPED), path=path), cause)
        publishing.navigation.publish(Outcome(header(i), result, places, ABOUT))
    return [pose.header.stamp.sec - 1 for pose in publishing.initial]


@pytest.mark.parametrize(
    ('statuses', 'sent'),
    [
        ([W, W, M, W, W, M], [2]),  # two early matches of one start
        ([W, M, N, M, 'no odometry', S, M, *[N] * (LENGTH - 2), M], [1]),
        ([M, *[N] * (LENGTH - 1), M], [0, LENGTH]),
        ([M, *[W] * (LENGTH - 1), M], [0, LENGTH]),
        ([X, X, M, M], [2]),  # the first places have no pose
    ],
)
def test_statuses_between_two_matches_are_no_relocalization(publishing, statuses, sent):
    publishing.pipeline.places.poses[[i for i, s in enumerate(statuses) if s == X]] = np.nan
    assert publish_statuses(publishing, statuses) == sent


@pytest.mark.parametrize(
    ('before', 'after', 'sent'),
    [
        ([M], [M, M], [1]),
        ([M, M], [S, S, M], [1]),  # of a robot that has stopped
        ([M], [N, N, M], [3]),
        ([M], ['no odometry', S, M], [3]),  # it may have moved
        ([], [W, M], [1]),
    ],
)
def test_initial_pose_waits_for_a_subscriber(publishing, before, after, sent):
    publishing.subscriber.is_requested = False
    assert not publish_statuses(publishing, before)
    publishing.subscriber.is_requested = True
    assert publish_statuses(publishing, after, len(before)) == sent
    publishing.subscriber.is_requested = False  # another AMCL takes its place
    publish_statuses(publishing, [S], 10)
    publishing.subscriber.is_requested = True
    assert publish_statuses(publishing, [M, M], 11) == [*sent, 11]


def test_navigation_on_a_growing_route_publishes_nothing(publishing, route):
    publishing.pipeline.change(operation='mapping')
    publishing.show(route[:10])
    assert not publishing.tf
    assert not publishing.initial


@pytest.mark.parametrize(
    ('parameters', 'problem'),
    [
        ({'publish_tf': True}, 'publish_tf requires the package tf2_msgs: install it'),
        ({'map_path': '/nowhere.stavpr'}, 'nowhere'),
        ({'operation': 'mapping', 'features': 'auto', 'model_path': '/no'}, 'model_path'),
    ],
)
def test_configuration_that_fails_leaves_no_thread(make_node, hide_module, parameters, problem):
    """One without tf2_msgs fails at the publishers, the others at the map and the model."""
    hide_module('tf2_msgs.msg')
    node, before = make_node(**parameters), set(threading.enumerate())
    assert node.trigger_configure() == TransitionCallbackReturn.ERROR
    assert problem in node.problem
    assert node.state == 'unconfigured'
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize('parameter', [('publish_initialpose', True), ('relative_pose', 'pnp')])
def test_map_without_poses_is_refused_where_they_are_required(
    make_node, small_map, tmp_path, parameter
):
    save_map(replace(small_map, poses=None), tmp_path / 'map')
    node = make_node(map_path=str(tmp_path / 'map'), **dict([parameter]))
    assert node.trigger_configure() == TransitionCallbackReturn.ERROR
    assert re.search(f'{parameter[0]}.* requires poses', node.problem)


def test_example_of_bridges_publishes_a_pose_at_the_start_and_on_each_request(robot, start, route):
    """Of its map only; the topics have the QoS of Isaac ROS Visual SLAM 4.6."""
    page = Pathname(__file__).parents[1] / 'docs' / 'bridges.md'
    code = re.search('```python\n(.*?)```', page.read_text(), re.DOTALL)[1]
    command = [sys.executable, '-c', code, '--ros-args', '-p', 'min_probability:=0.05']
    kind = PoseWithCovarianceStamped
    hints = robot.listen(kind, 'initial_pose', qos_profile_services_default)
    requests = robot.node.create_publisher(kind, 'trigger_hint', 10)
    start()
    ids = (robot.until_map(state='loaded').map_id, '0123456789abcdef')
    programs = [
        subprocess.Popen([*command, '-p', f'map_id:="{i}"'], env=environment()) for i in ids
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
