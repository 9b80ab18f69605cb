# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The cache folder of compiled kernels, and the announcement of their compilation."""

from pathlib import Path
import shutil
import subprocess
import sys

from processes import environment, TIMEOUT
import pytest
from stavpr_ros import compilation
from stavpr_ros.compilation import cache_folder


@pytest.fixture
def read_only(tmp_path, monkeypatch):
    """Return a folder of kernels that cannot be written; others can be."""
    folder, temporary = tmp_path / 'read_only', tmp_path / 'temporary'
    for each in (folder, temporary):
        each.mkdir()
    (folder / 'kernel.nbi').write_text('index')
    is_writable = compilation._is_writable
    monkeypatch.setattr(compilation, '_is_writable', lambda f: f != folder and is_writable(f))
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(folder))
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


def test_package_without_home_keeps_its_kernels_itself(monkeypatch):
    monkeypatch.delenv('NUMBA_CACHE_DIR', raising=False)
    monkeypatch.setenv('HOME', '/proc/nohome')
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
from stavpr_ros.pipeline.operations import Localizer, RouteCloser
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
    Localizer(settings, route, extractor, SaveState()),
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
