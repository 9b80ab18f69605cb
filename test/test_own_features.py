# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A kind of features of another package: a plain dataclass and a class with feature_maps."""

from dataclasses import dataclass, field, make_dataclass
import re

import cv2
import numpy as np
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.errors import JournalError, MapFileError, SettingsError
from stavpr_ros.features import FeatureExtractor, registry
from stavpr_ros.mapping import load_map, Map
from stavpr_ros.mapping.journal import Base, JournalReader
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.mapping.map_schema import identity_fields


@dataclass(frozen=True)
class PlainSettings:
    """Settings without a help, and none of those that other kinds have."""

    side: 'int' = 28
    weights: tuple[float, ...] = field(default_factory=lambda: (0.5, 2.0))


class Plain:
    """Thumbnails, in gray."""

    def __init__(self, settings: PlainSettings, device: str) -> None:
        self.settings = settings

    def feature_maps(self, images):
        side = self.settings.side
        grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
        return np.stack([cv2.resize(gray, (side, side)) for gray in grays])[:, None] / 255.0


@pytest.fixture(autouse=True)
def plain_kind(monkeypatch):
    kind = registry.Kind(PlainSettings, f'{__name__}:Plain')
    monkeypatch.setitem(registry.KINDS, 'plain', kind)


def test_kind_of_a_plain_dataclass_makes_a_map_and_has_options(tmp_path, capsys):
    rng = np.random.default_rng(0)
    images, path = tmp_path / 'images', tmp_path / 'route.stavpr'
    images.mkdir()
    for i in range(3):
        cv2.imwrite(str(images / f'{i}.png'), rng.integers(0, 255, (48, 64, 3), np.uint8))
    route = Map.from_images(images, 'plain')
    assert (len(route), route.features.dimension) == (3, 28 * 4)
    words = ['--input', str(images), '--output', str(path), '--features', 'plain']
    assert build_map.main([*words, '--plain-side', '14']) == 0
    assert load_map(path).settings.backbone == PlainSettings(14)
    assert registry.settings_from_json('plain', '{"side": 14}') == PlainSettings(14)
    with pytest.raises(SystemExit):
        build_map.main(['--help-features'])
    assert '--plain-weights' in capsys.readouterr().out


class Vector(Plain):
    """One vector an image."""

    def feature_maps(self, images):
        return super().feature_maps(images).reshape(len(images), -1)


Bare = type('Bare', (), {'__init__': lambda self, settings, device: None})
Narrow = type('Narrow', (), {'__init__': lambda self, settings: None})


def test_kind_of_one_vector_has_one_strip(monkeypatch, route):
    kind = registry.Kind(PlainSettings, f'{__name__}:Vector')
    monkeypatch.setitem(registry.KINDS, 'plain', kind)
    place_map = Map.from_images(route[:3], 'plain')
    assert place_map.features.strips.shape == (1, 3, 28 * 28)
    with pytest.raises(SettingsError, match='leave both out'):
        FeatureExtractor('plain', strips=7).extract(route[:1])


@pytest.mark.parametrize(
    ('name', 'lack'),
    [('Bare', 'lacks settings, feature_maps'), ('Narrow', r'lacks the arguments \(settings, dev')],
)
def test_class_that_is_no_backbone_is_named(monkeypatch, name, lack):
    kind = registry.Kind(PlainSettings, f'{__name__}:{name}')
    monkeypatch.setitem(registry.KINDS, 'plain', kind)
    with pytest.raises(SettingsError, match=f'{name} of features plain {lack}'):
        FeatureExtractor('plain')


def test_sound_map_of_another_package_or_version_is_not_called_damaged(
    monkeypatch, route, tmp_path
):
    (place_map := Map.from_images(route[:3], 'plain')).save(path := tmp_path / 'map')
    (journal := JournalWriter.create(path, Base(), place_map, print)).close()
    older = make_dataclass('Settings', [('side', int, 28)], frozen=True)
    for kind, reason in (
        ({'plain': registry.Kind(older, f'{__name__}:Plain')}, "have the unknown 'weights'"),
        ({}, "features 'plain' are unknown: install the package"),
    ):
        monkeypatch.delitem(registry.KINDS, 'plain')
        registry.KINDS.update(kind)
        with pytest.raises(MapFileError, match=f'{reason}.*install or update') as caught:
            load_map(path)
        assert not re.search('damaged|backup', str(caught.value))
        with pytest.raises(JournalError, match=f'^map .*{reason}.*update it$'):
            JournalReader(journal.path)


def test_setting_of_a_type_that_map_files_lack_is_named(monkeypatch):
    row = 'names', dict, field(default_factory=dict)
    settings = make_dataclass('Settings', [row], frozen=True)
    monkeypatch.setitem(registry.KINDS, 'plain', registry.Kind(settings, f'{__name__}:Plain'))
    with pytest.raises(SettingsError, match='setting names of features plain'):
        identity_fields('plain')
