# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Features are in memory once: the owner is the matcher, or the loop closer."""

import ctypes
from dataclasses import replace
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
from stavpr_ros.mapping import load_map, open_map, save_map
from stavpr_ros.memory import is_aligned
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.pipeline import Pipeline, PipelineSettings, read_map
from stavpr_ros.sources.frame import ImageRecord

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'benchmarks'))

import memory

pytestmark = pytest.mark.usefixtures('one_thread')
# Resident bytes beside the features: the heap, the window, the filter and the whitening; a copy of
# the features takes more.
ALLOWANCE = 46e6
IMAGES = 20_000  # of the long run


@pytest.fixture
def path(small_map, tmp_path):
    save_map(small_map, tmp_path / 'map')
    return tmp_path / 'map'


def test_features_read_from_a_file_begin_with_a_cache_line(path):
    """So that a matcher in float32 shares them instead of making a copy."""
    assert is_aligned(load_map(path).features.strips)
    assert is_aligned(open_map(path).features.strips)


@pytest.mark.parametrize(
    ('mode', 'precision'), [('paper', 'float32'), ('robust', 'float32'), ('robust', 'int8')]
)
def test_recognizer_on_an_opened_map_matches_as_on_a_loaded_one(path, mode, precision):
    settings = RecognizerSettings(mode=mode)
    opened, loaded = (
        PlaceRecognizer(read(path), settings, 'cpu', precision) for read in (open_map, load_map)
    )
    features = load_map(path).features
    for i in range(25):
        image = features[i : i + 1]
        assert repr(opened.update(image).path) == repr(loaded.update(image).path)


@pytest.mark.parametrize('change', ['replace', 'delete'])
def test_opened_map_outlives_its_name(path, small_map, change):
    opened = open_map(path)
    if change == 'delete':
        path.unlink()
    else:
        save_map(replace(small_map, ids=('other',) * len(small_map)), path, force=True)
    assert np.array_equal(opened.features.strips, small_map.features.strips)


@pytest.mark.slow
@pytest.mark.skipif(
    not Path('/proc/self/statm').exists(), reason='resident memory is read from /proc'
)
@pytest.mark.parametrize(
    ('operation', 'mode', 'n', 'd'),
    [
        ('localization', 'robust', 5000, 1024),
        pytest.param('localization', 'paper', 5000, 1024, marks=pytest.mark.long),
        ('loop_closure', 'robust', 600, 2048),
    ],
)
def test_resident_memory_is_that_of_the_features(operation, mode, n, d):
    result = memory.measure_memory(operation, mode, 'float32', n, d)
    assert result.feature_bytes == 4 * 7 * n * d
    assert 0.9 < result.ratio < 1 + ALLOWANCE / result.feature_bytes


@pytest.mark.long
def test_memory_does_not_grow_with_the_images(path, route):
    """Settings change, the window is emptied, and candidates are listed now and then."""
    settings = PipelineSettings(mode='robust')
    pipeline = Pipeline(settings)
    pipeline.change(loaded=read_map(str(path), settings))
    messages, resident = [ImageRecord.of_image(image, 0) for image in route], []
    for number in range(IMAGES):
        if number % 1000 == 0:
            pipeline.operation.reset()
            pipeline.change(replace(settings, min_probability=0.5 + number % 7 / 100))
        pipeline.operation.process(messages[number % len(messages)], (number + 1) * 10**8)
        if number in (IMAGES // 4, IMAGES - 1):
            resident.append(memory.resident_bytes())
    assert resident[1] - resident[0] < 1000 * (IMAGES * 3 // 4)


GIVE_BACK = """
import ctypes, resource
from stavpr_ros.memory import give_back

libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]

def resident():
    return int(open('/proc/self/statm').read().split()[1]) * resource.getpagesize()

blocks = [libc.malloc(4096) for _ in range(10_000)]
for block in blocks:
    ctypes.memset(block, 1, 4096)
for block in sorted(blocks)[:-1]:  # the last one is above them
    libc.free(block)
before = resident()
give_back()
print(before - resident() > 3e7)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), 'malloc_trim'), reason='no malloc of glibc')
def test_freed_memory_below_other_memory_is_given_back():
    assert subprocess.check_output([sys.executable, '-c', GIVE_BACK], text=True) == 'True\n'
