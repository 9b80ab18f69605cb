# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The folder of maps: where it is, and which names lead into it."""

from pathlib import Path

import pytest
from stavpr_ros.errors import SettingsError
from stavpr_ros.pipeline.maps_folder import inside, maps_folder


@pytest.mark.parametrize(
    ('parameter', 'data', 'folder'),
    [
        ('', '/data', '/data/stavpr/maps'),
        ('', '', '/home/robot/.local/share/stavpr/maps'),
        ('', 'relative', '/home/robot/.local/share/stavpr/maps'),
        ('/maps', '/data', '/maps'),
    ],
)
def test_maps_folder_follows_parameter_then_xdg_then_home(parameter, data, folder, monkeypatch):
    monkeypatch.setenv('XDG_DATA_HOME', data)
    monkeypatch.setenv('HOME', '/home/robot')
    assert maps_folder(parameter) == Path(folder)


@pytest.mark.parametrize(
    'name',
    ['..', '.', '', '/etc/passwd', '../a', 'town/../../a', 'out', 'out/a', 'loop', '~/a'],
)
def test_inside_of_names_that_lead_outside_fails(name, tmp_path):
    folder = tmp_path / 'maps'
    folder.mkdir()
    (folder / 'out').symlink_to('..')
    (folder / 'loop').symlink_to('/dev/zero')
    with pytest.raises(SettingsError, match='no file in the maps folder'):
        inside(folder, name)


@pytest.mark.parametrize('name', ['a\0b', 'a\nb', '\x1b[2Ja', 'a' * 20_000])
def test_inside_of_names_that_harm_a_log_fails(name, tmp_path):
    with pytest.raises(SettingsError, match='at most 4096, none of them a control character'):
        inside(tmp_path, name)
