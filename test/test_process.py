# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node or command at its start and end: arguments, transport, signals, read-only folders."""

import os
from pathlib import Path
import pwd
import signal
import subprocess
import sys
import tempfile
from types import SimpleNamespace

import numpy as np
import pytest
from stavpr_ros import signals
from stavpr_ros.commands import build_map
from stavpr_ros.commands.program import run_program
from stavpr_ros.errors import SettingsError, SourceError, UnavailableError
from stavpr_ros.features.model_files import cache_folder
from stavpr_ros.parameters import BY_NAME
from stavpr_ros.pipeline.maps_folder import maps_folder
from stavpr_ros.ros.parameters import transport_remedy
from stavpr_ros.ros.process import own_arguments, require_ros_arguments
from stavpr_ros.ros.rclpy_workarounds import rclpy_implementation, ros_arguments_checked
from stavpr_ros.sources import open_source
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        ('-p map_path:=x', '-p map_path:=x'),
        ('map_path:=route.stavpr', 'map_path:=route.stavpr'),
        ('--map x', '--map x'),
        ('--min-probability=0.9 --ros-args -p a:=b', '--min-probability=0.9'),
        ('--ros-args -p a:=b -- -r image:=/camera', '-r image:=/camera'),
        ('--params-file x.yaml', '--params-file x.yaml'),
    ],
)
def test_arguments_that_nothing_reads_are_rejected_with_the_form_to_write(arguments, words):
    expected = f'reads the arguments {words!r}: write --ros-args -p NAME:=VALUE with a NAME'
    with pytest.raises(SettingsError, match=expected):
        require_ros_arguments(arguments.split(), BY_NAME)


def test_arguments_that_are_no_utf8_stay_as_they_are():
    words = ['caf\udce9/', '--also', '/a', '--also', '/a']
    assert own_arguments([*words, '--ros-args', '-r', 'image:=/cafe']) == words


@pytest.mark.parametrize('arguments', ['', '--ros-args -p map_path:=x', 'image:=/camera'])
def test_arguments_of_ros_are_accepted(arguments):
    require_ros_arguments(arguments.split(), BY_NAME)


def test_log_directory_that_cannot_be_written_is_named(environ):
    environ['ROS_LOG_DIR'] = '/proc/log'
    expected = pytest.raises(UnavailableError, match='/proc/log cannot be written: set ROS_LOG')
    with expected, ros_arguments_checked():
        raise rclpy_implementation.RCLError('failed to initialize logging: no folder')


@pytest.mark.parametrize(
    ('topic', 'published', 'remedy'),
    [
        ('/image', '/image/compressed', 'set image_transport to compressed'),
        ('/image/compressed', '/image', 'set image_transport to raw'),
        ('/image/ffmpeg', '/image/foxglove', 'set image_transport to foxglove'),
        ('/image', '/other', ''),
    ],
)
def test_images_of_the_other_transport_are_named(topic, published, remedy):
    node = SimpleNamespace(count_publishers=lambda name: int(name == published))
    expected = f'{published} is published: {remedy}' if remedy else ''
    assert transport_remedy(node, topic) == expected


WAITING = """
import threading, rclpy
from stavpr_ros.ros import process
from stavpr_ros.signals import run_until_signal

def make():
    node = rclpy.create_node('waiting')
    node.THREADS = 2
    threading.Timer(0.5, lambda: print('waits', flush=True)).start()
    return node

process.LONG_POLL = 60.0
run_until_signal(lambda: process.run_node(make, []))
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signal_wakes_an_executor_that_waits(number):
    with subprocess.Popen([sys.executable, '-c', WAITING], stdout=subprocess.PIPE) as node:
        assert node.stdout is not None
        assert node.stdout.readline() == b'waits\n'
        node.send_signal(number)
        assert node.wait(20) == 0


# The end after a signal: its time is shared by all waits, and no thread holds it up

ENDLESS = """
import atexit, os, signal, sys, threading
from stavpr_ros.signals import end_process, obey_signals
atexit.register(print, 'teardown')
obey_signals()
threading.Thread(target=threading.Event().wait).start()
try:
    os.kill(os.getpid(), signal.SIGINT)
    threading.Event().wait()
except KeyboardInterrupt:
    os.kill(os.getpid(), signal.SIGINT)
    print('interrupted once')
    end_process(7)
"""


@pytest.fixture
def interrupted_at(monkeypatch):
    """Return a function that sets the seconds since the first signal."""

    def at(seconds):
        monkeypatch.setattr(signals._State, 'received', True)
        monkeypatch.setattr(signals._State, 'time', 100.0)
        monkeypatch.setattr(signals.time, 'monotonic', lambda: 100.0 + seconds)

    return at


@pytest.mark.parametrize(
    ('seconds', 'most', 'least', 'left'),
    [
        (0.0, 30.0, 0.1, signals.END_SECONDS),
        (0.0, 2.0, 0.1, 2.0),
        (signals.END_SECONDS - 1, 2.0, 0.1, 1.0),
        (signals.END_SECONDS + 9, 2.0, 0.1, 0.1),
        (signals.END_SECONDS + 9, 2.0, 1.0, 1.0),
    ],
)
def test_time_left_after_a_signal_ends_with_the_time_of_all(
    interrupted_at, seconds, most, least, left
):
    assert signals.time_left(most, least) == most  # before the signal
    interrupted_at(seconds)
    assert signals.time_left(most, least) == pytest.approx(left)


def test_end_process_waits_for_no_thread_and_second_signal_is_ignored():
    done = subprocess.run(
        [sys.executable, '-c', ENDLESS], capture_output=True, text=True, timeout=180, check=False
    )
    assert (done.returncode, done.stdout) == (7, 'interrupted once\n')


# A system whose folders cannot be written: it works where it can, and else states why


@pytest.fixture
def bag(tmp_path, set_constants):
    """Return a bag; temporary files cannot be made any more."""
    images = np.random.default_rng(0).integers(0, 256, (24, 48, 64, 3), np.uint8)
    write_bag(tmp_path / 'bag', '/image', map(ImageRecord.of_image, images, range(1, 25)))
    set_constants(tempfile, tempdir='/proc/none')
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


def test_user_without_a_home_has_the_root(environ, monkeypatch):
    def unknown(_):
        raise KeyError

    for name in ('HOME', 'XDG_DATA_HOME', 'XDG_CACHE_HOME'):
        environ.pop(name, None)
    monkeypatch.setattr(pwd, 'getpwuid', unknown)
    assert maps_folder('') == Path('/.local/share/stavpr/maps')
    assert maps_folder('~/maps').is_absolute()
    assert cache_folder() == Path('/.cache/stavpr_ros')
