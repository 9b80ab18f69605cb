# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Services, states, maps and parameters of the node: valid and invalid requests at any time."""

from contextlib import contextmanager
import dataclasses
from dataclasses import replace
import math
from pathlib import Path
import shutil
import threading
import weakref

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from hypothesis import given, HealthCheck, settings, strategies
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.lifecycle import TransitionCallbackReturn
from robot import image_message, LATCHED, LENGTH, parameters_of, SECOND
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.errors import MapFileError, SettingsError
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import load_map, Map, open_map, save_map, verify_map
from stavpr_ros.parameters import BY_NAME, PARAMETERS, REMOVED
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


def test_load_map_that_takes_too_long_fails(robot, start, tmp_path, disk, set_constants):
    start(map_path='')
    disk.clear()
    set_constants(map_loading, LOAD_TIMEOUT=0.1)
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
    (folder / 'zero').symlink_to('/dev/zero')
    start(maps_folder=str(folder))
    own = str(folder / 'own.stavpr')
    assert robot.does(SaveMap, 'save_map', path='own.stavpr').message == f'60 places to {own}'
    loaded = robot.does(LoadMap, 'load_map', path='own.stavpr')
    assert (loaded.message, loaded.map.path) == (f'60 places from {own}', own)
    assert robot.does(LoadMap, 'load_map', path=own).success
    for path in (map_file, str(secret), '../.bashrc', 'link', 'zero', 'outside/.bashrc', '.'):
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
    """As many as requested, or as parameter candidates; the pose is published on ~/pose."""
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


def test_node_without_its_map_frees_it(robot, node, map_file, set_constants):
    """By cleanup, and by another map, even if its hashes are compared for hours."""
    set_constants(map_loading, REST=1e9)
    configure(robot, map_file)
    places = weakref.ref(node.runtime.pipeline.places)
    assert robot.transition('cleanup')
    robot.until(lambda: places() is None, 'the end of the map')
    assert robot.transition('configure')
    places = weakref.ref(node.runtime.pipeline.places)
    robot.does(LoadMap, 'load_map', path=map_file)
    robot.until(lambda: places() is None, 'the end of the old map')


# Files of maps that are overwritten, or damaged, while the node uses them


@pytest.fixture
def other_map(small_map, tmp_path):
    """Return the file of a shorter map."""
    places = slice(40)
    other = small_map.__class__(
        small_map.features[places], small_map.projection, small_map.stamps[places], ('',) * 40
    )
    save_map(other, tmp_path / 'other.stavpr')
    return tmp_path / 'other.stavpr'


@pytest.fixture
def in_use(map_file, tmp_path):
    """Return a map file that may be changed."""
    return Path(shutil.copy(map_file, tmp_path / 'route.stavpr'))


def copied_over(other: Path, path: Path) -> None:
    """Write a file over another, as ``cp`` does: it stays the same file."""
    inode = path.stat().st_ino
    path.write_bytes(other.read_bytes())
    assert path.stat().st_ino == inode


def test_map_copied_over_the_one_in_use_is_reported_and_can_be_loaded(
    robot, start, route, in_use, other_map
):
    """Images are matched with the map in memory; nothing takes the file for its own."""
    start(map_path=str(in_use), geometric_check='orb')
    robot.drive(route[:6])
    copied_over(other_map, in_use)
    matches = robot.drive(route[6:12])
    assert [match.newest_index for match in matches] == list(range(6, 12))
    robot.until_diagnosed('map', DiagnosticStatus.WARN, 'has been overwritten since')
    message = robot.refuses(SetOperation, 'set_operation', operation='mapping')
    assert 'has been overwritten since' in message
    assert robot.refuses(SaveMap, 'save_map', path=str(in_use.parent / 'copy')) == message
    for path, places in ((other_map, 40), (in_use, 40)):
        assert robot.does(LoadMap, 'load_map', path=str(path)).map.places == places
    robot.until_diagnosed('map', DiagnosticStatus.WARN, 'geometric_check requires thumbnails')
    assert robot.drive(route[:LENGTH])[-1].status == PlaceMatch.MATCH


def test_load_map_of_damaged_strips_is_reported_later_or_refused_with_verify(
    robot, start, route, in_use, tmp_path
):
    """A flipped bit in the features: the header, and all that is read at once, are intact."""
    part = open_map(in_use).features.file.parts['strips']
    content = bytearray(in_use.read_bytes())
    content[part.start + 100] ^= 1
    damaged = tmp_path / 'damaged.stavpr'
    damaged.write_bytes(content)
    start(map_path=str(in_use))
    message = robot.refuses(LoadMap, 'load_map', path=str(damaged), verify=True)
    assert f'bytes {part.start} to' in message
    assert 'of part strips, do not match their hash' in message
    assert robot.until_map(state='loaded').path == str(in_use)
    robot.does(LoadMap, 'load_map', path=str(in_use), verify=True)
    robot.does(LoadMap, 'load_map', path=str(damaged))
    robot.until_diagnosed('map', DiagnosticStatus.WARN, 'the map in use is not reliable')
    robot.until_logged('the map in use is not reliable')
    assert robot.drive(route[:LENGTH])[-1].status == PlaceMatch.MATCH
    robot.does(LoadMap, 'load_map', path=str(in_use))
    robot.until_diagnosed('map', DiagnosticStatus.OK, '60 places')


def test_stored_map_that_is_overwritten_is_never_read_as_its_own(in_use, small_map, tmp_path):
    """By a map of the same size, whose features are valid: no hash is compared on use."""
    places = open_map(in_use)
    copied_over(in_use, in_use)  # the content is the same; that is not known
    for read in (
        lambda: places.features[:3],
        lambda: places.features.strip(0),
        lambda: places.thumbnails[0],
        lambda: save_map(places, tmp_path / 'copy.stavpr'),
        lambda: verify_map(places),
    ):
        with pytest.raises(MapFileError, match='has been overwritten since it was opened: load'):
            read()
    assert places.thumbnail(0) is None


# Parameters of any name, type and value: each is set, or rejected with a reason

NESTED = '[' * 2000
TEXTS = strategies.text(strategies.characters(exclude_characters='\0', codec='utf-8'), max_size=40)
VALUES = strategies.builds(
    ParameterValue,
    type=strategies.sampled_from([*range(10), 77, 255]),
    bool_value=strategies.booleans(),
    integer_value=strategies.integers(-(2**63), 2**63 - 1),
    double_value=strategies.floats(),
    string_value=strategies.sampled_from(['', NESTED, '{"a":' * 2000, '{}', '/dev/zero', '..'])
    | TEXTS,
    string_array_value=strategies.lists(TEXTS, max_size=3),
)
NAMES = strategies.sampled_from([row.name for row in PARAMETERS] + ['', 'use_sim_time', '/', 'é'])


def service_of(node, kind):
    return next(service for service in node.services if service.srv_type is kind)


def test_parameters_that_rclpy_cannot_read_get_a_response(robot, start):
    """Over ROS: an unknown type; those before it are set, those after it are not."""
    node = start(map_path='')
    right = Parameter(name='min_probability', value=ParameterValue(type=3, double_value=0.25))
    strange = Parameter(name='candidates', value=ParameterValue(type=77))
    later = Parameter(name='candidates', value=ParameterValue(type=2, integer_value=3))
    parameters = [right, strange, later]
    results = robot.call(SetParameters, 'set_parameters', parameters=parameters).results
    assert [result.successful for result in results] == [True, False, False]
    assert '77 is not a valid' in results[1].reason
    atomic = 'set_parameters_atomically'
    result = robot.call(SetParametersAtomically, atomic, parameters=parameters).result
    assert not result.successful
    assert '77 is not a valid' in result.reason
    values = [node.get_parameter(name).value for name in ('min_probability', 'candidates')]
    assert values == [0.25, 10]


# at the start, and of a node that localizes
WRONG_TYPES = [
    ('threshold', 'high', 'has the wrong type: expected a number'),
    ('queue_size', 4.5, 'has the wrong type: expected an integer'),
    ('publish_tf', 1, 'has the wrong type: expected true or false'),
    ('robot_id', 2, 'has the wrong type: expected text'),
]
NOT_DECLARED = {
    'sequence_lenght': 'is unknown: did you mean sequence_length?',
    'beta': 'is unknown: see `ros2 param list`',
} | {name: f'was removed in 1.0: {remedy}' for name, remedy in REMOVED.items()}
REJECTED = [
    *WRONG_TYPES,
    *((name, 'package.module:name', words) for name, words in NOT_DECLARED.items()),
    ('map_path', 'other.stavpr', 'call the service ~/load_map'),
    ('operation', 'mapping', 'call the service ~/set_operation'),
    ('nms_radius', 7, 'while the node is unconfigured'),
    ('threshold', 0.8, 'applies to mode paper'),
    ('min_probability', 1.0, 'below 1'),
    ('save_path', '/missing/route.stavpr', 'save_path'),
    ('geometric_check', 'eye', 'take one of none'),
    ('save_path', 'a' * 20_000, 'expected at most 4096, none of them a control'),
    ('save_path', '\x1b[2J', 'none of them a control'),
    ('robot_id', 'a\nb', 'none of them a control'),
]


def test_parameters_that_are_rejected_by_name_change_nothing(make_node, map_file):
    node = make_node(map_path=map_file)
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    before = node.settings
    for name, value, words in REJECTED:
        (result,) = node.set_parameters(parameters_of({name: value}))
        assert (result.successful, words in result.reason) == (False, True), result.reason
        assert name in result.reason
        assert len(result.reason) < 1000
        assert not node.has_parameter(name) or node.get_parameter(name).value != value
        assert node.settings is before
    together = parameters_of({'candidates': 3, 'min_probability': 1.0})
    assert not node.set_parameters_atomically(together).successful
    assert node.settings.pipeline.candidates == 10
    for values in ({'map_path': map_file}, {'candidates': 3}):  # the first one is the current one
        assert node.set_parameters(parameters_of(values))[0].successful
    assert node.runtime.pipeline.settings.candidates == 3


def test_parameters_of_the_start_are_rejected_or_logged_by_name(make_node, capfd):
    for name, value, words in WRONG_TYPES:
        with pytest.raises(SettingsError, match=f'{name} = {value!r} {words}'):
            make_node(**{name: value})
    node = make_node(**dict.fromkeys(NOT_DECLARED, 'package.module:name'))
    (result,) = node.set_parameters(parameters_of({'feature_settings': NESTED}))
    assert 'expected a JSON object' in result.reason
    assert len(result.reason) < 1000
    logged = capfd.readouterr().err
    assert all(f'parameter {name!r} {words}' in logged for name, words in NOT_DECLARED.items())


def test_integer_where_a_number_is_expected_is_converted(make_node):
    """As in `threshold: 1` of a parameter file, and in `ros2 param set NODE threshold 1`."""
    node = make_node(mode='paper', threshold=1)
    assert repr(node.settings.pipeline.threshold) == '1.0'
    assert node.set_parameters(parameters_of({'threshold': 2}))[0].successful
    assert repr(node.get_parameter('threshold').value) == '2.0'


def test_any_parameter_is_set_or_rejected_with_a_reason(make_node):
    node = make_node(map_path='')

    @settings(max_examples=300, suppress_health_check=list(HealthCheck))
    @given(strategies.lists(strategies.tuples(NAMES, VALUES), min_size=1, max_size=3))
    def check(pairs):
        parameters = [Parameter(name=name, value=value) for name, value in pairs]
        for kind in (SetParameters, SetParametersAtomically):
            request, response = kind.Request(parameters=parameters), kind.Response()
            service_of(node, kind).callback(request, response)
            results = response.results if kind is SetParameters else [response.result]
            assert len(results) == (len(pairs) if kind is SetParameters else 1)
            assert all(result.successful or result.reason for result in results)
        for name, row in BY_NAME.items():
            value = node.get_parameter(name).value
            assert type(value) is type(row.default)
            assert not (isinstance(value, float) and math.isnan(value))

    check()


def test_parameter_by_its_earlier_name_is_set_with_a_warning(make_node, capfd):
    node = make_node(keyframe_angle=5.0)
    assert node.get_parameter('keyframe_angle_deg').value == 5
    assert "parameter 'keyframe_angle' is keyframe_angle_deg now" in capfd.readouterr().err
    assert node.set_parameters(parameters_of({'keyframe_angle': 7}))[0].successful
    assert node.settings.pipeline.keyframes.angle == 7
    assert "parameter 'keyframe_angle' is keyframe_angle_deg now" in capfd.readouterr().err
    assert not node.has_parameter('keyframe_angle')
