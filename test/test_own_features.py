# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A kind of features of another package: a plain dataclass and a class with feature_maps."""

from dataclasses import dataclass, field, make_dataclass

import cv2
import numpy as np
import pytest
from stavpr_ros.commands import build_map
from stavpr_ros.errors import SettingsError
from stavpr_ros.features import FeatureExtractor, registry
from stavpr_ros.mapping import load_map, Map
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


def test_setting_of_a_type_that_map_files_lack_is_named(monkeypatch):
    row = 'names', dict, field(default_factory=dict)
    settings = make_dataclass('Settings', [row], frozen=True)
    monkeypatch.setitem(registry.KINDS, 'plain', registry.Kind(settings, f'{__name__}:Plain'))
    with pytest.raises(SettingsError, match='setting names of features plain'):
        identity_fields('plain')


@pytest.mark.parametrize('missing', ['settings', 'feature_maps'])
def test_class_that_lacks_a_member_is_an_error_with_its_name(monkeypatch, missing):
    whole = {'settings': PlainSettings(), 'feature_maps': Plain.feature_maps}
    members = {name: member for name, member in whole.items() if name != missing}
    incomplete = type('Incomplete', (), {'__init__': lambda *_: None, **members})
    monkeypatch.setattr(f'{__name__}.Plain', incomplete)
    with pytest.raises(SettingsError, match=f'Incomplete.* features plain, has no {missing}'):
        FeatureExtractor('plain')
