# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The node as a process: signals in every state, options of ROS."""

from pathlib import Path
import shutil
import signal

from diagnostic_msgs.msg import DiagnosticStatus
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


def test_finalized_node_after_a_signal_ends(robot, run, map_file):
    process = run(autostart=False, map_path=map_file)
    robot.until_state('unconfigured')
    for label in ('configure', 'activate', 'shutdown'):
        assert robot.transition(label)
    assert robot.state() == 'finalized'
    robot.wait_for_nobody()
    robot.until_diagnosed('processing', DiagnosticStatus.OK, 'finalized: no image is processed')
    assert 'the node is finalized' in robot.refuses(LoadMap, 'load_map', path=map_file)
    assert process.popen.poll() is None
    assert ends_well(process, signal.SIGTERM)


def test_node_after_two_signals_during_an_image_ends(robot, run, map_file, route):
    """`ros2 launch` sends a second interrupt."""
    process = run(slow=True, map_path=map_file, queue_size=1000)
    robot.wait_for_node()
    before, images = len(robot.answers), 400
    for i in range(images):
        robot.publisher.publish(image_message(route[i % 60], 7000 + i))
    robot.until(lambda: len(robot.answers) > before + 2, 'some matches')
    process.popen.send_signal(signal.SIGINT)
    assert ends_well(process, signal.SIGINT)
    assert len(robot.answers) < before + images  # the signal came before the last image


@pytest.fixture
def slow_file(map_file, tmp_path):
    """Return a map on a disk that does not respond once a file of its name is there."""
    return Path(shutil.copy(map_file, tmp_path / 'slow.stavpr'))


def test_node_after_a_signal_while_a_map_is_read_ends(robot, run, map_file, slow_file):
    process = run(slow=True, map_path=map_file)
    robot.wait_for_node()
    Path(f'{slow_file}.slow').touch()
    futures = []

    def loading():
        return f'loading {slow_file}' in robot.diagnostics['map'].message

    with robot.request(futures, LoadMap, 'load_map', loading, path=str(slow_file)):
        assert not any(future.done() for future in futures)
    answer = robot.ask(image_message(np.zeros((96, 128, 3), np.uint8), 1))  # meanwhile
    assert answer.status == PlaceMatch.WARMING_UP
    assert ends_well(process, signal.SIGINT)


@pytest.mark.long
def test_node_after_a_signal_during_its_configuration_ends(robot, run, slow_file):
    Path(f'{slow_file}.slow').touch()
    process = run(slow=True, map_path=slow_file)
    robot.until_diagnosed('processing', DiagnosticStatus.OK, 'configuring')
    robot.until_diagnosed('map', DiagnosticStatus.OK, f'loading {slow_file}')
    assert robot.state() == 'configuring'  # during the transition
    assert not robot.transition('cleanup')
    assert 'another is under way' in process.output()
    assert ends_well(process, signal.SIGINT)


def test_node_with_a_log_level_option_keeps_it(robot, run):
    process = run(('--log-level', 'error'))
    robot.wait_for_node()
    assert process.stop() == 0
    assert '[INFO]' not in process.output()
