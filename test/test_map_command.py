# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command map: merging maps into sessions, and projecting them."""

from contextlib import suppress
from dataclasses import replace
import math
import os
import sys

import cv2
from map_examples import example_map
from map_files import parts_of, version2
import numpy as np
from places import poses_at
import pytest
from stavpr_ros.commands import map as map_command
from stavpr_ros.commands.map import main
from stavpr_ros.commands.program import until_unread
from stavpr_ros.errors import FeatureMismatchError, InputError, SettingsError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.maintenance.near_duplicates import without_duplicates
from stavpr_ros.mapping import build_map as map_of
from stavpr_ros.mapping import (
    GrowingMap,
    load_map,
    Map,
    merge_maps,
    open_map,
    save_map,
    select_places,
    select_session,
)
from stavpr_ros.mapping.reduction import with_principal_components
from stavpr_ros.sources.frame import Frame


@pytest.fixture(scope='module')
def drive():
    """Return a map of one drive, without sessions."""
    return replace(example_map(), sessions=(), session_index=None)


@pytest.fixture
def folder(drive, working_folder):
    """Change into a folder with maps of two drives."""
    save_map(drive, 'day.stavpr')
    night = replace(drive, poses=None, thumbnails=(), ids=('',) * len(drive))
    save_map(night, 'night.stavpr')
    return working_folder


def test_map_info_shows_what_a_map_holds(folder, capsys):
    both, date = example_map(), 1_700_000_000 * 10**9
    sessions = replace(both.sessions[0], start=date), *both.sessions[1:]
    both = replace(both, threshold=0.25)
    stamps = np.where(both.stamps, both.stamps + date, 0)
    save_map(replace(both, sessions=sessions, stamps=stamps), 'both.stavpr')
    assert main(['info', 'both.stavpr']) == 0
    shown = capsys.readouterr().out
    for text in (
        'format version 2', '24, 23 with a pose, 24 with an identifier',
        'gradient, version 1: 2 strips of 32 dimensions, float32',
        open_map('both.stavpr').map_id, 'session    a, morning, robot 1: 12 places, 2023-11-14',
        'a route of 23 m', 'to 2023-11-14 22:13:44 UTC',
    ):  # fmt: skip
        assert text in shown
    assert not {'threshold', 'paper'} & set(shown.replace(',', '').split())
    save_map(both, 'both.stavpr', force=True)  # its stamps are no dates
    assert main(['info', 'both.stavpr']) == 0
    shown = capsys.readouterr().out
    assert 's to 24.0 s\n' in shown
    assert '1970' not in shown


def test_map_info_escapes_control_characters(folder, capsys):
    both, escape = example_map(), '\x1b[2J'
    sessions = replace(both.sessions[0], name=escape, robot='r\n'), *both.sessions[1:]
    save_map(replace(both, sessions=sessions), 'both.stavpr')
    assert main(['info', 'both.stavpr']) == 0
    shown = capsys.readouterr().out
    assert r'session    a, \x1b[2J, r\n: 12 places' in shown
    assert escape not in shown
    manifest, tensors = parts_of((folder / 'both.stavpr').read_bytes())
    del manifest['parts']
    tensors[escape] = tensors['stamps']
    (folder / 'bad.stavpr').write_bytes(version2(manifest, tensors))
    assert main(['info', 'bad.stavpr']) == 1
    shown = capsys.readouterr().err
    assert r'part \x1b[2J is unknown' in shown
    assert escape not in shown


def test_names_of_any_characters_harm_no_terminal(folder, drive, capsys):
    name = '\x1b[2J\n[ERROR] \udcff.stavpr'
    save_map(drive, name)
    for arguments in (['info'], ['verify'], ['verify', 'missing' + name], ['--' + name]):
        with suppress(SystemExit):
            main([*arguments, name])
        shown = ''.join(capsys.readouterr())
        assert r'\x1b[2J\n[ERROR] \udcff.stavpr' in shown
        assert '\x1b' not in shown
        assert '\n[ERROR]' not in shown


def test_command_whose_reader_has_ended_ends_quietly(monkeypatch, capsys):
    for ends in (lambda: None, sys.exit):  # after --help
        reader, writer = os.pipe()
        os.close(reader)
        with open(writer, 'w') as output:
            monkeypatch.setattr(sys, 'stdout', output)
            assert until_unread(lambda ends=ends: (print('a line'), ends())) == 141
            output.write('more\n')
            output.flush()


@pytest.mark.parametrize('name', ['both.stavpr', 'night.stavpr'])
def test_map_info_plots_a_map_with_and_without_poses(folder, name):
    save_map(example_map(), 'both.stavpr')
    assert main(['info', name, '--plot', 'map.png']) == 0
    image = cv2.imread('map.png')
    assert image.shape == (1110, 1950, 3)
    assert len(np.unique(image)) > 100
    assert main(['info', name, '--plot', 'map.png']) == 1
    assert main(['info', name, '--plot', 'map.png', '--force']) == 0
    assert main(['info', name, '--plot', name, '--force']) == 1


def test_map_compact_prints_what_it_drops(folder, drive, capsys):
    assert main(['compact', 'day.stavpr', 'small.stavpr', '--drop-thumbnails']) == 0
    shown = capsys.readouterr().out
    assert 'thumbnails of 0.0 MB dropped' in shown
    assert 'features: float32 becomes float16' in shown
    small = load_map('small.stavpr')
    assert (len(small), small.features.strips.dtype, small.thumbnails) == (24, np.float32, ())
    assert open_map('small.stavpr').features.storage == 'float16'
    assert main(['compact', 'day.stavpr', 'same', '--storage', 'float32']) == 0
    assert open_map('same').map_id == open_map('day.stavpr').map_id
    stops = np.array([0, *[1] * 9, *range(2, 24), *[23] * 5])
    standing = replace(select_places(drive, stops), poses=None)
    twice = merge_maps([standing, standing], ['day', 'night'])
    same_as = np.arange(len(twice), dtype=np.int32)
    same_as[len(stops) + 8] = 5  # both sessions stop at one place
    save_map(replace(twice, same_as=same_as), 'stops.stavpr')
    assert main(['compact', 'stops.stavpr', 'driven.stavpr', '--drop-duplicates']) == 0
    assert '26 of 74 places dropped' in capsys.readouterr().out
    driven = load_map('driven.stavpr')
    assert driven.ids == drive.ids + drive.ids
    assert [session.id for session in driven.sessions] == ['day', 'night']


def test_duplicates_where_the_robot_moved_are_kept(drive):
    stops = np.array([0, *[1] * 9, *range(2, 24)])
    dark = select_places(drive, stops)
    poses = poses_at(range(len(stops)))
    assert len(without_duplicates(replace(dark, poses=poses))) == len(stops)
    poses[2:6, 0] = poses[1, 0] + 0.02
    assert len(without_duplicates(replace(dark, poses=poses))) == len(stops) - 4


def test_map_verify_names_the_damaged_ones(folder, capsys):
    assert main(['verify', 'day.stavpr', 'night.stavpr']) == 0
    content = bytearray((folder / 'night.stavpr').read_bytes())
    content[-1] ^= 1
    (folder / 'night.stavpr').write_bytes(content)
    assert main(['verify', 'day.stavpr', 'night.stavpr', 'missing']) == 1
    shown = capsys.readouterr()
    assert 'day.stavpr: sound, 24 places' in shown.out
    assert 'night.stavpr is damaged: bytes' in shown.err
    assert 'missing does not exist' in shown.err


def test_map_replaces_nothing_unasked(folder, capsys):
    before = (folder / 'night.stavpr').read_bytes()
    assert main(['compact', 'day.stavpr', 'night.stavpr']) == 1
    assert 'night.stavpr exists already' in capsys.readouterr().err
    assert main(['merge', 'day.stavpr', 'day.stavpr', 'night.stavpr', '--force']) == 2
    assert 'is also an input' in capsys.readouterr().err
    assert (folder / 'night.stavpr').read_bytes() == before
    assert main(['compact', 'day.stavpr', 'night.stavpr', '--force']) == 0
    assert main(['compact', 'missing', 'new']) == 1
    assert not (folder / 'new').exists()


def test_damaged_map_is_not_compacted(folder, drive, capsys):
    content = (folder / 'day.stavpr').read_bytes()
    first = drive.features.strips.tobytes()[:64]
    (folder / 'day.stavpr').write_bytes(content.replace(first, first[:-1] + b'\0'))
    for action in (['compact', 'day.stavpr', 'new'], ['merge', 'new', 'day.stavpr']):
        assert main(action) == 1
        assert 'do not match their hash' in capsys.readouterr().err
    assert not (folder / 'new').exists()


def test_merged_drives_are_sessions_that_can_be_taken_out_again(folder, drive, capsys):
    assert main(['merge', 'both.stavpr', 'day.stavpr', 'night.stavpr', 'day.stavpr']) == 0
    both = load_map('both.stavpr')
    assert [session.id for session in both.sessions] == ['day', 'night', 'day-2']
    assert both.sessions[0].start == drive.stamps[0]
    assert both.session_index.tolist() == [0] * 24 + [1] * 24 + [2] * 24
    assert both.same_as[48:].tolist() == list(range(24))  # the same drive again
    assert main(['info', 'both.stavpr']) == 0
    assert 'session    day: 24 places\n' in (shown := capsys.readouterr().out)
    assert ' day-2, day: 24 places, 24 show places of earlier sessions' in shown
    apart = ['merge', 'apart.stavpr', 'day.stavpr', 'night.stavpr', '--different-routes']
    assert main(apart) == 0
    assert load_map('apart.stavpr').same_as is None
    assert np.array_equal(both.features[24:48].strips, drive.features.strips)
    assert (both.pose(5) is not None, both.pose(30)) == (True, None)
    assert (both.thumbnail(30), both.ids[30], both.ids[50]) == (None, '', 'place 2')
    assert main(['sessions', 'both.stavpr', 'night', '--keep', 'night']) == 0
    assert main(['sessions', 'both.stavpr', 'days', '--remove', 'night']) == 0
    night, days = load_map('night'), load_map('days')
    assert [session.id for session in night.sessions] == ['night']
    assert [session.id for session in days.sessions] == ['day', 'day-2']
    assert days.session_index.tolist() == [0] * 24 + [1] * 24
    assert np.array_equal(days.features[24:].strips, drive.features.strips)
    assert merge_maps([days, night], ['', '']).session(70).id == 'night'
    assert main(['sessions', 'both.stavpr', 'x', '--keep', 'dusk']) == 1


def test_maps_of_names_that_are_no_utf8_are_merged(folder):
    name = os.fsdecode(b'caf\xe9')
    os.rename('day.stavpr', f'{name}.stavpr')
    assert main(['merge', f'{name}2.stavpr', f'{name}.stavpr', 'night.stavpr']) == 0
    sessions = load_map(f'{name}2.stavpr').sessions
    assert [session.name for session in sessions] == ['caf\ufffd', 'night']


def test_maps_of_several_cameras_are_one(folder, capsys):
    merge = ['merge', 'both.stavpr', 'day.stavpr', 'night.stavpr', '--different-routes']
    for text in ('front:x', ':90', 'front:inf', 'x' * 65):
        assert main([*merge, '--cameras', text, 'rear']) == 2
        assert 'expected NAME or NAME:DEGREES' in capsys.readouterr().err
    assert main([*merge, '--cameras', 'front', 'rear:540']) == 0
    front, rear = load_map('both.stavpr').sessions
    assert (front.camera, front.yaw, rear.camera) == ('front', None, 'rear')
    assert abs(rear.yaw) == pytest.approx(math.pi)
    assert main(['info', 'both.stavpr']) == 0
    shown = capsys.readouterr().out
    assert 'camera front: 24 places' in shown
    assert '180 degrees: 24 places' in shown


def test_recording_behind_a_map_with_sessions_is_another_session(drive):
    growing = GrowingMap.from_map(merge_maps([drive, drive], ['day', 'recorded-1']), 100)
    assert [session.id for session in growing.snapshot().sessions] == ['day', 'recorded-1']
    for i in range(3):
        growing.add(drive.features[i : i + 1], stamp=7 * 10**9)
    snapshot = growing.snapshot()
    assert [session.id for session in snapshot.sessions] == ['day', 'recorded-1', 'recorded-2']
    assert (snapshot.session(50).id, snapshot.session(50).start) == ('recorded-2', 7 * 10**9)


def test_maps_that_do_not_fit_are_not_merged(drive):
    other = example_map(projection=16)
    with pytest.raises(FeatureMismatchError, match='the first map'):
        merge_maps([drive, other], ['a', 'b'])
    with pytest.raises(InputError, match='no maps'):
        merge_maps([], [])
    with pytest.raises(InputError, match='no place is left'):
        select_session(merge_maps([drive], ['a']), 'a', keep=False)


# Projection of a map to its principal components: by hand, in files, when the map grows

D = 6
pytestmark = pytest.mark.usefixtures('one_thread')


def images(count):
    rng = np.random.default_rng(0)
    wide = cv2.blur(rng.integers(0, 256, (48, 48 + 8 * count, 3), np.uint8), (5, 5))
    return [np.ascontiguousarray(wide[:, 8 * i : 8 * i + 48]) for i in range(count)]


@pytest.fixture(scope='module')
def whole():
    frames = [Frame(image, 0, str(i)) for i, image in enumerate(images(30))]
    return map_of(frames, FeatureExtractor('gradient'), thumbnails=False, progress=False)


@pytest.mark.parametrize('count', [30, 40])
def test_directions_are_those_of_largest_variance(count):
    """Of 7 strips each, fewer and more than their 224 dimensions."""
    frames = [Frame(image, 0, str(i)) for i, image in enumerate(images(count))]
    whole = map_of(frames, FeatureExtractor('gradient'), thumbnails=False, progress=False)
    assert (7 * count < whole.dimension) == (count == 30)
    reduced = with_principal_components(whole, D)
    x = whole.features.strips.astype(np.float64)
    centered = (x - x.mean(axis=1, keepdims=True)).reshape(-1, x.shape[2])
    _, _, directions = np.linalg.svd(centered, full_matrices=False)
    matrix = reduced.projection.matrix
    np.testing.assert_allclose(matrix @ matrix.T, directions[:D].T @ directions[:D], atol=1e-4)
    projected = x @ matrix
    projected /= np.linalg.norm(projected, axis=2, keepdims=True)
    np.testing.assert_allclose(reduced.features.strips, projected, atol=1e-5)


def test_more_directions_than_a_third_of_the_strips_are_rejected(whole):
    few = select_places(whole, np.arange(3))
    assert with_principal_components(few, 7).dimension == 7
    with pytest.raises(SettingsError, match=r'^8 principal .* 21 strips .* at most 7'):
        with_principal_components(few, 8)


@pytest.mark.parametrize('before', [[], [12]])
def test_query_of_reduced_map_is_projected_as_its_places(whole, before):
    """Also where one reduction follows another."""
    reduced = whole
    for dimension in (*before, D):
        reduced = with_principal_components(reduced, dimension)
    assert reduced.projection.matrix.shape == (whole.dimension, D)
    query = reduced.extractor().extract(images(30)[7:8])
    query.require_same_settings(reduced.settings, 'the map')
    np.testing.assert_allclose(query.strips[:, 0], reduced.features.strips[:, 7], atol=1e-4)
    growing = GrowingMap.from_map(reduced, 100)
    growing.add(query)
    assert len(growing) == 31
    assert growing.projection.identity == reduced.projection.identity


@pytest.mark.parametrize('dimension', [0, -1, 224, 300])
def test_reduction_to_other_dimension_is_rejected(whole, dimension):
    with pytest.raises(SettingsError, match=f'^{dimension} principal .* of 224 dimensions'):
        with_principal_components(whole, dimension)


def test_compact_reduces_map_to_principal_components(whole, tmp_path, capsys):
    saved, compact, smaller = (str(tmp_path / name) for name in ('whole', 'compact', 'smaller'))
    save_map(whole, saved)
    assert map_command.main(['compact', saved, compact, '--pca', f'{D}']) == 0
    result = load_map(compact)
    assert isinstance(result, Map)
    assert result.features.strips.shape == (7, 30, D)
    assert result.projection.name == f'principal components 224 -> {D} of 30 places'
    assert map_command.main(['compact', compact, smaller, '--pca', '4']) == 0
    assert load_map(smaller).dimension == 4
    assert 'strips of 6 dimensions become 4' in capsys.readouterr().out
