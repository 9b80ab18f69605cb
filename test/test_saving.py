# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A recorded map is saved at the end, and no other file is overwritten; the folder of maps."""

from functools import partial
from pathlib import Path

from fixtures import route_images
import numpy as np
from pipelines import localizing, Log, process, save, settings_of
import pytest
from stavpr_ros.errors import SettingsError
from stavpr_ros.mapping import load_map, open_map, save_map, select_places
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.output_file import FileVersion
from stavpr_ros.pipeline import Pipeline, read_map, saving
from stavpr_ros.pipeline.maps_folder import inside, maps_folder
from stavpr_ros.pipeline.saving import recover_maps, save_recorded_map, write_map
from stavpr_ros.prepare import prepared_map


@pytest.fixture
def mapping(route):
    pipeline = Pipeline(settings_of(), 'mapping')
    process(pipeline, route[:7])
    return pipeline


def at_the_end(pipeline, path, on_worker=lambda function: function()):
    log = Log()
    save_recorded_map(pipeline, on_worker, str(path), log)
    return log.lines


def test_save_recorded_map_writes_unsaved_places_once(mapping, route, tmp_path):
    path = tmp_path / 'route.stavpr'
    assert at_the_end(mapping, path)[-1] == ('info', f'7 places written to {path}')
    assert len(load_map(path)) == 7
    assert at_the_end(mapping, path) == []
    process(mapping, route[7:9], first=7)
    assert at_the_end(mapping, path)[-1] == ('info', f'9 places written to {path}')  # its own file


def test_saved_map_of_a_long_recording_has_statistics(mapping, tmp_path, set_constants):
    set_constants(prepared_map, MIN_PLACES=7)
    at_the_end(mapping, tmp_path / 'route.stavpr')
    assert open_map(tmp_path / 'route.stavpr').features.statistics is not None


def test_save_recorded_map_beside_another_map_takes_a_numbered_name(mapping, route, tmp_path):
    path = tmp_path / 'route.stavpr'
    for there in (path, tmp_path / 'route-2.stavpr'):
        there.write_bytes(b'yesterday')
    assert at_the_end(mapping, path)[-1][1].endswith('route-3.stavpr')
    process(mapping, route[7:9], first=7)
    assert at_the_end(mapping, path)[-1][1].endswith('route-3.stavpr')  # its own file now
    assert path.read_bytes() == b'yesterday'
    assert len(load_map(tmp_path / 'route-3.stavpr')) == 9


def test_save_recorded_map_after_a_backup_overwrites_its_own_file(small_map, route, tmp_path):
    path = str(tmp_path / 'route.stavpr')
    save_map(small_map, path)
    pipeline = Pipeline(settings_of(), 'mapping')
    pipeline.change(loaded=read_map(path, pipeline.settings))
    save(pipeline, tmp_path / 'backup.stavpr')
    process(pipeline, route[:2])
    assert at_the_end(pipeline, path)[-1] == ('info', f'62 places written to {path}')


@pytest.mark.parametrize('operation', ['mapping', 'loop_closure'])
def test_two_recorded_laps_become_a_session_each(operation, tmp_path):
    """In the file, as the map of localization, and after a crash; a loaded map is copied."""
    path, plain, killed = (tmp_path / f'{name}.stavpr' for name in ('laps', 'plain', 'killed'))
    open_journal = partial(JournalWriter.create, killed, log=print)
    pipeline, laps = Pipeline(settings_of(), operation, open_journal), 2 * route_images(95)
    process(pipeline, laps)
    save_map(pipeline.snapshot().places, plain)
    save(pipeline, path)
    process(pipeline, laps[:2], 190)
    assert at_the_end(pipeline, path)[-1] == ('info', f'192 places written to {path}')
    process(pipeline, laps[2:3], 192)
    pipeline.change(operation='localization')
    pipeline.close_journals(delete_route=False)
    for places in (load_map(path), pipeline.places, load_map(recover_maps(killed, Log()))):
        assert abs(places.session_index.tolist().index(1) - 95) <= 2
        assert len(places.sessions) == 2
    save(localizing(str(plain)), tmp_path / 'copy')
    assert not load_map(tmp_path / 'copy').sessions


def test_save_during_the_search_for_laps_stays(mapping, tmp_path, monkeypatch):
    def divide(places):
        monkeypatch.undo()
        save(mapping, tmp_path / 'map', overwrite=True)
        return select_places(places, np.arange(3))

    monkeypatch.setattr(saving, 'with_repeats', divide)
    save(mapping, tmp_path / 'map')
    assert len(load_map(tmp_path / 'map')) == 7


def test_save_recorded_map_that_fails_logs_the_loss(mapping, tmp_path):
    lost = [('warning', 'recorded places not saved: 7; set save_path, or call ~/save_map')]
    assert at_the_end(mapping, '') == lost
    level, text = at_the_end(mapping, tmp_path / 'missing' / 'route.stavpr')[-1]
    assert (level, 'does not exist' in text) == ('error', True)
    mapping.change(operation='localization')  # the recorded map is in no file still
    assert at_the_end(mapping, '') == lost


def test_save_recorded_map_of_a_route_writes_to_save_path_only(route, tmp_path):
    path = tmp_path / 'loop.stavpr'
    pipeline = Pipeline(settings_of(), 'loop_closure')
    process(pipeline, route[:9])
    assert at_the_end(pipeline, '') == []
    at_the_end(pipeline, path)
    assert len(load_map(path)) == 9
    process(pipeline, route[9:11], first=9)
    pipeline.change(operation='localization')  # the route is the map now
    at_the_end(pipeline, path)
    assert len(load_map(path)) == 11


def test_save_recorded_map_of_a_route_keeps_the_map_of_its_features(map_file, route, tmp_path):
    pipeline = Pipeline(settings_of(), 'loop_closure')
    path = tmp_path / 'route.stavpr'
    save(localizing(map_file), path)
    pipeline.change(loaded=read_map(str(path), pipeline.settings))
    process(pipeline, route[:9])
    assert at_the_end(pipeline, path)[-1][1].endswith('route-2.stavpr')
    assert (len(load_map(path)), len(load_map(tmp_path / 'route-2.stavpr'))) == (60, 9)


def test_write_map_leaves_places_recorded_meanwhile_unsaved(mapping, route, tmp_path):
    calls = []

    def on_worker(function):
        if calls:
            process(mapping, route[7:10], first=7)
        calls.append(function)
        return function()

    path = str(tmp_path / 'route.stavpr')
    assert write_map(mapping, on_worker, path, overwrite=False) == 7
    assert (mapping.unsaved, mapping.save_state.path) == (3, path)


@pytest.mark.parametrize('another', [False, True])
def test_write_map_keeps_the_state_of_a_map_loaded_meanwhile(another, mapping, map_file, tmp_path):
    path = str(tmp_path / 'route.stavpr')

    def on_worker(function):
        result = function()
        mapping.change(operation='localization')
        if another:
            mapping.change(loaded=read_map(map_file, mapping.settings))
        return result

    write_map(mapping, on_worker, path, overwrite=False)
    assert (mapping.unsaved, mapping.save_state.path) == (0, map_file if another else path)
    version = FileVersion.of(map_file) if another else False
    assert mapping.save_state.own_version(map_file) == version


def test_mark_saved_in_any_order_counts_the_places_of_each_snapshot(mapping, route, tmp_path):
    """A service, and a transition on another thread: places after both are unsaved."""
    path = str(tmp_path / 'route.stavpr')
    snapshots = [mapping.snapshot()]
    process(mapping, route[7:9], first=7)
    snapshots.append(mapping.snapshot())
    process(mapping, route[9:10], first=9)
    for snapshot in reversed(snapshots):
        snapshot.mark_saved(path)
    assert mapping.unsaved == 1


# The folder of maps: where it is, and which names lead into it


@pytest.mark.parametrize(
    ('parameter', 'data', 'folder'),
    [
        ('', '/data', '/data/stavpr/maps'),
        ('', '', '/home/robot/.local/share/stavpr/maps'),
        ('', 'relative', '/home/robot/.local/share/stavpr/maps'),
        ('/maps', '/data', '/maps'),
    ],
)
def test_maps_folder_follows_parameter_then_xdg_then_home(parameter, data, folder, environ):
    environ |= {'XDG_DATA_HOME': data, 'HOME': '/home/robot'}
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
