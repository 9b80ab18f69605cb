"""The node's services and what it publishes beside ~/match, from the outside: good requests and bad ones."""

import os
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from image_messages import image_message
from nav_msgs.msg import Odometry
from processes import RELIABLE, TAKEN_RELIABLY, Bench, node_process
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from stavpr_msgs.msg import Candidates, MapInfo, PlaceMatch
from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.mapping import load_map, save_map

LENGTH, SECOND = 5, 10**9
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SHORT = {'sequence_length': LENGTH, 'nms_radius': 5, 'candidates': 3, 'threads': 1, 'max_places': 100,
         'queue_size': 1000, 'keyframe_change': 0.0, 'diagnostics_period': 0.2}  # fmt: skip


class Robot(Bench):
    """A bench whose images are not lost, and which drives along the route; every image has a new stamp."""

    def __init__(self):
        super().__init__(RELIABLE)
        self.odometry = self.node.create_publisher(Odometry, 'odom', 100)
        self.infos = self.listen(MapInfo, '/stavpr/map_info', LATCHED)
        self.clock = 1000

    def stamped(self, image):
        self.clock += 1
        return image_message(image, self.clock * SECOND)

    def drive(self, images):
        return [self.ask(self.stamped(image)) for image in images]

    def drive_with_odometry(self, images, first=0):
        """Image i is taken at x = i. The node skips what it has no pose of yet: then both come once more."""
        answers = []
        for x, image in enumerate(images, first):
            self.clock += 1
            place = Odometry()
            place.header.stamp.sec = self.clock
            place.pose.pose.position.x, place.pose.pose.orientation.w = float(x), 1.0
            answer = None
            while answer is None or 'no odometry' in answer.reason:
                self.odometry.publish(place)
                answer = self.ask(image_message(image, self.clock * SECOND))
            answers.append(answer)
        return answers

    def until_told(self, **fields):
        """Wait until the last ~/map_info says so, and return it."""

        def told():
            last = self.infos[-1] if self.infos else None
            return last is not None and all(getattr(last, name) == fields[name] for name in fields)

        self.until(told, f'map_info with {fields}')
        return self.infos[-1]

    def does(self, kind, name, **fields):
        response = self.call(kind, name, **fields)
        assert response.success, response.message
        return response

    def refuses(self, kind, name, **fields):
        response = self.call(kind, name, **fields)
        assert not response.success
        return response.message

    @contextmanager
    def while_loading(self, path):
        """Have the node load a pipe, which nobody writes into until the block ends: it is no map then."""
        os.mkfifo(path)
        futures = []

        def loading():
            return bool(self.infos) and self.infos[-1].state == 'loading'

        with self.request(futures, LoadMap, 'load_map', loading, path=str(path)):
            yield path
            os.close(os.open(path, os.O_WRONLY))  # waits for the reader
            self.until(futures[0].done, 'the answer of load_map')
        assert not futures[0].result().success
        assert path.name in futures[0].result().message

    def begin(self, operation, path):
        """Bring a node that other tests have used into an operation with a map and an empty window."""
        self.does(SetOperation, 'set_operation', operation='localization')
        self.does(LoadMap, 'load_map', path=str(path))
        self.does(SetOperation, 'set_operation', operation=operation)
        self.does(Trigger, 'reset')


@pytest.fixture(scope='module')
def robot():
    robot = Robot()
    yield robot
    robot.close()


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('maps')


@pytest.fixture(scope='module')
def map_file(small_map, folder):
    save_map(small_map, folder / 'route.stavpr')
    return folder / 'route.stavpr'


@pytest.fixture(scope='module')
def _nodes(robot, folder):
    """One node at a time, kept until another one is asked for; none of them may have stumbled."""
    kept = {}

    def node(name, **parameters):
        if name not in kept:
            end()
            kept[name] = node_process(folder / f'{name}.log', **SHORT | TAKEN_RELIABLY | parameters)
            robot.wait_for_node()
        return kept[name]

    def end():
        for process in kept.values():
            assert process.stop() == 0
            assert 'Traceback' not in process.output()
        if kept:
            robot.wait_for_nobody()
        kept.clear()

    yield node
    end()


@pytest.fixture
def bare(_nodes):
    """A node without a map."""
    return _nodes('bare')


@pytest.fixture
def mapped(_nodes, robot, map_file):
    """A node that localizes on the route, with an empty window."""
    # ~/map_info must not wait for the diagnostics
    process = _nodes('mapped', map_path=map_file, diagnostics_period=60.0)
    robot.begin('localization', map_file)
    return process


# ------------------------------------------------ a node without a map: the first tests of this file


def test_without_a_map_everything_says_what_is_missing(bare, robot, route, tmp_path):
    info = robot.until_told(state='none')
    assert (info.operation, info.path, info.places) == ('localization', '', 0)
    assert 'map_path' in robot.drive(route[:1])[0].reason
    assert 'map_path' in robot.refuses(Relocalize, 'relocalize')
    assert 'map_path' in robot.refuses(SaveMap, 'save_map', path=str(tmp_path / 'nothing.stavpr'))
    assert 'name a file' in robot.refuses(SaveMap, 'save_map')
    assert 'names no file' in robot.refuses(LoadMap, 'load_map')
    assert 'does not exist' in robot.refuses(LoadMap, 'load_map', path='/nowhere/a.stavpr')
    assert 'teleport' in robot.refuses(SetOperation, 'set_operation', operation='teleport')
    assert robot.does(Trigger, 'reset').message
    assert list(tmp_path.iterdir()) == []


def test_images_that_come_while_the_first_map_is_loaded_are_answered(bare, robot, route, tmp_path):
    with robot.while_loading(tmp_path / 'slow.stavpr') as slow:
        answers = robot.drive(route[:5])
        assert {answer.status for answer in answers} == {PlaceMatch.NOT_READY}
        assert {answer.reason for answer in answers} == {f'map {slow} is being loaded'}
        robot.until_diagnosed('map', DiagnosticStatus.OK, 'loading')
    robot.until_told(state='none')
    robot.until_diagnosed('map', DiagnosticStatus.ERROR, 'cannot load')
    assert 'map_path' in robot.drive(route[:1])[0].reason


def test_from_mapping_with_odometry_to_poses(bare, robot, route, folder):
    """Mapping from nothing, saved, loaded by a service, recognized; and live from mapping to localization."""
    path = folder / 'grown.stavpr'
    robot.does(SetOperation, 'set_operation', operation='mapping')
    assert robot.set_parameter('keyframe_distance', 0.5)[0]
    assert 'mapping recognizes nothing' in robot.refuses(Relocalize, 'relocalize')
    assert 'no places' in robot.refuses(SaveMap, 'save_map', path=str(path))
    answers = robot.drive_with_odometry(route[:40])
    assert {(answer.status, answer.reason, answer.place_index) for answer in answers} == {
        (PlaceMatch.MAPPED, '', -1)
    }
    assert [answer.newest_index for answer in answers] == list(range(40))
    info = robot.until_told(state='growing', places=40)
    assert (info.operation, info.features, info.has_poses, info.has_thumbnails) == (
        'mapping',
        'gradient',
        True,
        True,
    )
    assert robot.does(SaveMap, 'save_map', path=str(path)).places == 40
    assert 'is there already' in robot.refuses(SaveMap, 'save_map', path=str(path))
    assert 'make it first' in robot.refuses(SaveMap, 'save_map', path=str(folder / 'no' / 'a.stavpr'))
    assert robot.does(SaveMap, 'save_map', path=str(path), overwrite=True).places == 40
    assert robot.until_told(path=str(path)).places == 40
    saved = load_map(path)
    np.testing.assert_allclose(saved.poses, [[x, 0, 0, 0, 0, 0, 1] for x in range(40)], atol=1e-9)
    first = answers[0].header.stamp.sec
    assert [stamp // SECOND for stamp in saved.stamps] == [first + x for x in range(40)]

    poses = robot.listen(PoseWithCovarianceStamped, '/stavpr/pose')
    assert robot.set_parameter('keyframe_distance', 0.0)[0]
    for load in (False, True):
        if load:
            assert robot.does(LoadMap, 'load_map', path=str(path)).map.places == 40
        else:
            robot.does(SetOperation, 'set_operation', operation='localization')
        robot.until(lambda: robot.node.count_publishers('/stavpr/pose') == 1, 'the poses')
        poses.clear()
        answers = robot.drive(route[10:20])
        assert [answer.status for answer in answers] == [PlaceMatch.WARMING_UP] * 4 + [PlaceMatch.MATCH] * 6
        assert [answer.newest_index for answer in answers[4:]] == list(range(14, 20))
        robot.until(lambda: len(poses) == 6, 'a pose for each match')
        for pose, answer in zip(poses, answers[4:], strict=True):
            assert (pose.header.stamp, pose.header.frame_id) == (answer.header.stamp, 'map')
            assert (pose.pose.pose.position.x, pose.pose.pose.orientation.w) == (answer.newest_index, 1)
            assert pose.pose.covariance[0] == pytest.approx(2.0)  # of two places before and two after it
    robot.until_told(state='loaded', path=str(path), operation='localization')


def test_a_map_that_is_full_says_so(bare, robot, route, folder):
    robot.does(SetOperation, 'set_operation', operation='mapping')
    places = robot.until_told(operation='mapping').places
    answers = robot.drive((route * 2)[: 100 - places + 2])
    assert [answer.status for answer in answers[-3:]] == [PlaceMatch.MAPPED] + [PlaceMatch.NOT_READY] * 2
    assert 'max_places = 100' in answers[-1].reason
    robot.until_told(state='full', places=100)
    robot.until_diagnosed('map', DiagnosticStatus.WARN, 'full')
    path = str(folder / 'full.stavpr')
    assert 'not saved' in robot.refuses(LoadMap, 'load_map', path=str(folder / 'grown.stavpr'))
    assert robot.does(SaveMap, 'save_map', path=path).places == 100
    assert robot.does(LoadMap, 'load_map', path=str(folder / 'grown.stavpr')).map.places == 40
    robot.until_told(state='growing', places=40)
    assert robot.drive(route[:1])[0].newest_index == 40


# ------------------------------------------------ a node with a map


def test_a_map_is_swapped_under_a_stream(mapped, robot, small_map, route, folder):
    """At 20 Hz: every image has one answer, of the old map; then the window fills; then of the new one."""
    n = 5060
    rng = torch.Generator().manual_seed(0)
    strips = torch.randn((7, n, 64), generator=rng)
    strips /= strips.norm(dim=2, keepdim=True)
    strips[:, 5000:] = small_map.features.strips
    weights = torch.full((7, n), 7**-0.5)
    features = replace(small_map.features, strips=strips, weights=weights)
    large = replace(small_map, features=features, stamps=np.arange(1, n + 1), poses=None, thumbnails=(),
                    ids=tuple(f'new {i - 5000}' for i in range(n)))  # fmt: skip
    save_map(large, folder / 'large.stavpr')
    robot.until_told(state='loaded', places=60)
    robot.drive(route[20:28])
    before, infos = len(robot.answers), len(robot.infos)
    sent = []

    def publish():
        sent.append(robot.stamped(route[28 + len(sent) % 30]))
        robot.publisher.publish(sent[-1])

    timer = robot.node.create_timer(0.05, publish)
    robot.until(lambda: len(sent) >= 4, 'a stream')
    loaded = robot.does(LoadMap, 'load_map', path=str(folder / 'large.stavpr')).map
    assert (loaded.places, loaded.path) == (n, str(folder / 'large.stavpr'))
    during = len(sent)
    robot.until(lambda: len(sent) >= during + 2 * LENGTH, 'more of the stream')
    robot.node.destroy_timer(timer)
    robot.until(lambda: len(robot.answers) >= before + len(sent), 'all answers')
    answers = robot.answers[before:]
    assert [answer.header for answer in answers] == [image.header for image in sent]
    warming = [i for i, answer in enumerate(answers) if answer.status == PlaceMatch.WARMING_UP]
    assert warming == list(range(warming[0], warming[0] + LENGTH - 1))
    assert 4 <= warming[0] <= during
    old, new = answers[: warming[0]], answers[warming[-1] + 1 :]
    assert {answer.newest_id.split()[0] for answer in old if answer.status == PlaceMatch.MATCH} == {'place'}
    assert {answer.newest_id.split()[0] for answer in new if answer.status == PlaceMatch.MATCH} == {'new'}
    assert max(answer.sequence_last for answer in old) < 60
    robot.until_told(state='loaded', places=n, has_poses=False, has_ids=True)
    told = [(info.state, info.places) for info in robot.infos[infos:]]
    assert told == [('loading', 60), ('loaded', n)]


def test_a_damaged_map_leaves_the_old_one_in_use(mapped, robot, route, tmp_path):
    """While it is read, the window goes on, and after it as well."""
    answers = robot.drive(route[:6])
    infos = len(robot.infos)
    with robot.while_loading(tmp_path / 'slow.stavpr'):
        robot.until_told(state='loading', places=60)
        answers += robot.drive(route[6:12])
    answers += robot.drive(route[12:14])  # told at once, not with the next diagnostics
    assert [info.state for info in robot.infos[infos:]] == ['loading', 'loaded']
    damaged = tmp_path / 'damaged.stavpr'
    damaged.write_bytes(b'PK' + bytes(1000))
    assert 'damaged.stavpr' in robot.refuses(LoadMap, 'load_map', path=str(damaged))
    answers += robot.drive(route[14:15])
    assert [answer.newest_index for answer in answers[4:]] == list(range(4, 15))
    assert robot.does(Trigger, 'reset').message
    assert robot.drive(route[:1])[0].status == PlaceMatch.WARMING_UP


def test_relocalize(mapped, robot, route):
    """Not before the window is full; then the answer that was given, and candidates as many as asked for."""
    for i in range(LENGTH):
        assert f'{i} of 5 images' in robot.refuses(Relocalize, 'relocalize')
        answer = robot.drive(route[30 + i : 31 + i])[0]
    for count, expected in ((0, 3), (1, 1), (6, 6)):
        response = robot.does(Relocalize, 'relocalize', count=count)
        assert response.match == answer
        assert len(response.candidates) == expected
        best = response.candidates[0]
        assert (best.place_index, best.distance) == (answer.place_index, answer.distance)
        for candidate in response.candidates:
            assert candidate.place_id == f'place {candidate.place_index}'
            assert candidate.place_stamp.sec == candidate.place_index + 1
        indices = np.array([candidate.place_index for candidate in response.candidates])
        assert expected == 1 or np.diff(np.sort(indices)).min() > 5
        distances = [candidate.distance for candidate in response.candidates]
        assert distances == sorted(distances)
    strange = robot.drive([np.random.default_rng(1).integers(0, 256, (96, 128, 3), np.uint8)] * LENGTH)[-1]
    assert strange.status == PlaceMatch.NO_MATCH
    response = robot.does(Relocalize, 'relocalize')  # an answer, though no match
    assert (response.match, response.message) == (strange, strange.reason)


def test_candidates_are_told_with_every_window(mapped, robot, route):
    heard = robot.listen(Candidates, '/stavpr/candidates')
    robot.until(lambda: robot.node.count_publishers('/stavpr/candidates') == 1, 'the candidates')
    answers = robot.drive(route[10:18])
    robot.until(lambda: len(heard) == 4, 'candidates of four windows')
    for told, answer in zip(heard, answers[4:], strict=True):
        assert (told.header, told.threshold) == (answer.header, answer.threshold)
        assert len(told.candidates) == 3
        assert told.candidates[0].place_index == answer.sequence_middle
        assert told.candidates[0].distance == answer.distance
        assert told.candidates[1].place_index == answer.second_best_index
    assert robot.set_parameter('candidates', 0)[0]
    robot.drive(route[18:20])
    assert robot.set_parameter('candidates', 2)[0]
    robot.drive(route[20:21])
    robot.until(lambda: len(heard) == 5, 'candidates of one more window')
    assert len(heard[-1].candidates) == 2
    assert robot.set_parameter('candidates', 3)[0]


def test_a_match_image_shows_the_query_and_its_place(mapped, robot, route, small_map):
    drawn = robot.listen(Image, '/stavpr/match_image')
    robot.drive(route[:4])

    def hears():
        """A subscriber that is matched hears the next picture."""
        robot.drive(route[4:5])
        return bool(drawn)

    robot.until(hears, 'a picture')
    answer = robot.drive(route[5:10])[-1]
    robot.until(lambda: drawn[-1].header == answer.header, 'the last picture')
    assert answer.newest_index == 9
    told = drawn[-1]
    assert (told.header, told.encoding, told.is_bigendian) == (answer.header, 'rgb8', 0)
    assert (told.height, told.width, told.step) == (96 + 18, 2 * 128 + 2, 3 * told.width)
    picture = np.frombuffer(told.data, np.uint8).reshape(told.height, told.width, 3)
    np.testing.assert_array_equal(picture[:96, :128], route[9])
    np.testing.assert_array_equal(picture[:96, 130:], cv2.resize(small_map.thumbnail(9), (128, 96)))
    assert np.ptp(picture[96:, 20:].astype(int)) > 100  # words
