# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of compiled kernels that are damaged, or cannot be read or written."""

import errno
import os
from pathlib import Path
import pickle
import shutil
import subprocess
import sys

import cv2
import numba
from processes import environment, TIMEOUT
import pytest
from stavpr_ros import kernel_cache
from stavpr_ros.compilation import CACHE, kernel

LENGTHS = (0, 1, 31, 32, 33, 100, 2000, -1)


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


def the_file(folder):
    """Return the only file in the cache."""
    (path,) = (path for path in folder.rglob('*') if path.parent.parent == folder)
    return path


def _pipe(path):
    path.unlink()
    os.mkfifo(path)


def _directory(path):
    path.unlink()
    path.mkdir()
    (path / 'file').touch()


def _link_to_itself(path):
    path.unlink()
    path.symlink_to(path.name)


def _flipped(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


class _Attack:
    def __reduce__(self):
        return (os.mkdir, ('attacked',))


DAMAGE = {
    **{f'cut{n}': lambda path, n=n: path.write_bytes(path.read_bytes()[:n]) for n in LENGTHS},
    'zeros': lambda path: path.write_bytes(bytes(path.stat().st_size)),
    'zeros_at_its_end': lambda path: path.write_bytes(path.read_bytes()[:-512] + bytes(512)),
    'flipped': _flipped,
    'longer': lambda path: path.write_bytes(path.read_bytes() + b'\0'),
    'text': lambda path: path.write_text('not a kernel\n' * 100),
    'pickle': lambda path: path.write_bytes(pickle.dumps('0.1')),
    'attack': lambda path: path.write_bytes(pickle.dumps(_Attack())),
    'pipe': _pipe,
    'directory': _directory,
    'link_to_itself': _link_to_itself,
}


@pytest.mark.parametrize('damage', DAMAGE.values(), ids=DAMAGE)
def test_damaged_kernel_is_compiled_anew_and_replaced(folder, damage, caplog, monkeypatch):
    monkeypatch.chdir(folder.parent)
    assert [hits(), hits()] == [0, 1]
    damage(the_file(folder))
    assert [hits(), hits()] == [0, 1]
    (line,) = caplog.messages
    assert str(folder) in line
    assert 'some are damaged or cannot be read, and are compiled anew (' in line
    assert not Path('attacked').exists()  # nothing is unpickled that was not written here


def test_removed_kernel_and_dangling_link_are_no_damage(folder, caplog):
    hits()
    path = the_file(folder)
    path.rename(path.with_suffix('.away'))
    path.symlink_to('nowhere')
    path.with_suffix('.away').unlink()
    assert [hits(), hits()] == [0, 1]
    assert caplog.messages == []


def test_sound_file_whose_content_llvm_rejects_is_compiled_anew(folder, caplog):
    hits()
    dispatcher, path = kernel(_sum), the_file(folder)
    files = dispatcher._cache._cache_file
    files._path = lambda key: path
    files.save((), ('no', 'such', 'result'))
    assert [hits(), hits()] == [0, 1]
    assert 'compiled anew' in caplog.text


@pytest.mark.parametrize('name', ['ENOSPC', 'EDQUOT', 'EROFS', 'EACCES', 'EIO', 'EFBIG', 'EMFILE'])
def test_kernel_that_cannot_be_written_is_used(folder, name, caplog, monkeypatch):
    code = getattr(errno, name)

    def fail(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(kernel_cache._Files, '_open_for_write', fail)
    assert [hits(), hits()] == [0, 0]
    (line,) = caplog.messages
    assert 'cannot be written, and are compiled again at the next start' in line
    assert os.strerror(code) in line


def test_file_in_place_of_the_folder_is_no_reason_to_stop(folder, caplog):
    folder.write_text('')
    assert [hits(), hits()] == [0, 0]
    assert len(caplog.messages) == 2  # neither read nor written


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


def _start(folder, most=-1):
    """Start a program with three forms of a kernel; its files have at most so many bytes."""
    (folder / 'program.py').write_text(PROGRAM)
    variables = environment() | {'NUMBA_CACHE_DIR': str(folder / 'kernels')}
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'text': True}
    call = [sys.executable, 'program.py', str(most)]
    return subprocess.Popen(call, cwd=folder, env=variables, **pipes)


def test_full_disk_is_one_line(tmp_path):
    printed, errors = _start(tmp_path, most=100).communicate(timeout=TIMEOUT)
    assert printed == '0\n'
    announcement, line = errors.splitlines()
    assert announcement.startswith('compiling kernels')
    assert 'cannot be written, and are compiled again at the next start (OSError' in line
    assert not [path for path in (tmp_path / 'kernels').rglob('*') if path.is_file()]


def test_processes_that_compile_at_once_leave_a_sound_cache(tmp_path):
    for process in [_start(tmp_path) for _ in range(3)]:
        _, errors = process.communicate(timeout=TIMEOUT)
        assert process.returncode == 0, errors
        assert 'damaged' not in errors
    assert _start(tmp_path).communicate(timeout=TIMEOUT) == ('3\n', '')


@pytest.mark.parametrize('length', [0, 100])
def test_program_starts_with_a_cut_cache(length, tmp_path, route):
    (tmp_path / 'images').mkdir()
    for number, image in enumerate(route[:3]):
        cv2.imwrite(str(tmp_path / f'images/{number}.png'), image)
    program = 'from stavpr_ros.commands.build_map import main; raise SystemExit(main())'
    call = [sys.executable, '-c', program, '--input', 'images', '--output', 'map', '--force']
    cache = tmp_path / 'kernels'
    shutil.copytree(CACHE, cache / CACHE.name)
    for path in cache.rglob('*.nbc'):
        path.write_bytes(path.read_bytes()[:length])
    options = {'cwd': tmp_path, 'capture_output': True, 'text': True, 'timeout': TIMEOUT}
    options['env'] = environment() | {'NUMBA_CACHE_DIR': str(cache)}
    runs = [subprocess.run(call, **options, check=True) for _ in range(2)]
    assert runs[0].stderr.count('compiled anew') == 1
    assert 'compil' not in runs[1].stderr + runs[1].stdout
