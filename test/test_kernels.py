# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels: their cache folder, damaged files, and what is compiled when."""

import os
from pathlib import Path
import pickle
import shutil
import subprocess
import sys

import cv2
from evaluation_commands import write_images
import numba
import numpy as np
from processes import environment, TIMEOUT
import pytest
from stavpr_ros import compilation, kernel_cache
from stavpr_ros.commands import warm
from stavpr_ros.compilation import cache_folder, kernel, KERNELS


@pytest.fixture
def read_only(tmp_path, environ, monkeypatch):
    """Return a folder of kernels that cannot be written; others can be."""
    folder, temporary = tmp_path / 'read_only', tmp_path / 'temporary'
    for path in (folder, temporary):
        path.mkdir()
    (folder / 'kernel.nbi').write_text('index')
    is_writable = compilation._is_writable
    monkeypatch.setattr(compilation, '_is_writable', lambda f: f != folder and is_writable(f))
    environ['NUMBA_CACHE_DIR'] = str(folder)
    monkeypatch.setattr('tempfile.tempdir', str(temporary))
    return folder


def test_read_only_kernels_are_copied_to_a_temporary_folder(read_only, caplog):
    folder = cache_folder()
    assert folder.parent.name == 'temporary'
    assert (folder / 'kernel.nbi').read_text() == 'index'
    assert f'({read_only}): {folder} is used; set NUMBA_CACHE_DIR' in caplog.text
    folder.chmod(0o777)  # others could write: what is in it is not unpickled
    assert cache_folder() is None
    assert 'they are compiled at each start' in caplog.text


def test_package_without_home_keeps_its_kernels_itself(environ):
    environ.pop('NUMBA_CACHE_DIR', None)
    environ['HOME'] = '/proc/nohome'
    assert cache_folder() == Path(compilation.__file__).parent / '__pycache__' / 'kernels'


def test_kernels_of_another_version_are_not_read(tmp_path):
    """Numba unpickles an index before it compares versions: a type that has moved is an error."""
    package = tmp_path / 'stavpr_ros'
    shutil.copytree(compilation.PACKAGE, package, ignore=shutil.ignore_patterns('__pycache__'))
    variables = environment() | {'PYTHONPATH': str(tmp_path)}
    variables.pop('NUMBA_CACHE_DIR', None)
    folders = []
    for addition in ('', '\n', ''):
        path = package / 'alignment' / 'cpu' / 'dtw.py'
        path.write_text(path.read_text().rstrip('\n') + '\n' + addition)
        command = [
            sys.executable,
            '-c',
            'from stavpr_ros import compilation; print(compilation.CACHE)',
        ]
        printed = subprocess.check_output(command, cwd=tmp_path, env=variables, text=True)
        folders.append(Path(printed.strip()))
        folders[-1].mkdir(parents=True)
    assert folders[0] == folders[2] != folders[1]
    assert not folders[1].exists()  # of the version in between
    assert folders[0].parent == package / '__pycache__' / 'kernels'


DRIVE = """
import array
import gc
from types import SimpleNamespace
import numpy as np
from numba.core.dispatcher import Dispatcher
from stavpr_ros.mapping import build_map, KeyframeSettings
from stavpr_ros.pipeline import PipelineSettings
from stavpr_ros.pipeline.operations import LocalizationOperation, RouteCloser
from stavpr_ros.pipeline.save_state import SaveState
from stavpr_ros.sources.frame import Frame

def compiled():
    return {(f.__qualname__, tuple(f.signatures)) for f in gc.get_objects()
            if isinstance(f, Dispatcher) and f.signatures}

settings = PipelineSettings(
    backend='cpu', max_places=110, keyframes=KeyframeSettings(change=0.004)
)
extractor = settings.extractor()
images = np.random.default_rng(0).integers(0, 256, (60, 96, 128, 3), np.uint8)
route = build_map([Frame(image, i, str(i)) for i, image in enumerate(images)], extractor)
for operation in (
    LocalizationOperation(settings, route, extractor, SaveState()),
    RouteCloser(settings, None, extractor, SaveState()),
):
    before = compiled()
    for i, image in enumerate([*images, *images]):
        message = SimpleNamespace(height=96, width=128, encoding='rgb8', is_bigendian=0)
        message.step, message.data = 384, array.array('B', image.tobytes())
        assert operation.process(message, (i + 1) * 10**8).match is not None
    print(operation.name, sorted(compiled() - before))
"""


def test_no_kernel_is_compiled_after_the_start_of_an_operation():
    run = [sys.executable, '-c', DRIVE]
    text = subprocess.check_output(run, env=environment(), timeout=TIMEOUT, text=True)
    assert text.splitlines() == ['localization []', 'loop_closure []']


def _sum(a, b):
    return a + b


@pytest.fixture
def folder(tmp_path, set_constants):
    """Return a folder in which kernels are kept, an empty one."""
    set_constants(numba.config, CACHE_DIR=str(tmp_path / 'kernels'))
    set_constants(kernel_cache, failures={})
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
@pytest.mark.usefixtures('working_folder')
def test_damaged_kernel_is_compiled_anew_and_replaced(folder, damaged, caplog):
    assert [hits(), hits()] == [0, 1]
    (path,) = folder.glob('*_sum*')  # beside numba's runtime
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
    line, announcement = sorted(errors.splitlines())
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


LOADED = """
import sys
import numba
import numpy as np
from llvmlite import binding
from stavpr_ros.compilation import kernel
from stavpr_ros.kernel_cache import Library

calls = []

def count(owner, name):
    call = getattr(owner, name)
    setattr(owner, name, lambda *arguments: (calls.append(name), call(*arguments))[1])

count(binding, 'parse_bitcode')
count(Library, '_optimize_final_module')

@kernel
def reverse(values):
    return values[::-1].copy()  # counts references

@kernel
def twice(values):
    return reverse(values).sum() + 1

@numba.njit(cache=True)
def by_numba(a):
    return a + 1

values = np.arange(4.0)
if 'callers' in sys.argv:
    print(int(twice(values)), end=' ')
print(list(map(int, reverse(values))), *sorted(set(calls)))
if 'numba' in sys.argv:
    print(by_numba(1), sum(by_numba.stats.cache_hits.values()))
"""


def test_loaded_kernels_need_neither_optimizer_nor_bitcode_but_callers_do(tmp_path):
    (tmp_path / 'program.py').write_text(LOADED)
    variables = environment() | {'NUMBA_CACHE_DIR': str(tmp_path / 'kernels')}
    printed = [
        subprocess.check_output(
            [sys.executable, 'program.py', *words], cwd=tmp_path, env=variables, text=True
        )
        for words in ([], [], ['callers'], ['callers'], ['numba'], ['numba'])
    ]
    assert printed == [
        '[3, 2, 1, 0] _optimize_final_module\n',
        '[3, 2, 1, 0]\n',
        '7 [3, 2, 1, 0] _optimize_final_module parse_bitcode\n',  # linked with a loaded one
        '7 [3, 2, 1, 0]\n',
        '[3, 2, 1, 0]\n2 0\n',
        '[3, 2, 1, 0]\n2 1\n',  # a cache of numba in the same process
    ]


COUNTED = """
import sys
from numba.core import event
compiled = event.RecordingListener()
event.register('numba:compile', compiled)
from stavpr_ros.commands.stavpr import main
for line in sys.argv[1].strip().splitlines():
    assert main(line.split()) == 0, line
if 'evaluate' in line:
    from stavpr_lab.demonstration.street.traverses import first_traverse, second_traverse, World
    first_traverse(World(3))[10], second_traverse(World(3))[70]
print([each.data['dispatcher'] for _, each in compiled.buffer if each.is_start])
"""
COMMANDS = """
build_map --input monday --output monday.stavpr
build_map --input tuesday --output tuesday.stavpr
map merge both.stavpr monday.stavpr tuesday.stavpr
map close monday.stavpr closed.stavpr
map compact both.stavpr small.stavpr --pca 16 --storage float16
map update monday.stavpr tuesday
optimize_graph graph.g2o --output solved.tum
evaluate --map both.stavpr --query tuesday --output report_both
evaluate --map small.stavpr --query tuesday --output report_small --precision int8
evaluate --map closed.stavpr --query tuesday --output report_closed --direction both
evaluate --map monday.stavpr --query tuesday --json paper.json --mode paper --truth identity
"""


def test_nothing_is_compiled_after_warm(tmp_path, route):
    """In an empty cache folder, by operations on maps of one and several sessions, and graphs."""
    dice = np.random.default_rng(0)
    for day in ('monday', 'tuesday'):
        noise = dice.integers(0, 20, (len(route), *route[0].shape)).astype(np.uint8)
        write_images(tmp_path / day, map(cv2.add, route, noise))
    edges = [(i, i + 1) for i in range(39)] + [(i, i + 20) for i in range(20)]
    lines = [f'EDGE_SE2 {i} {j} {i % 2} 0 0 9 0 0 9 0 9' for i, j in edges]
    (tmp_path / 'graph.g2o').write_text('\n'.join(lines))
    variables = environment() | {'NUMBA_CACHE_DIR': str(tmp_path / 'kernels')}
    options = {'cwd': tmp_path, 'env': variables, 'text': True, 'timeout': 5 * TIMEOUT}
    compiled = []
    for commands in ('warm', COMMANDS):
        done = subprocess.check_output([sys.executable, '-c', COUNTED, commands], **options)
        compiled.append(done.splitlines()[-1])
    assert compiled[0].count('CPUDispatcher') == pytest.approx(KERNELS, rel=0.05)
    assert compiled[1] == '[]'


def test_warm_fails_where_the_cache_cannot_be_written(set_constants, capsys):
    failures = {kernel_cache.WRITE_FAILED: '[Errno 28] No space left on device'}
    set_constants(kernel_cache, failures=failures)
    assert warm.main([]) == 1
    assert 'cannot be written: [Errno 28] No space left' in capsys.readouterr().err
