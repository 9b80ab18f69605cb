# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Entry points of other packages: commands, features, stores, and one that is broken."""

import pytest
from stavpr_ros import plugins
from stavpr_ros.commands import stavpr
from stavpr_ros.errors import SettingsError, UnavailableError
from stavpr_ros.features.registry import backbone_class, kinds, settings_class
from stavpr_ros.mapping.stores import is_address, store_of

MODULE = """
from stavpr_ros.commands import Command
from stavpr_ros.features.registry import GradientSettings, Kind
from stavpr_ros.mapping.stores import Store

COMMANDS = {'hello': Command('plugged', 'greet'), 'node': Command('plugged', 'not this one')}
KIND = Kind(GradientSettings, 'stavpr_ros.features.gradient:Gradient')
STORE = Store(open_map=lambda address: address, upload=lambda *_: None)
main = lambda arguments: len(arguments)
"""
ENTRY_POINTS = """
[stavpr.commands]
plugged = plugged:COMMANDS
broken = plugged:MISSING

[stavpr.features]
plain = plugged:KIND

[stavpr.stores]
drawer = plugged:STORE
"""


@pytest.fixture
def plugged(tmp_path, monkeypatch):
    """Install a package with entry points."""
    (tmp_path / 'plugged.py').write_text(MODULE)
    info = tmp_path / 'plugged-1.0.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text('Metadata-Version: 2.1\nName: plugged\nVersion: 1.0\n')
    (info / 'entry_points.txt').write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(tmp_path)
    plugins.load.cache_clear()
    yield
    plugins.load.cache_clear()


def test_command_of_another_package_runs(plugged, capsys):
    assert stavpr.main(['hello', 'a', 'b']) == 2
    stavpr.main(['--help'])
    assert 'greet' in capsys.readouterr().out


def test_command_of_this_package_is_not_replaced(plugged):
    assert stavpr.all_commands()['node'].module == 'stavpr_ros.commands.node'


def test_broken_plugin_is_named_and_skipped(plugged, caplog):
    assert 'plugged' in plugins.load(plugins.COMMANDS)
    assert 'broken' not in plugins.load(plugins.COMMANDS)
    assert 'plug-in broken of plugged (plugged:MISSING): AttributeError' in caplog.text


def test_store_of_another_package_opens_its_scheme(plugged):
    assert is_address('drawer:socks')
    assert store_of('drawer:socks').open_map('drawer:socks') == 'drawer:socks'


def test_unknown_scheme_lists_known_ones():
    assert not is_address('drawer:socks')
    with pytest.raises(SettingsError, match=r'drawer:socks is no address.*faiss:, qdrant:'):
        store_of('drawer:socks')


@pytest.mark.parametrize('address', ['faiss:FILE', 'qdrant:FOLDER', 'qdrant+https://HOST:1/NAME'])
def test_address_without_stavpr_fleet_names_it(monkeypatch, address):
    monkeypatch.setattr(plugins, 'load', lambda group: {})
    assert is_address(address)
    with pytest.raises(UnavailableError, match=r"the package stavpr_fleet.*install '\.\[fleet\]'"):
        store_of(address)


def test_kind_of_features_of_another_package_is_listed_and_loaded(plugged):
    assert 'plain' in kinds()
    assert settings_class('plain').__name__ == 'GradientSettings'
    assert backbone_class('plain').__name__ == 'Gradient'


def test_kind_of_a_missing_package_names_it(monkeypatch):
    monkeypatch.setattr(plugins, 'load', lambda group: {})
    with pytest.raises(SettingsError, match='in the package stavpr_lab'):
        settings_class('vgg16')
    with pytest.raises(SettingsError, match=r"'teleport'.*take one of gradient"):
        settings_class('teleport')
