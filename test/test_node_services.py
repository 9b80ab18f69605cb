# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services of the node, and its topics besides ~/match: valid and invalid requests."""

from contextlib import contextmanager
from dataclasses import replace
import os

import cv2
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from image_messages import image_message
from nav_msgs.msg import Odometry
import numpy as np
from processes import Bench, node_process, RELIABLE, TAKEN_RELIABLY
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from stavpr_msgs.msg import MapInfo, PlaceCandidates, PlaceMatch
from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.mapping import load_map, save_map
from std_srvs.srv import Trigger
import torch

LENGTH, SECOND = 5, 10**9
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SHORT = {'sequence_length': LENGTH, 'nms_radius': 5, 'candidates': 3, 'threads': 1}
SHORT |= {'max_places': 100, 'queue_size': 1000, 'keyframe_change': 0.0, 'diagnostics_period': 0.2}


class Robot(Bench):
    """A bench with reliable images, each with a new stamp, and odometry along the route."""

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
        """Image i is taken at x = i; repeated while the node has no pose of that time yet."""
        matches = []
        for x, image in enumerate(images, first):
            self.clock += 1
            place = Odometry()
            place.header.stamp.sec = self.clock
            place.pose.pose.position.x, place.pose.pose.orientation.w = float(x), 1.0
            match = None
            while match is None or 'no odometry' in match.reason:
                self.odometry.publish(place)
                match = self.ask(image_message(image, self.clock * SECOND))
            matches.append(match)
        return matches

    def until_map(self, **fields):
        """Wait until the last ~/map_info has these fields, and return it."""

        def published():
            last = self.infos[-1] if self.infos else None
            return last is not None and all(getattr(last, name) == fields[name] for name in fields)

        self.until(published, f'map_info with {fields}')
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
        """Load a pipe: reading it takes until the end of the block, and then it is no map."""
        os.mkfifo(path)
        futures = []

        def loading():
            return bool(self.infos) and self.infos[-1].state == 'loading'

        with self.request(futures, LoadMap, 'load_map', loading, path=str(path)):
            yield path
            os.close(os.open(path, os.O_WRONLY))  # waits for the reader
            self.until(futures[0].done, 'the match of load_map')
        assert not futures[0].result().success
        assert path.name in futures[0].result().message

    def begin(self, operation, path):
        """Bring a used node into an operation with a map and an empty window."""
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
def nodes(robot, folder):
    """One node at a time, kept until another one is needed; none may have logged a traceback."""
    kept = {}

    def node(name, **parameters):
        if name not in kept:
            end()
            kept[name] = node_process(
                folder / f'{name}.log', **SHORT | TAKEN_RELIABLY | parameters
            )
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
def bare(nodes):
    """Return a node without a map; tests leave it so."""
    return nodes('bare')


@pytest.fixture
def mapped(nodes, robot, map_file):
    """Return a node that localizes on the route, with an empty window."""
    # ~/map_info must not wait for the diagnostics
    process = nodes('mapped', map_path=map_file, diagnostics_period=60.0)
    robot.begin('localization', map_file)
    return process


# ------------------------------------------------ a node without a map


def test_services_without_a_map_return_the_reason(bare, robot, route, tmp_path):
    info = robot.until_map(state='none')
    assert (info.operation, info.path, info.places) == ('localization', '', 0)
    assert 'no map' in robot.drive(route[:1])[0].reason
    for kind, name, fields, words in (
        (Relocalize, 'relocalize', {}, 'no map'),
        (SaveMap, 'save_map', {'path': str(tmp_path / 'nothing.stavpr')}, 'no map'),
        (SaveMap, 'save_map', {}, 'set a path'),
        (LoadMap, 'load_map', {}, 'is no file'),
        (LoadMap, 'load_map', {'path': '/nowhere/a.stavpr'}, 'does not exist'),
        (SetOperation, 'set_operation', {'operation': 'teleport'}, 'teleport'),
    ):
        assert words in robot.refuses(kind, name, **fields)
        assert f'{name} failed: ' in bare.output()
    assert robot.does(Trigger, 'reset').message
    assert list(tmp_path.iterdir()) == []


def test_images_while_the_first_map_is_loaded_are_not_ready(bare, robot, route, tmp_path):
    with robot.while_loading(tmp_path / 'slow.stavpr') as slow:
        matches = robot.drive(route[:5])
        assert {match.status for match in matches} == {PlaceMatch.NOT_READY}
        assert {match.reason for match in matches} == {f'map {slow} is being loaded'}
        robot.until_diagnosed('map', DiagnosticStatus.OK, 'loading')
    robot.until_map(state='none')
    robot.until_diagnosed('map', DiagnosticStatus.ERROR, 'cannot load')
    assert 'no map' in robot.drive(route[:1])[0].reason


def test_a_map_recorded_with_odometry_is_saved_and_gives_poses(nodes, robot, route, folder):
    """From nothing; recognized at once, and after it was loaded from its file."""
    nodes('recording')
    path = folder / 'recorded.stavpr'
    robot.does(SetOperation, 'set_operation', operation='mapping')
    assert robot.set_parameter('keyframe_distance', 0.5)[0]
    assert 'recognizes no places' in robot.refuses(Relocalize, 'relocalize')
    assert 'no places' in robot.refuses(SaveMap, 'save_map', path=str(path))
    matches = robot.drive_with_odometry(route[:40])
    assert {(match.status, match.reason, match.place_index) for match in matches} == {
        (PlaceMatch.MAPPED, '', -1)
    }
    assert [match.newest_index for match in matches] == list(range(40))
    info = robot.until_map(state='growing', places=40)
    assert (info.operation, info.features) == ('mapping', 'gradient')
    assert info.has_poses
    assert info.has_thumbnails
    assert robot.does(SaveMap, 'save_map', path=str(path)).places == 40
    assert 'exists already' in robot.refuses(SaveMap, 'save_map', path=str(path))
    assert 'make it first' in robot.refuses(SaveMap, 'save_map', path=str(folder / 'no' / 'a'))
    assert robot.does(SaveMap, 'save_map', overwrite=True).places == 40  # to its own file
    assert robot.until_map(path=str(path)).places == 40
    saved = load_map(path)
    np.testing.assert_allclose(saved.poses, [[x, 0, 0, 0, 0, 0, 1] for x in range(40)], atol=1e-9)
    first = matches[0].header.stamp.sec
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
        matches = robot.drive(route[10:20])
        statuses = [match.status for match in matches]
        assert statuses == [PlaceMatch.WARMING_UP] * 4 + [PlaceMatch.MATCH] * 6
        assert [match.newest_index for match in matches[4:]] == list(range(14, 20))
        robot.until(lambda: len(poses) == 6, 'a pose for each match')
        for pose, match in zip(poses, matches[4:], strict=True):
            assert (pose.header.stamp, pose.header.frame_id) == (match.header.stamp, 'map')
            position, orientation = pose.pose.pose.position, pose.pose.pose.orientation
            assert (position.x, orientation.w) == (match.newest_index, 1)
            assert pose.pose.covariance[0] == pytest.approx(2.0)  # two places before, two after
    robot.until_map(state='loaded', path=str(path), operation='localization')


# ------------------------------------------------ a node with a map


def test_a_full_map_stops_mapping(mapped, robot, route, map_file, folder):
    robot.begin('mapping', map_file)
    matches = robot.drive((route * 2)[:42])
    statuses = [match.status for match in matches[-3:]]
    assert statuses == [PlaceMatch.MAPPED] + [PlaceMatch.NOT_READY] * 2
    assert 'max_places = 100' in matches[-1].reason
    robot.drive(route[:1])
    assert 'not saved' in robot.refuses(LoadMap, 'load_map', path=str(map_file))
    full = str(folder / 'full.stavpr')
    assert robot.does(SaveMap, 'save_map', path=full, overwrite=True).places == 100
    robot.until_map(state='full', places=100, path=full)
    assert robot.does(LoadMap, 'load_map', path=str(map_file)).map.places == 60
    robot.until_map(state='growing', places=60)
    assert robot.drive(route[:1])[0].newest_index == 60


def test_load_map_during_a_stream_processes_every_image(mapped, robot, small_map, route, folder):
    """At 20 Hz: matches with the old map, a window that fills, matches with the new map."""
    n = 5060
    rng = torch.Generator().manual_seed(0)
    strips = torch.randn((7, n, 64), generator=rng)
    strips /= strips.norm(dim=2, keepdim=True)
    strips[:, 5000:] = small_map.features.strips
    weights = torch.full((7, n), 7**-0.5)
    features = replace(small_map.features, strips=strips, weights=weights)
    large = replace(
        small_map,
        features=features,
        stamps=np.arange(1, n + 1),
        poses=None,
        thumbnails=(),
        ids=tuple(f'new {i - 5000}' for i in range(n)),
    )
    save_map(large, folder / 'large.stavpr')
    robot.until_map(state='loaded', places=60)
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
    robot.until(lambda: len(robot.answers) >= before + len(sent), 'all matches')
    matches = robot.answers[before:]
    assert [match.header for match in matches] == [image.header for image in sent]
    warming = [i for i, match in enumerate(matches) if match.status == PlaceMatch.WARMING_UP]
    assert warming == list(range(warming[0], warming[0] + LENGTH - 1))
    assert 4 <= warming[0] <= during
    old, new = matches[: warming[0]], matches[warming[-1] + 1 :]
    assert {match.newest_id.split()[0] for match in old if match.status == PlaceMatch.MATCH} == {
        'place'
    }
    assert {match.newest_id.split()[0] for match in new if match.status == PlaceMatch.MATCH} == {
        'new'
    }
    assert max(match.sequence_last for match in old) < 60
    robot.until_map(state='loaded', places=n, has_poses=False, has_ids=True)
    shown = [(info.state, info.places) for info in robot.infos[infos:]]
    assert shown == [('loading', 60), ('loaded', n)]


def test_load_map_of_a_damaged_file_keeps_the_map_and_the_window(mapped, robot, route, tmp_path):
    matches = robot.drive(route[:6])
    infos = len(robot.infos)
    with robot.while_loading(tmp_path / 'slow.stavpr'):
        robot.until_map(state='loading', places=60)
        matches += robot.drive(route[6:12])
    matches += robot.drive(route[12:14])
    assert [info.state for info in robot.infos[infos:]] == ['loading', 'loaded']
    damaged = tmp_path / 'damaged.stavpr'
    damaged.write_bytes(b'PK' + bytes(1000))
    assert 'damaged.stavpr' in robot.refuses(LoadMap, 'load_map', path=str(damaged))
    matches += robot.drive(route[14:15])
    assert [match.newest_index for match in matches[4:]] == list(range(4, 15))
    assert robot.does(Trigger, 'reset').message
    assert robot.drive(route[:1])[0].status == PlaceMatch.WARMING_UP


def test_relocalize_returns_the_last_match_and_candidates(mapped, robot, route):
    """Not before the window is full."""
    for i in range(LENGTH):
        assert f'{i} of 5 images' in robot.refuses(Relocalize, 'relocalize')
        match = robot.drive(route[30 + i : 31 + i])[0]
    for count, expected in ((0, 3), (1, 1), (6, 6)):
        response = robot.does(Relocalize, 'relocalize', count=count)
        assert response.match == match
        assert len(response.candidates) == expected
        best = response.candidates[0]
        assert (best.place_index, best.distance) == (match.place_index, match.distance)
        for candidate in response.candidates:
            assert candidate.place_id == f'place {candidate.place_index}'
            assert candidate.place_stamp.sec == candidate.place_index + 1
        indices = np.array([candidate.place_index for candidate in response.candidates])
        assert expected == 1 or np.diff(np.sort(indices)).min() > 5
        distances = [candidate.distance for candidate in response.candidates]
        assert distances == sorted(distances)
    strange = robot.drive(
        [np.random.default_rng(1).integers(0, 256, (96, 128, 3), np.uint8)] * LENGTH
    )[-1]
    assert strange.status == PlaceMatch.NO_MATCH
    response = robot.does(Relocalize, 'relocalize')  # though there is no match
    assert (response.match, response.message) == (strange, strange.reason)


def test_candidates_are_published_for_every_window(mapped, robot, route):
    received = robot.listen(PlaceCandidates, '/stavpr/candidates')
    robot.until(lambda: robot.node.count_publishers('/stavpr/candidates') == 1, 'the candidates')
    matches = robot.drive(route[10:18])
    robot.until(lambda: len(received) == 4, 'candidates of four windows')
    for shown, match in zip(received, matches[4:], strict=True):
        assert (shown.header, shown.threshold) == (match.header, match.threshold)
        assert len(shown.candidates) == 3
        assert shown.candidates[0].place_index == match.sequence_middle
        assert shown.candidates[0].distance == match.distance
        assert shown.candidates[1].place_index == match.second_best_index
    assert robot.set_parameter('candidates', 0)[0]
    robot.drive(route[18:20])
    assert robot.set_parameter('candidates', 2)[0]
    robot.drive(route[20:21])
    robot.until(lambda: len(received) == 5, 'candidates of one more window')
    assert len(received[-1].candidates) == 2
    assert robot.set_parameter('candidates', 3)[0]


def test_a_match_image_shows_the_query_and_its_place(mapped, robot, route, small_map):
    drawn = robot.listen(Image, '/stavpr/match_image')
    robot.drive(route[:4])

    def received():
        robot.drive(route[4:5])
        return bool(drawn)

    robot.until(received, 'an image')
    match = robot.drive(route[5:10])[-1]
    robot.until(lambda: drawn[-1].header == match.header, 'the last image')
    assert match.newest_index == 9
    shown = drawn[-1]
    assert (shown.header, shown.encoding, shown.is_bigendian) == (match.header, 'rgb8', 0)
    assert (shown.height, shown.width, shown.step) == (96 + 18, 2 * 128 + 2, 3 * shown.width)
    image = np.frombuffer(shown.data, np.uint8).reshape(shown.height, shown.width, 3)
    np.testing.assert_array_equal(image[:96, :128], route[9])
    np.testing.assert_array_equal(image[:96, 130:], cv2.resize(small_map.thumbnail(9), (128, 96)))
    assert np.ptp(image[96:, 20:].astype(int)) > 100  # words
