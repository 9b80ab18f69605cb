# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Running node, replay and recorders as processes: failures are named at once."""

import fcntl
import os
import socket

from evaluation_commands import write_images
from map_examples import VERSION2
import pytest
from stavpr_lab.commands import demo
from stavpr_lab.demonstration import live
from stavpr_lab.demonstration.live import run_live
from stavpr_lab.demonstration.recordings import Recording
from stavpr_ros.errors import StavprError


def test_run_live_returns_why_the_node_cannot_start(tmp_path, route):
    images = write_images(tmp_path / 'images', route[:1])
    parameters = {'map_path': VERSION2 / 'onnx.stavpr', 'model_path': tmp_path}
    with pytest.raises(StavprError, match=r'node cannot start: the model with sha256 [0-9a-f]'):
        run_live(parameters, Recording(str(images)), 1, tmp_path)
    assert 'copy the file that the map was built with there' in (tmp_path / 'node.log').read_text()


def test_domain_is_free_and_its_settings_are_its_own(monkeypatch):
    kept = {'ROS_DISTRO': 'jazzy', 'ROS_LOG_DIR': '/log'}
    foreign = {'ROS_DOMAIN_ID': '7', 'ROS_STATIC_PEERS': 'robot', 'RMW_IMPLEMENTATION': 'rmw_none'}
    foreign |= {'FASTRTPS_DEFAULT_PROFILES_FILE': '/none', 'RCUTILS_CONSOLE_OUTPUT_FORMAT': ''}
    for name, value in (kept | foreign).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(live.random, 'sample', lambda *_: [41, 41, 42])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('', 7410 + 250 * 41))  # as one that uses domain 41
        environment = live.private_domain()
    own = {'ROS_DOMAIN_ID': '42', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    expected = kept | own | {'PATH': os.environ['PATH']}
    assert {name: environment.get(name) for name in foreign | expected} == (
        dict.fromkeys(foreign) | expected
    )


def test_second_demonstration_in_a_folder_is_refused(tmp_path, capsys):
    with (tmp_path / demo.WRITTEN).open('a') as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        assert demo.main(['--output', str(tmp_path)]) == 2
    assert f'another demo writes to {tmp_path}: give another --output' in capsys.readouterr().err
