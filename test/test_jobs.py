# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Commands over several inputs, in processes and on a Ray cluster; progress and help."""

import os
from pathlib import Path
import pty
import re
import subprocess
import sys
import termios

from evaluation_commands import write_images
from fixtures import route_images
from processes import environment, TIMEOUT
import pytest
from stavpr_ros.commands import build_map, Command, jobs, stavpr
from stavpr_ros.commands.jobs import Job, job_names, other_arguments, run_jobs
from stavpr_ros.errors import SettingsError

NAMES = ('monday', 'tuesday')
BUILD_MAP = 'stavpr_ros.commands.build_map'


@pytest.fixture(scope='module')
def drives(tmp_path_factory):
    """Return folders of images of two drives."""
    root = tmp_path_factory.mktemp('drives')
    return [str(write_images(root / n, route_images(30, i))) for i, n in enumerate(NAMES)]


def ids(folder):
    from stavpr_ros.mapping import open_map

    return [open_map(folder / f'{name}.stavpr').map_id for name in NAMES]


@pytest.fixture(scope='module')
def map_folder(drives, tmp_path_factory):
    """Build maps of both, one by one."""
    folder = tmp_path_factory.mktemp('maps')
    for name, drive in zip(NAMES, drives, strict=True):
        file = str(folder / f'{name}.stavpr')
        assert build_map.main(['--input', drive, '--output', file, '--no-thumbnails']) == 0
    return folder


@pytest.mark.long
def test_build_map_of_several_inputs_equals_maps_of_each(drives, map_folder, tmp_path, capfd):
    options = ['--no-thumbnails', '--processes', '2']
    output = ['--output', str(tmp_path / 'maps')]
    assert build_map.main(['--input', *drives, *output, *options]) == 0
    text = capfd.readouterr().out
    assert '--- monday: done' in text
    assert '--- tuesday: done' in text
    assert '30 of 30 images became places' in text
    assert '%|' not in text
    assert ids(tmp_path / 'maps') == ids(map_folder)


@pytest.fixture
def program(tmp_path, environ):
    """Write a module that jobs run; return its file."""
    environ['PYTHONPATH'] = f'{tmp_path}:{environ["PYTHONPATH"]}'

    def write(text):
        (tmp_path / 'program.py').write_text(f'import os, sys\n{text}\n')
        return tmp_path / 'program.py'

    return write


def test_run_jobs_failed_job_does_not_stop_others(program, capfd):
    program('print(sys.argv[1], flush=True); sys.exit(int(sys.argv[1]))')
    assert run_jobs([Job(f'job{i}', 'program', (str(i),)) for i in (1, 2, 0)], 1, None) == 2
    text = capfd.readouterr().out
    for part in ('job1: failed, exit code 1\n1\n', 'job0: done\n0', 'job2: failed, exit code 2'):
        assert f'--- {part}' in text


@pytest.mark.parametrize(
    ('killed', 'is_new', 'forced', 'shown'),
    [
        (1, False, [False, False], 'done\nout\n'),
        (1, True, [False, True], 'done\nout\n'),
        (4, False, [False] * 4, 'failed, exit code 1\nout\nkilled by signal 9\n'),
    ],
)
def test_run_jobs_killed_job_is_run_again(killed, is_new, forced, shown, program, capfd):
    """It may have written its output before: another try replaces what was not there at first."""
    runs = program(
        "print('out', flush=True); runs = open(__file__ + '.runs', 'a+')\n"
        "print('--force' in sys.argv, file=runs, flush=True); runs.seek(0)\n"
        f'if len(runs.readlines()) <= {killed}: os.kill(os.getpid(), 9)'
    ).with_suffix('.py.runs')
    assert run_jobs([Job('a', 'program', (), is_new)], 1, None) == (killed == len(forced))
    assert runs.read_text().split() == list(map(str, forced))
    assert capfd.readouterr().out == f'--- a: {shown}'


def test_job_names_and_arguments():
    assert job_names(['a/monday.bag', 'b/tuesday/', 'c.mat:x']) == ['monday', 'tuesday', 'c']
    with pytest.raises(SettingsError, match="'monday'"):
        job_names(['a/monday.bag', 'b/monday'])
    options = ['--input', 'a', 'b', '--every', '2', '--output', 'c', '--ray', 'auto', '--force']
    assert other_arguments(options, '--input') == ['--every', '2', '--force']
    with pytest.raises(SettingsError, match='--processes 0'):
        run_jobs([], 0, None)


def test_run_here_returns_code_and_output():
    code, text = jobs.run_here(Job('a', BUILD_MAP, ('--input', '/none', '--output', '/none/a')))
    assert code == 1
    assert '/none' in text
    assert jobs.run_here(Job('a', BUILD_MAP, ('--wrong',)))[0] == 2


@pytest.mark.long
def test_ray_with_one_of_two_workers_killed_builds_the_same_maps(drives, map_folder, tmp_path):
    """A head without processors, and two machines of one; the first to work is killed."""
    module = pytest.importorskip('ray', reason='the extra ray is not installed')
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={'num_cpus': 0})
    workers = [cluster.add_node(num_cpus=1) for _ in range(2)]
    many = tmp_path / 'many'
    many.mkdir()
    inputs = []
    for i in range(6):
        link = many / f'{NAMES[i % 2]}{i}'
        link.symlink_to(drives[i % 2])
        inputs.append(str(link))
    command = [sys.executable, '-m', 'stavpr_ros.commands.build_map', '--input', *inputs]
    command += ['--output', str(tmp_path / 'maps'), '--no-thumbnails', '--ray', cluster.address]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        first = running.stdout.readline()
        cluster.remove_node(workers[0], allow_graceful=False)
        out = first + running.communicate(timeout=300)[0]
    finally:
        running.kill()
        module.shutdown()
        cluster.shutdown()
    print(out)
    assert running.returncode == 0, out
    assert out.count(': done') == 6
    from stavpr_ros.mapping import open_map

    result = [open_map(tmp_path / 'maps' / f'{Path(one).name}.stavpr').map_id for one in inputs]
    assert result == ids(map_folder) * 3


# What commands show: progress on terminals and in log files, and columns of their help

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
