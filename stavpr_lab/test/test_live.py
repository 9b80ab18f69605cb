# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Running node, replay and recorders as processes: failures are named at once."""

import fcntl
import os
import socket

import cv2
from map_examples import VERSION2
import pytest
from stavpr_lab.commands import demo
from stavpr_lab.demonstration import live
from stavpr_lab.demonstration.live import run_live
from stavpr_lab.demonstration.recordings import Recording
from stavpr_ros.errors import StavprError


def test_run_live_returns_why_the_node_cannot_start(tmp_path, route):
    (tmp_path / 'images').mkdir()
    cv2.imwrite(str(tmp_path / 'images/0.png'), route[0])
    parameters = {'map_path': VERSION2 / 'onnx.stavpr', 'model_path': tmp_path}
    with pytest.raises(StavprError, match=r'node cannot start: the model with sha256 [0-9a-f]'):
        run_live(parameters, Recording(str(tmp_path / 'images')), 1, tmp_path)
    assert 'copy the file that the map was built with there' in (tmp_path / 'node.log').read_text()


def test_domain_is_free_and_its_settings_are_its_own(monkeypatch):
    foreign = {
        'ROS_DOMAIN_ID': '7', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF', 'ROS_LOCALHOST_ONLY': '1',
        'ROS_STATIC_PEERS': 'robot', 'ROS_DISCOVERY_SERVER': 'robot:11811', 'ROS_NAMESPACE': '/a',
        'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce',
        'RMW_IMPLEMENTATION': 'rmw_zenoh_cpp', 'RMW_FASTRTPS_USE_QOS_FROM_XML': '1',
        'FASTRTPS_DEFAULT_PROFILES_FILE': '/none.xml', 'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv6',
        'CYCLONEDDS_URI': '/none.xml', 'ZENOH_SESSION_CONFIG_URI': '/none.json5',
        'RCUTILS_CONSOLE_OUTPUT_FORMAT': '{message}', 'ROS_DISTRO': 'jazzy', 'ROS_LOG_DIR': '/log',
    }  # fmt: skip
    for name, value in foreign.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(live.random, 'sample', lambda *_: [41, 41, 42])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('', 7410 + 250 * 41))  # as one that uses domain 41
        environment = live.private_domain()
    assert {name: environment[name] for name in foreign if name in environment} == {
        'ROS_DOMAIN_ID': '42', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DISTRO': 'jazzy', 'ROS_LOG_DIR': '/log',
    }  # fmt: skip
    assert environment['PATH'] == os.environ['PATH']
    before = dict(os.environ)
    with live._applied(environment):
        assert dict(os.environ) == environment
    assert dict(os.environ) == before


def test_images_of_another_program_end_the_demonstration(tmp_path, route, map_file, monkeypatch):
    """At once, and not after all images of the query have waited for their matches."""
    (tmp_path / 'images').mkdir()
    for number, image in enumerate(route):
        cv2.imwrite(str(tmp_path / f'images/{number:03}.png'), image)
    camera = [live.executable('replay'), str(tmp_path / 'images'), '--loop']
    query = Recording(str(tmp_path / 'images'))
    with pytest.raises(StavprError, match=r'matches of \d+ images: another program .* domain \d+'):
        run_live({'map_path': map_file}, query, len(route), tmp_path, {'another camera': camera})


def test_second_demonstration_in_a_folder_is_refused(tmp_path, capsys):
    with (tmp_path / demo.WRITTEN).open('a') as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        assert demo.main(['--output', str(tmp_path)]) == 2
    assert f'another demo writes to {tmp_path}: give another --output' in capsys.readouterr().err
