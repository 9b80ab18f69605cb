# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The life cycle of the node from outside: states, transitions, and requests at any time."""

import dataclasses
import weakref

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import pytest
from robot import image_message, LATCHED, LENGTH
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_msgs.srv import LoadMap, Relocalize, SaveMap, SetOperation
from stavpr_ros.features.registry import settings_class
from stavpr_ros.mapping import PlaceMap, save_map
from stavpr_ros.ros import map_loading
from std_srvs.srv import Trigger

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


def with_missing_model(whole: PlaceMap) -> PlaceMap:
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


def test_map_info_reaches_a_late_subscriber_once(robot, node, map_file):
    configure(robot, map_file)
    infos = robot.listen(MapInfo, '/stavpr/map_info', LATCHED)
    robot.until(lambda: bool(infos), 'the latched map')
    robot.counts('map')  # which are made with the map_info
    assert [(info.state, info.places) for info in infos] == [('loaded', 60)]
