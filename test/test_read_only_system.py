# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A system whose folders cannot be written: it works where it can, and else states why."""

import os
from pathlib import Path
import pwd
import subprocess
import sys
import tempfile

import numpy as np
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.commands.program import run_program
from stavpr_ros.errors import SourceError
from stavpr_ros.features.model_files import cache_folder
from stavpr_ros.pipeline.maps_folder import maps_folder
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord


@pytest.fixture
def bag(tmp_path, monkeypatch):
    """Return a bag; temporary files cannot be made any more."""
    images = np.random.default_rng(0).integers(0, 256, (24, 48, 64, 3), np.uint8)
    write_bag(tmp_path / 'bag', '/image', map(ImageRecord.of_image, images, range(1, 25)))
    monkeypatch.setattr(tempfile, 'tempdir', '/proc/none')
    return tmp_path / 'bag'


def test_map_of_a_bag_needs_no_temporary_folder(bag, tmp_path):
    assert build_map.main(['--input', str(bag), '--output', str(tmp_path / 'a.stavpr')]) == 0
    assert sorted(file.name for file in tmp_path.iterdir()) == ['a.stavpr', 'bag']


def test_bag_with_a_log_names_the_room_for_its_copy(bag):
    (bag / 'bag.db3-wal').write_bytes(b'a log')
    match = r'bag\.db3 needs a temporary copy of \d MB or more, as bag\.db3-wal .*set TMPDIR'
    with pytest.raises(SourceError, match=match):
        open_source(bag)


def test_command_that_cannot_write_names_the_folder(capsys):
    assert run_program('work', lambda: os.mkdir('/proc/none')) == 1
    assert "'/proc/none'; expected folders that can be written" in capsys.readouterr().err


NODE = """
import rclpy
from stavpr_ros.ros.process import ros_node

with ros_node(lambda: rclpy.create_node('n'), []) as node:
    node.get_logger().info('runs')
"""


def run(program, without, **variables):
    environment = {name: os.environ[name] for name in os.environ.keys() - without} | variables
    command = [sys.executable, '-c', program]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)


@pytest.mark.parametrize('variable', ['ROS_LOG_DIR', 'ROS_HOME', 'HOME'])
def test_node_runs_without_a_log_folder(variable):
    done = run(NODE, {'ROS_LOG_DIR', 'ROS_HOME', 'HOME'}, **{variable: '/proc/none'})
    assert 'no log is written to /proc/none' in done.stderr
    assert 'runs' in done.stderr


@pytest.mark.parametrize(('folder', 'size'), [('/proc/none', 0), ('/dev/shm', 10**15)])
def test_node_without_shared_memory_uses_udp(folder, size):
    names = f'process.SHARED_MEMORY, process.SEGMENT = {folder!r}, {size}'
    program = f'from stavpr_ros.ros import process\n{names}\n{NODE}\nprint(process.os.environ)'
    done = run(program, {'FASTRTPS_DEFAULT_PROFILES_FILE'})
    assert 'sent by UDP' in done.stderr
    assert 'config/fastdds_udp.xml' in done.stdout


def test_user_without_a_home_has_the_root(monkeypatch):
    def unknown(_):
        raise KeyError

    for name in ('HOME', 'XDG_DATA_HOME', 'XDG_CACHE_HOME'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, 'getpwuid', unknown)
    assert maps_folder('') == Path('/.local/share/stavpr/maps')
    assert maps_folder('~/maps').is_absolute()
    assert cache_folder() == Path('/.cache/stavpr_ros')
