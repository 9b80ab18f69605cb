# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What commands show: progress on terminals and in log files, and columns of their help."""

import os
import pty
import re
import subprocess
import sys
import termios

from processes import environment, TIMEOUT
import pytest
from stavpr_ros.commands import Command, stavpr

PROGRAM = """
from stavpr_ros.progress import Progress
for _ in Progress(range(3), desc='extracting', mininterval=0, delay=0, unit='image'):
    pass
with Progress(total=2, mininterval=0, delay=0) as bar:
    bar.update(2)
"""


def _run(**options):
    call = [sys.executable, '-c', PROGRAM]
    return subprocess.run(call, **{'env': environment(), 'timeout': TIMEOUT} | options, check=True)


def test_log_file_has_plain_lines():
    lines = _run(stderr=subprocess.PIPE).stderr.decode().split('\n')
    assert 'extracting: 3 of 3' in lines
    assert lines[-2:] == ['2 of 2', '']
    assert all(re.fullmatch(r'(extracting: )?\d of \d', line) for line in lines[:-1])


@pytest.mark.parametrize(('terminal', 'has_bar'), [('xterm', True), ('dumb', False)])
def test_terminal_that_can_move_a_bar_shows_one(terminal, has_bar):
    first, second = pty.openpty()
    termios.tcsetwinsize(second, (24, 80))
    _run(stderr=second, env=environment() | {'TERM': terminal})
    assert (b'\rextracting' in os.read(first, 4096)) == has_bar
    os.close(first)
    os.close(second)


def test_help_has_columns_for_names_of_any_length(monkeypatch, capsys):
    commands = stavpr.all_commands() | {'a_command_of_another_package': Command('m', 'its text')}
    monkeypatch.setattr(stavpr, 'all_commands', lambda: commands)
    assert stavpr.main(['--help']) == 0
    lines = capsys.readouterr().out.splitlines()
    for name, command in commands.items():
        (line,) = (line for line in lines if line.split(maxsplit=1)[:1] == [name])
        assert re.search(rf'^  {name} {{2,}}{re.escape(command.summary)}', line)
        assert line.index(command.summary) == len('  a_command_of_another_package  ')
