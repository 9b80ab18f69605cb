# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files and names that are to harm a running node: each is refused, and it goes on."""

import hashlib
import os
from pathlib import Path
import pickle
import shutil
import subprocess

from map_files import changed, network
from processes import node_process, Process, SECOND
import pytest
from robot import image_message, PARAMETERS
from stavpr_msgs.srv import LoadMap, SaveMap
from stavpr_ros.mapping import load_map
from stavpr_ros.mapping.journal import journals, recover


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


@pytest.mark.long
def test_two_nodes_with_one_save_path_that_end_together_keep_both_maps(
    nodes, robot, route, tmp_path
):
    path = tmp_path / 'route.stavpr'
    files = {'operation': 'mapping', 'save_path': path, 'maps_folder': tmp_path}
    both = [nodes('-r', f'__node:=node{i}', **files) for i in range(2)]
    robot.until(lambda: robot.publisher.get_subscription_count() == 2, 'both nodes')
    for i, image in enumerate(route[:5], 1):
        robot.publisher.publish(image_message(image, i * SECOND))
    robot.until(lambda: len(journals(path)) == 2, 'a place of each')
    for node in both:
        node.popen.send_signal(2)
    assert [node.wait() for node in both] == [0, 0]
    saved = sorted(tmp_path.glob('route*.stavpr'))
    assert [file.name for file in saved] == ['route-2.stavpr', 'route.stavpr']
    assert all(len(load_map(file)) for file in saved)
    assert journals(path) == []


def test_node_on_a_small_file_system_that_is_full_keeps_the_journal(nodes, robot, route, tmp_path):
    """A file system of its own, where the rights allow it."""
    disk = tmp_path / 'disk'
    disk.mkdir()
    mount = ['mount', '-t', 'tmpfs', '-o', 'size=256k', 'tmpfs', str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip('file systems cannot be mounted here')
    try:
        path = disk / 'route.stavpr'
        node = nodes(operation='mapping', save_path=path, maps_folder=disk)
        robot.wait_for_node()
        robot.drive(route[:8])
        robot.until(lambda: bool(journals(path)), 'the journal')
        free = os.statvfs(disk)
        (disk / 'other').write_bytes(bytes(free.f_bavail * free.f_frsize))
        robot.drive(route[8:10])
        assert node.stop() == 1
        assert 'the map is not saved: ' in node.output()
        assert f'stay in {path}.journal' in node.output()
        (disk / 'other').unlink()
        assert recover(journals(path)[0], tmp_path / 'recovered').places >= 8
    finally:
        subprocess.run(['umount', '-l', str(disk)], check=True)
