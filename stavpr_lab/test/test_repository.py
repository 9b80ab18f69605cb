# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The set-up behind the Makefile, and the stored list of the public API."""

import difflib
from pathlib import Path
import re
import sys

from public_api import COMMAND, FILE, public_api
import pytest
import setup_venv

GROUPS = ('torch', *(f'locked/{name}' for name in ('base', *setup_venv.LOCKED_EXTRAS)))


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
def recorder(tmp_path: Path, monkeypatch, set_constants) -> Recorder:
    """Record in a checkout in which nothing is installed and every requirement is ``fake``."""
    for name in ('requirements/locked', 'stavpr_msgs', 'stavpr_ros'):
        (tmp_path / name).mkdir(parents=True)
    for name in GROUPS:
        (tmp_path / 'requirements' / f'{name}.txt').write_text('fake==1\n')
    (tmp_path / 'requirements' / 'constraints.txt').touch()
    recorder = Recorder(tmp_path)
    set_constants(setup_venv, ROOT=tmp_path)
    monkeypatch.setattr(setup_venv, 'machine_problems', list)
    monkeypatch.setattr(setup_venv, 'run_logged', recorder)
    return recorder


def test_extras_are_added_and_kept(recorder):
    assert recorder.run('build', '--with', 'onnx')[-1] == 'stavpr_lab'
    assert recorder.run('build', '--with', 'dev') == ['torch', 'pip']
    assert '--require-hashes --no-deps' in recorder.commands['pip']
    installed = re.findall(r'locked/(\w+)\.txt', recorder.commands['pip'])
    assert installed == ['base', 'onnx', 'dev']
    assert recorder.run('build', '--with', 'dev', 'onnx') == recorder.run('build') == []


def test_torch_is_left_out_and_stays_out(recorder):
    assert recorder.run('setup', '--torch-index', 'none') == ['venv', 'pip']
    assert recorder.run('setup', '--with', 'dev') == ['pip']
    assert recorder.run('setup', '--torch-index', 'https://a') == ['venv', 'torch', 'pip']


# The public API equals the stored list: a change of a promised name is visible in review


def test_public_api_is_that_of_the_stored_list():
    stored = FILE.read_text(encoding='utf-8').splitlines()
    changes = [*difflib.unified_diff(stored, public_api().splitlines(), n=0, lineterm='')]
    assert not changes, '\n'.join([f'write the changed list by {COMMAND}:', *changes])
