# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes: signals in every state, options of ROS, a program, hostile files."""

from functools import partial
import hashlib
import os
from pathlib import Path
import pickle
import re
import shutil
import signal
import subprocess
import sys

from diagnostic_msgs.msg import DiagnosticStatus
from map_files import alter, network
import numpy as np
from processes import environment, node_process, Process, TIMEOUT
import pytest
from robot import image_message, PARAMETERS, RELIABLE, SECOND
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch
from stavpr_msgs.srv import LoadMap


@pytest.fixture
def run(robot, tmp_path, tmp_path_factory, request):
    """Start a node; it is ended with the test."""

    def run(options=(), **parameters):
        values = PARAMETERS | {'maps_folder': tmp_path_factory.getbasetemp()} | parameters
        process = node_process(tmp_path / 'node.log', *options, **values)
        request.addfinalizer(process.end)
        return process

    yield run
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


# The nodes of the program in docs/integration.md, from outside

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'integration.md'
CAMERAS = 'front', 'rear'


@pytest.fixture
def program(map_file, tmp_path):
    """Run the documented program in a folder with a map for each camera."""
    blocks = re.findall(r'^```python\n(.*?)^```', PAGE.read_text(), re.M | re.S)
    (source,) = (block for block in blocks if 'front' in block)
    (tmp_path / 'program.py').write_text(source)
    for camera in CAMERAS:
        shutil.copy(map_file, tmp_path / f'{camera}.stavpr')
    with (tmp_path / 'log').open('w') as log:
        command, output = [sys.executable, 'program.py'], {'stdout': log, 'stderr': log}
        process = subprocess.Popen(command, cwd=tmp_path, env=environment(), **output)
    yield process
    process.kill()
    process.wait()
    text = (tmp_path / 'log').read_text()
    print(text)
    assert 'Traceback' not in text


def have(matches, header):
    return all(received[-1].header == header for received in matches)


def test_documented_program_recognizes_with_two_cameras_and_ends(robot, program, route):
    """Images of both at the same time; each is matched on the map of its camera."""
    matches = {c: robot.listen(PlaceMatch, f'/{c}/stavpr/match', RELIABLE) for c in CAMERAS}
    publishers = {c: robot.node.create_publisher(Image, f'/{c}/image', RELIABLE) for c in CAMERAS}

    def is_discovered():  # an empty image or its match may be lost before
        for camera in CAMERAS:
            if not matches[camera]:
                publishers[camera].publish(Image())
        return all(matches.values())

    robot.until(is_discovered, 'both nodes')
    for number, image in enumerate(route, 1):
        message = image_message(image, robot.stamp + number * SECOND)
        for publisher in publishers.values():
            publisher.publish(message)
        robot.until(partial(have, matches.values(), message.header), f'matches of image {number}')
    for camera in CAMERAS:
        last = [match for match in matches[camera] if match.status == PlaceMatch.MATCH][-1]
        assert abs(last.newest_index - 59) <= 1, camera
    program.send_signal(signal.SIGINT)
    assert program.wait(TIMEOUT) == 0


# Files and names that are to harm a running node: each is refused, and it goes on


def resident(process: Process) -> int:
    """Return the resident memory of a process in MB."""
    lines = Path(f'/proc/{process.popen.pid}/status').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('VmRSS')) // 1024


def test_running_node_refuses_hostile_files_and_goes_on(run, robot, route, map_file, tmp_path):
    """A pipe, a file of holes, a program: over ROS, one by one."""
    maps, models = tmp_path / 'maps', tmp_path / 'models'
    maps.mkdir()
    models.mkdir()
    content = Path(map_file).read_bytes()
    shutil.copy(map_file, maps / 'good')
    os.mkfifo(maps / 'pipe')
    with (maps / 'sparse').open('wb') as file:
        file.write(content[:8000])
        file.truncate(8 * 2**30)
    program = models / 'network.pth'
    program.write_bytes(pickle.dumps(print))
    sha256 = hashlib.sha256(program.read_bytes()).hexdigest()
    (maps / 'program').write_bytes(alter(content, network(sha256=sha256)))
    located = network(sha256=sha256, model=str(program))
    (maps / 'located').write_bytes(alter(content, located))
    node = run(maps_folder=maps, map_path=maps / 'good', model_path=models)
    robot.wait_for_node()
    robot.drive(route[:6])
    before = resident(node)
    for name, words in (
        ('pipe', 'it is a pipe, expected a regular file'),
        ('sparse', 'a sparse file'),
        ('program', 'is no usable ONNX model'),
        ('located', "unknown 'model'"),
    ):
        assert words in robot.refuses(LoadMap, 'load_map', path=name), name
    assert resident(node) < before + 100
    assert robot.does(LoadMap, 'load_map', path='good').success
    assert len(robot.drive(route[:3])) == 3
    assert node.stop() == 0
