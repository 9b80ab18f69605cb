# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of compiled kernels that are damaged, or cannot be read or written."""

import os
from pathlib import Path
import pickle
import subprocess
import sys

import numba
from processes import environment, TIMEOUT
import pytest
from stavpr_ros import kernel_cache
from stavpr_ros.compilation import kernel


def _sum(a, b):
    return a + b


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder in which kernels are kept, an empty one."""
    monkeypatch.setattr(numba.config, 'CACHE_DIR', str(tmp_path / 'kernels'))
    monkeypatch.setattr(kernel_cache, 'failures', {})
    return tmp_path / 'kernels'


def hits():
    """Call the kernel as another process does; return how often it was in the cache."""
    dispatcher = kernel(_sum)
    assert dispatcher(1, 2) == 3
    return sum(dispatcher.stats.cache_hits.values())


class _Attack:
    def __reduce__(self):
        return (os.mkdir, ('attacked',))


DAMAGE = {
    'empty': lambda content: b'',
    'cut': lambda content: content[:-1],
    'flipped': lambda content: content[:999] + bytes([content[999] ^ 1]) + content[1000:],
    'attack': lambda content: bytes(32) + pickle.dumps(_Attack()),
    'pipe': None,
}


@pytest.mark.parametrize('damaged', DAMAGE.values(), ids=DAMAGE)
def test_damaged_kernel_is_compiled_anew_and_replaced(folder, damaged, caplog, monkeypatch):
    monkeypatch.chdir(folder.parent)
    assert [hits(), hits()] == [0, 1]
    (path,) = folder.iterdir()
    content = path.read_bytes()
    path.unlink()
    if damaged is None:
        os.mkfifo(path)
    else:
        path.write_bytes(damaged(content))
    assert [hits(), hits()] == [0, 1]
    (line,) = caplog.messages
    assert str(folder) in line
    assert 'damaged or not readable, and compiled anew (' in line
    assert not Path('attacked').exists()  # nothing is unpickled that was not written here


PROGRAM = """
import resource, sys
from stavpr_ros.compilation import kernel

@kernel
def scale(a, b):
    return a * b

resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
for kind in (int, float, complex):
    assert scale(kind(2), 3) == 6
print(sum(scale.stats.cache_hits.values()))
"""


def _start(folder, max_size=-1):
    """Start a program with three forms of a kernel; its files have at most so many bytes."""
    (folder / 'program.py').write_text(PROGRAM)
    variables = environment() | {'NUMBA_CACHE_DIR': str(folder / 'kernels')}
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'text': True}
    call = [sys.executable, 'program.py', str(max_size)]
    return subprocess.Popen(call, cwd=folder, env=variables, **pipes)


def test_full_disk_is_one_line(tmp_path):
    printed, errors = _start(tmp_path, max_size=100).communicate(timeout=TIMEOUT)
    assert printed == '0\n'
    announcement, line = errors.splitlines()
    assert announcement.startswith('compiling kernels')
    assert 'cannot be written, and are compiled again at the next start (OSError' in line
    assert not [path for path in (tmp_path / 'kernels').rglob('*') if path.is_file()]


def test_cache_of_processes_that_compile_at_once_is_sound_and_if_cut_is_one_line(tmp_path):
    for process in [_start(tmp_path) for _ in range(3)]:
        _, errors = process.communicate(timeout=TIMEOUT)
        assert process.returncode == 0, errors
        assert 'damaged' not in errors
    assert _start(tmp_path).communicate(timeout=TIMEOUT) == ('3\n', '')
    for path in tmp_path.rglob('*.nbc'):
        path.write_bytes(path.read_bytes()[:100])
    printed, errors = _start(tmp_path).communicate(timeout=TIMEOUT)
    assert (printed, errors.count('compiled anew')) == ('0\n', 1)
    assert _start(tmp_path).communicate(timeout=TIMEOUT) == ('3\n', '')
