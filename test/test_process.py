# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mistakes at the start of a node: its arguments, its transport, the log directory."""

import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.parameters import BY_NAME
from stavpr_ros.ros.parameters import transport_remedy
from stavpr_ros.ros.process import own_arguments, require_ros_arguments
from stavpr_ros.ros.rclpy_workarounds import rclpy_implementation, ros_arguments_checked


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


def test_log_directory_that_cannot_be_written_is_named(monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', '/proc/log')
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
