# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Tests of the set-up behind the Makefile; none of them needs a network."""

from importlib import metadata
import os
from pathlib import Path
import re
import sys

from packaging.specifiers import SpecifierSet
import pytest
import setup_venv

ROOT = Path(__file__).resolve().parents[2]
GROUPS = ('torch', *(f'locked/{name}' for name in ('base', *setup_venv.LOCKED_EXTRAS)))
EXACT = re.compile(r'^([\w.-]+)(?:\[\w+\])?==([\w.]+)', re.MULTILINE)


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a checkout in which nothing is installed and every requirement is ``fake``."""
    for name in ('requirements/locked', 'stavpr_msgs', 'stavpr_ros'):
        (tmp_path / name).mkdir(parents=True)
    for name in GROUPS:
        (tmp_path / 'requirements' / f'{name}.txt').write_text('fake==1\n')
    (tmp_path / 'requirements' / 'constraints.txt').touch()
    monkeypatch.setattr(setup_venv, 'ROOT', tmp_path)
    monkeypatch.setattr(setup_venv, 'machine_problems', list)
    return tmp_path


class Recorder:
    """Replaces ``run_logged``: records the commands."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.commands: dict[str, str] = {}

    def __call__(self, name: str, title: str, command: list) -> None:
        self.commands[name] = ' '.join(map(str, command))
        if name == 'venv':
            (self.root / '.venv').mkdir(exist_ok=True)
            (self.root / '.venv' / 'pyvenv.cfg').write_text(f'home = {sys.base_prefix}')
        if name in setup_venv.SOURCES:
            (self.root / 'install' / name).mkdir(parents=True)  # fails where an old one is left

    def run(self, *arguments: str) -> list[str]:
        """Return the names of the commands that the set-up runs for its arguments."""
        self.commands.clear()
        setup_venv.main(list(arguments))
        return list(self.commands)


@pytest.fixture
def recorder(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> Recorder:
    recorder = Recorder(checkout)
    monkeypatch.setattr(setup_venv, 'run_logged', recorder)
    return recorder


def test_extras_are_added_and_kept(recorder):
    assert recorder.run('build', '--with', 'onnx')[-1] == 'stavpr_lab'
    assert recorder.run('build', '--with', 'dev') == ['torch', 'pip']
    assert '--require-hashes --no-deps' in recorder.commands['pip']
    installed = re.findall(r'locked/(\w+)\.txt', recorder.commands['pip'])
    assert installed == ['base', 'onnx', 'dev']
    assert recorder.run('build', '--with', 'dev', 'onnx') == recorder.run('build') == []


def test_pins_are_for_the_first_release_of_this_python():
    texts = [(ROOT / 'requirements' / f'{name}.txt').read_text() for name in GROUPS]
    first = f'{setup_venv.PYTHON_VERSION}.0'
    compared = 0
    for name, version in {pin for text in texts for pin in EXACT.findall(text)}:
        try:
            package = metadata.metadata(name)
        except metadata.PackageNotFoundError:
            continue  # of an extra that is not installed
        if package['Version'] == version:  # the pin of this Python
            needs = package.get('Requires-Python', '')
            assert SpecifierSet(needs).contains(first), f'{name} {version} needs Python {needs}'
            compared += 1
    assert compared > 200


def test_environment_has_no_other_ros(checkout, monkeypatch):
    kept = {'ROS_DOMAIN_ID': '7', 'STAVPR_DATA': '/data'}
    variables = kept | dict.fromkeys(setup_venv.FOREIGN, 'x') | {
        'PATH': '/opt/ros/jazzy/bin:/usr/bin:/ws/install/a/bin:/opt/rosalind/bin',
        'AMENT_PREFIX_PATH': '/ws/install/a:/opt/ros/jazzy',
        'COLCON_PREFIX_PATH': '/ws/install',
        'LD_LIBRARY_PATH': '/opt/ros/jazzy/lib:/v/lib/python3.11/site-packages/ros_rcl.libs',
    }  # fmt: skip
    monkeypatch.setattr(os, 'environ', variables)
    venv = str(checkout / '.venv')
    assert setup_venv.clean_environment() == kept | {
        'PATH': f'{venv}/bin:/usr/bin:/opt/rosalind/bin',
        'COLCON_HOME': f'{venv}/colcon',
        'PIP_USER': '0',
        **dict.fromkeys(('VIRTUAL_ENV', 'AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH'), venv),
    }
