# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services, states and transitions of the node: valid and invalid requests at any time."""

from contextlib import contextmanager
import dataclasses
from dataclasses import replace
import threading
import weakref

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
import pytest
from rcl_interfaces.srv import GetParameters
from robot import image_message, LATCHED, LENGTH, SECOND
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import load_map, Map, save_map
from stavpr_ros.pipeline import read_map
from stavpr_ros.ros import map_loading, runtime
from std_srvs.srv import Trigger

PAPER = {'mode': 'paper', 'threshold': 0.2}  # certain after one window


@pytest.fixture
def disk(monkeypatch):
    """Return an event: while it is not set, the disk does not deliver maps."""
    ready = threading.Event()
    ready.set()
    monkeypatch.setattr(runtime, 'read_map', lambda *file: (ready.wait(), read_map(*file))[1])
    yield ready
    ready.set()


@contextmanager
def while_loading(robot, path, disk):
    """Load a file: reading it takes until the end of the block, and then there is none."""
    futures = []

    def loading():
        return bool(robot.infos) and robot.infos[-1].state == 'loading'

    disk.clear()
    with robot.request(futures, LoadMap, 'load_map', loading, path=str(path)):
        yield path
        disk.set()
        robot.until(futures[0].done, 'the response of load_map')
    assert not futures[0].result().success
    assert path.name in futures[0].result().message


def test_services_while_a_map_is_loaded_are_served(robot, start, route, tmp_path, disk):
    """All but a second load_map: a file on a broken disk stops nothing else."""
    start(map_path='', operation='mapping')
    robot.drive(route[:3])
    with while_loading(robot, tmp_path / 'slow.stavpr', disk):
        robot.does(SaveMap, 'save_map', path=str(tmp_path / 'recorded.stavpr'))
        robot.does(Trigger, 'reset')
        robot.does(SetOperation, 'set_operation', operation='localization')
        robot.set(min_probability=0.1)
        assert 'in the window' in robot.refuses(Relocalize, 'relocalize')
        assert robot.transition('deactivate')
        assert robot.transition('cleanup')


def test_load_map_that_takes_too_long_fails(robot, start, tmp_path, disk, monkeypatch):
    start(map_path='')
    disk.clear()
    monkeypatch.setattr(map_loading, 'LOAD_TIMEOUT', 0.1)
    message = robot.refuses(LoadMap, 'load_map', path=str(tmp_path / 'slow.stavpr'))
    disk.set()
    assert message == f'{tmp_path}/slow.stavpr was not read within 0.1 s: copy it to a faster disk'


def test_services_and_parameters_name_files_in_the_maps_folder_only(
    robot, start, map_file, tmp_path
):
    """Responses have the absolute path; files of the start are free."""
    folder, secret = tmp_path / 'maps', tmp_path / '.bashrc'
    folder.mkdir()
    secret.write_text('export PATH\n')
    (folder / 'link').symlink_to(secret)
    (folder / 'outside').symlink_to(tmp_path)
    start(maps_folder=str(folder))
    own = str(folder / 'own.stavpr')
    assert robot.does(SaveMap, 'save_map', path='own.stavpr').message == f'60 places to {own}'
    loaded = robot.does(LoadMap, 'load_map', path='own.stavpr')
    assert (loaded.message, loaded.map.path) == (f'60 places from {own}', own)
    assert robot.does(LoadMap, 'load_map', path=own).success
    for path in (map_file, str(secret), '../.bashrc', 'link', 'outside/.bashrc', '.'):
        for kind, name, fields in (
            (LoadMap, 'load_map', {}),
            (SaveMap, 'save_map', {'overwrite': True}),
        ):
            message = robot.refuses(kind, name, path=path, **fields)
            assert f'{path!r} is no file in the maps folder {folder}' in message
        with pytest.raises(AssertionError, match=r'save_path: .* is no file in the maps folder'):
            robot.set(save_path=path)
    (folder / '.bashrc').write_text('export PATH\n')
    message = robot.refuses(SaveMap, 'save_map', path='.bashrc', overwrite=True)
    assert 'exists and is no map: it is never replaced' in message
    for file in (secret, folder / '.bashrc'):
        assert file.read_text() == 'export PATH\n'
    robot.set(save_path='late.stavpr')
    values = robot.call(GetParameters, 'get_parameters', names=['save_path']).values
    assert values[0].string_value == str(folder / 'late.stavpr')
    robot.set(save_path=str(folder / 'late.stavpr'))
    robot.set(save_path='')


def test_services_without_a_map_return_the_reason(robot, start, route, map_file, tmp_path):
    """Images too, until a map is loaded."""
    start(map_path='', robot_id='r1')
    info = robot.until_map(state='none')
    assert (info.operation, info.path, info.places) == ('localization', '', 0)
    assert 'no map' in robot.drive(route[:1])[0].reason
    for kind, name, fields, words in (
        (Relocalize, 'relocalize', {}, 'no map'),
        (SaveMap, 'save_map', {'path': str(tmp_path / 'nothing.stavpr')}, 'no map'),
        (SaveMap, 'save_map', {}, 'set a path'),
        (LoadMap, 'load_map', {}, 'is no file'),
        (LoadMap, 'load_map', {'path': 'missing.stavpr'}, 'does not exist'),
        (SetOperation, 'set_operation', {'operation': 'teleport'}, 'teleport'),
    ):
        assert words in robot.refuses(kind, name, **fields)
        robot.until_logged(f'{name} failed: ')
    match = robot.call(Relocalize, 'relocalize').match
    assert (match.status, match.place_index, match.robot_id) == (PlaceMatch.NOT_READY, -1, 'r1')
    logged = [line for line in robot.log if 'relocalize failed' in line]
    assert len(logged) == 1, logged
    assert robot.does(Trigger, 'reset').message
    assert list(tmp_path.iterdir()) == []
    assert robot.does(LoadMap, 'load_map', path=map_file).map.places == 60
    assert robot.drive(route[:LENGTH])[-1].newest_index == LENGTH - 1


def test_images_while_the_first_map_is_loaded_are_not_ready(robot, start, route, tmp_path, disk):
    start(map_path='')
    with while_loading(robot, tmp_path / 'slow.stavpr', disk) as slow:
        matches = robot.drive(route[:5])
        assert {match.status for match in matches} == {PlaceMatch.NOT_READY}
        assert {match.reason for match in matches} == {f'map {slow} is being loaded'}
        robot.until_diagnosed('map', DiagnosticStatus.OK, 'loading')
    robot.until_map(state='none')
    robot.until_diagnosed('map', DiagnosticStatus.ERROR, 'cannot load')
    assert 'no map' in robot.drive(route[:1])[0].reason


def test_node_that_maps_with_odometry_saves_and_publishes_poses(robot, start, route, tmp_path):
    """From nothing; its places are recognized at once."""
    start(map_path='')
    path = tmp_path / 'recorded.stavpr'
    robot.does(SetOperation, 'set_operation', operation='mapping')
    robot.set(keyframe_distance=0.5)
    assert 'recognizes no places' in robot.refuses(Relocalize, 'relocalize')
    assert 'no places' in robot.refuses(SaveMap, 'save_map', path=str(path))
    matches = [robot.show_at(x, image) for x, image in enumerate(route[:40])]
    assert {match.status for match in matches} == {PlaceMatch.MAPPED}
    assert [match.newest_index for match in matches] == list(range(40))
    robot.until_map(state='growing', places=40, has_poses=True)
    assert robot.does(SaveMap, 'save_map', path=str(path)).places == 40
    assert 'exists already' in robot.refuses(SaveMap, 'save_map', path=str(path))
    assert robot.does(SaveMap, 'save_map', overwrite=True).places == 40  # to its own file
    assert robot.until_map(path=str(path)).places == 40
    saved = load_map(path)
    np.testing.assert_allclose(saved.poses, [[x, 0, 0, 0, 0, 0, 1] for x in range(40)], atol=1e-9)
    first = matches[0].header.stamp.sec
    assert [stamp // SECOND for stamp in saved.stamps] == [first + x for x in range(40)]

    poses = robot.listen(PoseWithCovarianceStamped, '/stavpr/pose')
    robot.set(keyframe_distance=0.0)
    robot.does(SetOperation, 'set_operation', operation='localization')
    robot.until_map(state='loaded', path=str(path), operation='localization')
    robot.until(lambda: robot.node.count_publishers('/stavpr/pose') == 1, 'the poses')
    matches = [match for match in robot.drive(route[10:20]) if match.newest_index >= 0]
    newest = [match.newest_index for match in matches]
    assert newest == list(range(newest[0], 20))
    assert newest[0] <= 14
    robot.until(lambda: len(poses) == len(matches), 'a pose for each match')
    assert {pose.header.frame_id for pose in poses} == {'map'}
    assert [pose.pose.pose.position.x for pose in poses] == newest


def test_load_map_during_a_stream_processes_every_image(
    robot, start, small_map, route, tmp_path, disk
):
    """At 20 Hz: matches with the old map, a window that fills, matches with the new map."""
    save_map(replace(small_map, ids=('new',) * 60), tmp_path / 'new.stavpr')
    start(queue_size=1000, **PAPER)
    robot.drive(route[20:28])
    before, sent = len(robot.answers), []
    disk.clear()

    def publish():
        stamp = robot.stamp + (1 + len(sent)) * SECOND
        sent.append(image_message(route[28 + len(sent) % 30], stamp))
        robot.publisher.publish(sent[-1])
        if len(sent) == 8:
            disk.set()

    timer = robot.node.create_timer(0.05, publish)
    robot.does(LoadMap, 'load_map', path=str(tmp_path / 'new.stavpr'))
    during = len(sent)
    robot.until(lambda: len(sent) >= during + 2 * LENGTH, 'more of the stream')
    robot.node.destroy_timer(timer)
    robot.until(lambda: len(robot.answers) >= before + len(sent), 'all matches')
    matches = robot.answers[before:]
    assert [match.header for match in matches] == [image.header for image in sent]
    warming = [i for i, match in enumerate(matches) if match.status == PlaceMatch.WARMING_UP]
    assert warming == list(range(warming[0], warming[0] + LENGTH - 1))
    for part, word in ((matches[: warming[0]], 'place'), (matches[warming[-1] + 1 :], 'new')):
        accepted = [match for match in part if match.status == PlaceMatch.MATCH]
        assert {match.newest_id.split()[0] for match in accepted} == {word}


def test_load_map_of_a_damaged_file_keeps_the_map_and_the_window(
    robot, start, route, tmp_path, disk
):
    start()
    matches = robot.drive(route[:6])
    with while_loading(robot, tmp_path / 'slow.stavpr', disk):
        matches += robot.drive(route[6:14])
    damaged = tmp_path / 'damaged.stavpr'
    damaged.write_bytes(b'PK' + bytes(1000))
    assert 'damaged.stavpr' in robot.refuses(LoadMap, 'load_map', path=str(damaged))
    matches += robot.drive(route[14:15])
    assert [match.newest_index for match in matches[4:]] == list(range(4, 15))
    robot.does(Trigger, 'reset')
    assert robot.drive(route[:1])[0].status == PlaceMatch.WARMING_UP


def test_relocalize_returns_the_last_match_with_candidates_and_pose(robot, start, route):
    """As many as requested, or as parameter candidates; the pose is that of ~/pose."""
    poses = robot.listen(PoseWithCovarianceStamped, '/stavpr/pose')
    start(candidates=3, **PAPER)
    match = robot.drive(route[30 : 30 + LENGTH])[-1]
    invalid = image_message(route[0])
    invalid.encoding = 'none'
    robot.show(invalid)  # is in no window
    for count, expected in ((0, 3), (6, 6)):
        response = robot.does(Relocalize, 'relocalize', count=count)
        assert str(response.match) == str(match)  # NaN equals NaN
        assert len(response.candidates) == expected
        assert response.candidates[0].place_index == match.place_index
        robot.until(lambda: bool(poses), 'a pose')
        assert (response.has_pose, response.pose) == (True, poses[-1])
        assert response.pose.pose.pose.position.x == match.newest_index
    noise = np.random.default_rng(1).integers(0, 256, (96, 128, 3), np.uint8)
    strange = robot.drive([noise] * LENGTH)[-1]
    assert strange.status == PlaceMatch.NO_MATCH
    response = robot.does(Relocalize, 'relocalize')  # though there is no match
    assert (str(response.match), response.message) == (str(strange), strange.reason)
    assert (response.has_pose, response.pose) == (False, PoseWithCovarianceStamped())


STATES = ('unconfigured', 'inactive', 'active')


@pytest.fixture
def node(start):
    """Start a node that is not configured and has no map."""
    return start(wait=False, autostart=False, map_path='', mode='paper', threshold=0.2)


def configure(robot, path, *, activate=False):
    robot.set(map_path=path)
    assert robot.transition('configure')
    if activate:
        assert robot.transition('activate')
        robot.wait_for_node()


def rejections(robot):
    """Return the message of each service; all must fail."""
    requests = {
        'reset': (Trigger, {}),
        'load_map': (LoadMap, {'path': 'any.stavpr'}),
        'save_map': (SaveMap, {'path': 'any.stavpr'}),
        'relocalize': (Relocalize, {}),
        'set_operation': (SetOperation, {'operation': 'mapping'}),
    }
    return [robot.refuses(kind, name, **fields) for name, (kind, fields) in requests.items()]


def test_node_through_all_states_behaves_as_each_state(robot, node, map_file, route):
    warming = [PlaceMatch.WARMING_UP] * (LENGTH - 1)
    assert robot.state() == 'unconfigured'
    assert all('is unconfigured: configure it first' in message for message in rejections(robot))
    assert robot.until_diagnosed(
        'processing', DiagnosticStatus.OK, 'unconfigured: no image is processed'
    )

    configure(robot, map_file)
    assert robot.state() == 'inactive'
    robot.until_map(state='loaded', places=60, path=map_file)
    infos = robot.listen(MapInfo, '/stavpr/map_info', LATCHED)
    robot.until(lambda: bool(infos), 'the map, for a late subscriber')
    assert robot.publisher.get_subscription_count() == 0
    assert 'in the window' in robot.refuses(Relocalize, 'relocalize')
    robot.until_diagnosed('processing', DiagnosticStatus.OK, 'inactive: no image is processed')

    received = []
    for first in (10, 20):  # both times with an empty window, counts go on
        assert robot.transition('activate')
        assert robot.state() == 'active'
        robot.wait_for_node()
        assert robot.statuses(route[first : first + LENGTH - 1]) == warming
        match = robot.show(route[first + LENGTH - 1])
        assert (match.status, match.newest_index) == (PlaceMatch.MATCH, first + LENGTH - 1)
        robot.until_diagnosed('processing', DiagnosticStatus.OK, 'ms an image')
        received.append(int(robot.counts('input')['received']))

        assert robot.transition('deactivate')
        assert robot.state() == 'inactive'
        robot.wait_for_nobody()
        before = len(robot.answers)
        robot.publisher.publish(image_message(route[0], 50))
        assert robot.does(Relocalize, 'relocalize')  # the window is kept
        assert len(robot.answers) == before

    assert received[1] >= received[0] + LENGTH
    assert robot.transition('cleanup')
    assert robot.state() == 'unconfigured'
    robot.until_map(state='none', places=0)
    assert all('is unconfigured' in message for message in rejections(robot))
    robot.until(lambda: infos[-1].state == 'none', 'the end of the map')
    assert [info.state for info in infos] == ['loaded', 'none']


def test_node_at_invalid_transitions_rejects_them(robot, node, map_file):
    steps = (None, 'configure', 'activate')
    invalid = (
        ('activate', 'deactivate', 'cleanup', 'teleport'),
        ('configure', 'deactivate', 'teleport'),
        ('configure', 'activate', 'cleanup', 'teleport'),
    )
    robot.set(map_path=map_file)
    for step, labels, state in zip(steps, invalid, STATES, strict=True):
        assert step is None or robot.transition(step)
        for label in labels:
            assert not robot.transition(label), (state, label)
            assert robot.state() == state
        for number in (0, 77, Transition.TRANSITION_ON_CONFIGURE_SUCCESS):
            assert not robot.call(
                ChangeState, 'change_state', transition=Transition(id=number)
            ).success
        assert robot.state() == state
        robot.until_logged(f'from state {state}')
    assert robot.call(
        ChangeState, 'change_state', transition=Transition(id=Transition.TRANSITION_DEACTIVATE)
    ).success


def with_missing_model(whole: Map) -> Map:
    """Return a map whose network has no file."""
    network = settings_class('onnx')(model='', layer='y', sha256='0' * 64)
    settings = dataclasses.replace(whole.settings, kind='onnx', backbone=network)
    return dataclasses.replace(
        whole, features=dataclasses.replace(whole.features, settings=settings)
    )


@pytest.mark.parametrize('fault', ['missing', 'model'])
def test_node_after_a_failed_configuration_can_be_configured(
    robot, node, map_file, small_map, route, tmp_path, fault
):
    path = tmp_path / f'{fault}.stavpr'
    words = {
        'missing': 'does not exist',
        'model': 'copy the file that the map was built with there',
    }[fault]
    if fault == 'model':
        save_map(with_missing_model(small_map), path)
    robot.set(map_path=str(path))
    assert not robot.transition('configure')
    assert robot.state() == 'unconfigured'
    robot.until_logged(words)
    assert (
        'cannot configure' in robot.until_diagnosed('map', DiagnosticStatus.ERROR, words).message
    )
    assert all('cannot configure' in message and words in message for message in rejections(robot))
    assert not robot.transition('activate')
    configure(robot, map_file, activate=True)
    assert robot.statuses(route[:LENGTH])[-1] == PlaceMatch.MATCH
    robot.until_diagnosed('map', DiagnosticStatus.OK, '60 places of')


def test_node_without_its_map_frees_it(robot, node, map_file, monkeypatch):
    """By cleanup, and by another map, even if its hashes are compared for hours."""
    monkeypatch.setattr(map_loading, 'REST', 1e9)
    configure(robot, map_file)
    places = weakref.ref(node.runtime.pipeline.places)
    assert robot.transition('cleanup')
    robot.until(lambda: places() is None, 'the end of the map')
    assert robot.transition('configure')
    places = weakref.ref(node.runtime.pipeline.places)
    robot.does(LoadMap, 'load_map', path=map_file)
    robot.until(lambda: places() is None, 'the end of the old map')
