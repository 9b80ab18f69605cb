# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node as a process: signals in every state, options of ROS."""

import shutil
import signal

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
from processes import node_process
import pytest
from robot import image_message, PARAMETERS
from stavpr_msgs.msg import PlaceMatch
from stavpr_msgs.srv import LoadMap


@pytest.fixture
def run(robot, tmp_path, tmp_path_factory):
    """Start a node; it is ended with the test."""
    started = []

    def run(options=(), **parameters):
        values = PARAMETERS | {'maps_folder': tmp_path_factory.getbasetemp()} | parameters
        started.append(node_process(tmp_path / 'node.log', *options, **values))
        return started[0]

    yield run
    started[0].end()
    robot.wait_for_nobody()


def ends_well(process, number):
    """Send a signal; the process must end, and without errors."""
    assert process.stop(number) == 0
    output = process.output()
    assert 'images received' in output
    for word in ('Traceback', 'Exception', 'exception', 'ERROR', 'terminate'):
        assert word not in output, output
    return True


@pytest.mark.parametrize(
    ('labels', 'number'),
    [
        pytest.param(['configure'], signal.SIGINT, marks=pytest.mark.long),
        pytest.param([], signal.SIGINT, marks=pytest.mark.long),
        (['configure', 'activate', 'shutdown'], signal.SIGTERM),
    ],
)
def test_node_after_a_signal_in_any_state_ends(robot, run, map_file, labels, number):
    process = run(autostart=False, map_path=map_file)
    states = {'configure': 'inactive', 'activate': 'active', 'shutdown': 'finalized'}
    robot.until_state('unconfigured')
    for label in labels:
        assert robot.transition(label)
        assert robot.state() == states[label]
    if labels[-1:] == ['shutdown']:
        robot.wait_for_nobody()
        robot.until_diagnosed(
            'processing', DiagnosticStatus.OK, 'finalized: no image is processed'
        )
        response = robot.call(LoadMap, 'load_map', path=map_file)
        assert (response.success, 'the node is finalized' in response.message) == (False, True)
        assert process.popen.poll() is None
    assert ends_well(process, number)


def test_node_after_two_signals_during_an_image_ends(robot, run, map_file, route):
    """`ros2 launch` sends a second interrupt."""
    process = run(map_path=map_file, queue_size=1000)
    robot.wait_for_node()
    before, images = len(robot.answers), 400
    for i in range(images):
        robot.publisher.publish(image_message(route[i % 60], 7000 + i))
    robot.until(lambda: len(robot.answers) > before + 2, 'some matches')
    process.popen.send_signal(signal.SIGINT)
    assert ends_well(process, signal.SIGINT)
    assert len(robot.answers) < before + images  # the signal came before the last image


@pytest.mark.long
def test_node_after_a_signal_during_compilation_ends(robot, run, map_file, tmp_path, monkeypatch):
    """Compilation takes ten seconds and cannot be interrupted; the node does not wait for it."""
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'cache'))
    process = run(autostart=False, map_path=map_file)
    configure, futures = Transition(label='configure'), []

    def begun():
        return 'image distances on cpu' in process.output()

    with robot.request(futures, ChangeState, 'change_state', begun, transition=configure):
        assert not any(future.done() for future in futures)
        assert ends_well(process, signal.SIGINT)
    assert 'compil' in process.output()  # the thread was abandoned


@pytest.mark.parametrize(
    'how',
    [
        'load_map',
        pytest.param('load_map again', marks=pytest.mark.long),
        pytest.param('configure', marks=pytest.mark.long),
    ],
)
def test_node_after_a_signal_while_a_map_is_read_ends(robot, run, map_file, tmp_path, how):
    """The file is on a disk that does not respond: reading it does not end."""
    path, slow = tmp_path / 'slow.stavpr', tmp_path / 'slow.stavpr.slow'
    shutil.copy(map_file, path)
    if how == 'configure':
        slow.touch()
    process = run(slow=True, map_path=map_file if how == 'load_map' else path)
    if how != 'configure':
        robot.wait_for_node()
        slow.touch()
        futures = []

        def loading():
            return f'loading {path}' in robot.diagnostics['map'].message

        with robot.request(futures, LoadMap, 'load_map', loading, path=str(path)):
            assert not any(future.done() for future in futures)
        answer = robot.ask(image_message(np.zeros((96, 128, 3), np.uint8), 1))  # meanwhile
        assert answer.status == PlaceMatch.WARMING_UP
    else:
        robot.until_diagnosed('processing', DiagnosticStatus.OK, 'configuring')
        robot.until_diagnosed('map', DiagnosticStatus.OK, f'loading {path}')
        assert robot.state() == 'configuring'  # during the transition
        assert not robot.transition('cleanup')
        assert 'another is under way' in process.output()
    assert ends_well(process, signal.SIGINT)


def test_node_with_a_log_level_option_keeps_it(robot, run):
    process = run(('--log-level', 'error'))
    robot.wait_for_node()
    assert process.stop() == 0
    assert '[INFO]' not in process.output()
