# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files and names that are to harm a running node: each is refused, and it goes on."""

import hashlib
import os
from pathlib import Path
import pickle
import shutil

from map_files import changed, network
from processes import node_process, Process
import pytest
from robot import PARAMETERS
from stavpr_msgs.srv import LoadMap, SaveMap


@pytest.fixture
def nodes(robot, tmp_path):
    """Start nodes as processes of their own; they end with the test."""
    started = []

    def start(*options, **parameters) -> Process:
        log = tmp_path / f'log{len(started)}'
        started.append(node_process(log, *options, **(PARAMETERS | parameters)))
        robot.until(lambda: 'backend' in started[-1].output(), 'the node')
        return started[-1]

    yield start
    for process in started:
        process.end()


def resident(process: Process) -> int:
    """Return the resident memory of a process in MB."""
    lines = Path(f'/proc/{process.popen.pid}/status').read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith('VmRSS')) // 1024


def test_running_node_refuses_hostile_files_and_goes_on(nodes, robot, route, map_file, tmp_path):
    """A pipe, a device, a file of holes, a program, names outside: over ROS, one by one."""
    maps, models = tmp_path / 'maps', tmp_path / 'models'
    maps.mkdir()
    models.mkdir()
    content, secret = Path(map_file).read_bytes(), tmp_path / '.bashrc'
    secret.write_text('export PATH\n')
    shutil.copy(map_file, maps / 'good')
    os.mkfifo(maps / 'pipe')
    (maps / 'zero').symlink_to('/dev/zero')
    with (maps / 'sparse').open('wb') as file:
        file.write(content[:8000])
        file.truncate(8 * 2**30)
    program = models / 'network.pth'
    program.write_bytes(pickle.dumps(print))
    sha256 = hashlib.sha256(program.read_bytes()).hexdigest()
    (maps / 'program').write_bytes(changed(content, network(sha256=sha256)))
    located = network(sha256=sha256, model=str(program))
    (maps / 'located').write_bytes(changed(content, located))
    node = nodes(maps_folder=maps, map_path=maps / 'good', model_path=models)
    robot.wait_for_node()
    robot.drive(route[:6])
    before = resident(node)
    for name, words in (
        ('pipe', 'it is a pipe, expected a regular file'),
        ('zero', 'is no file in the maps folder'),
        ('sparse', 'a sparse file'),
        ('program', 'is no usable ONNX model'),
        ('located', "unknown 'model'"),
        ('../.bashrc', 'is no file in the maps folder'),
    ):
        assert words in robot.refuses(LoadMap, 'load_map', path=name), name
    for name in ('../.bashrc', str(secret), '/etc/stavpr_test', 'zero'):
        message = robot.refuses(SaveMap, 'save_map', path=name, overwrite=True)
        assert 'is no file in the maps folder' in message
    assert secret.read_text() == 'export PATH\n'
    assert resident(node) < before + 100
    assert robot.does(LoadMap, 'load_map', path='good').success
    assert len(robot.drive(route[:3])) == 3
    assert node.stop() == 0
