# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An interrupted build_map continues where it was, in memory that does not grow."""

import os
import re
from types import SimpleNamespace

import numpy as np
import pytest
from stavpr_ros.commands import map as map_command
from stavpr_ros.errors import JournalError
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import build_map, KeyframeSettings, load_map, save_map
from stavpr_ros.mapping.builder import build_journal
from stavpr_ros.mapping.journal import JournalReader
from stavpr_ros.mapping.journal_map import journal_map
from stavpr_ros.sources.frame import Frame
from test_journal import assert_equal

EXTRACTOR = FeatureExtractor('gradient')


class StopError(Exception):
    """The work is interrupted."""


@pytest.fixture
def frames(route):
    return [Frame(image, (i + 1) * 10**9, f'image {i}') for i, image in enumerate(route)]


@pytest.fixture
def poses(frames):
    poses = np.zeros((len(frames), 7))
    poses[:, 0], poses[:, 6] = np.arange(len(frames)), 1
    return poses


def until(frames, count):
    """Yield frames up to a number, and then interrupt the work."""
    yield from frames[:count]
    raise StopError


@pytest.mark.parametrize('keyframes', [None, KeyframeSettings(distance=1.5)])
def test_build_journal_interrupted_twice_gives_the_map_of_one_run(
    frames, poses, tmp_path, keyframes
):
    target, journal = tmp_path / 'route.stavpr', tmp_path / 'route.stavpr.journal'
    options = {'keyframes': keyframes, 'progress': False}
    for count in (20, 45):
        with pytest.raises(StopError):
            build_journal(until(frames, count), EXTRACTOR, target, 'drive', poses, **options)
    with JournalReader(journal) as reader:
        assert 15 <= [place.number for place in reader.places()][-1] < 45
    content = journal.read_bytes()
    journal.write_bytes(content.replace(content[-20_000:-19_991], bytes(9)))
    build_journal(frames, EXTRACTOR, target, 'drive', poses, **options)
    save_map(journal_map(journal), target)
    assert_equal(target, build_map(frames, EXTRACTOR, poses, **options))
    assert build_journal(frames, EXTRACTOR, target, 'drive', poses, **options) == journal


def test_build_journal_of_another_work_is_refused(frames, tmp_path):
    target = tmp_path / 'route.stavpr'
    with pytest.raises(StopError):
        build_journal(until(frames, 40), EXTRACTOR, target, 'drive', progress=False)
    projected = FeatureExtractor('gradient', projection=8)
    for extractor, source in ((EXTRACTOR, 'other'), (projected, 'drive')):
        with pytest.raises(JournalError, match='is of other images or options'):
            build_journal(frames, extractor, target, source, progress=False)


def test_build_journal_memory_does_not_grow_with_the_places(tmp_path):
    """Places of 6 kB, 126 MB in all."""
    n, d, memory = 20_000, 224, []
    image = np.zeros((96, 128, 3), np.uint8)

    def resident():
        with open('/proc/self/status') as file:
            return int(re.search(r'VmRSS:\s+(\d+) kB', file.read())[1]) / 1e3

    def frames():
        for i in range(n):
            if i % 1000 == 0:
                memory.append(resident())
            yield Frame(image, i, f'{i}')

    class Extractor(SimpleNamespace):
        def extract(self, images):
            strips = np.full((7, len(images), d), d**-0.5, np.float32)
            weights = np.full((7, len(images)), 7**-0.5, np.float32)
            return LocalFeatures(strips, weights, EXTRACTOR.settings, (14, 2))

    extractor = Extractor(settings=EXTRACTOR.settings, projection=None)
    journal = build_journal(frames(), extractor, tmp_path / 'x', 'drive', progress=False)
    memory.append(resident())
    place_map = journal_map(journal)
    memory.append(resident())
    save_map(place_map, tmp_path / 'map.stavpr')
    memory.append(resident())
    assert len(place_map) == n
    assert max(memory) - memory[1] < 60


def test_recover_map_of_an_interrupted_build_has_the_places_so_far(frames, tmp_path, capsys):
    target = tmp_path / 'route.stavpr'
    with pytest.raises(StopError):
        build_journal(until(frames, 40), EXTRACTOR, target, 'drive', progress=False)
    assert map_command.main(['recover', str(tmp_path / 'x')]) == 1
    assert 'name the map' in capsys.readouterr().err
    assert map_command.main(['recover', f'{target}.journal']) == 0
    places = len(load_map(target))
    assert 15 < places <= 40
    assert f'{target}: {places} places, {places} of them from' in capsys.readouterr().out
    assert os.listdir(tmp_path) == ['route.stavpr']
