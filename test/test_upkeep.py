# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What drives teach a map, what is removed from it, and the versions of its file."""

from dataclasses import replace
import os
from pathlib import Path
import signal
import subprocess
import sys

from evaluation_commands import write_images
from fixtures import route_images
import numpy as np
import pytest
from stavpr_ros.commands.map import main
from stavpr_ros.errors import InputError, OutputError, StavprError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.mapping import (
    build_map,
    builder,
    load_map,
    merge_maps,
    save_map,
    select_places,
    versions,
)
from stavpr_ros.mapping.merging import keep_places
from stavpr_ros.mapping.versions import current_version, roll_back, save_version, Version
from stavpr_ros.output_file import FileVersion
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings, upkeep
from stavpr_ros.recognition.same_places import with_seam
from stavpr_ros.recognition.upkeep import MIN_MISSED, update_map, UpkeepSettings
from stavpr_ros.sources.frame import Frame

pytestmark = pytest.mark.usefixtures('one_thread')
ROUTE, OTHER, BYPASS = (route_images(count, seed) for count, seed in ((200, 0), (120, 5), (70, 9)))
BYPASS_STAMPS = 20_081 * 10**9, 20_150 * 10**9
SETTINGS = UpkeepSettings(max_places=350, max_age=3)  # no room for a whole drive


def built(images, day=0, poses=None, thumbnails=False):
    """Return the map of a drive, with noise of its own."""
    dice = np.random.default_rng(day)
    frames = [
        Frame(
            np.clip(image + 3.0 * dice.standard_normal(image.shape), 0, 255).astype(np.uint8),
            (day * 10_000 + i + 1) * 10**9,
            '',
        )
        for i, image in enumerate(images)
    ]
    return build_map(frames, FeatureExtractor('gradient'), poses, thumbnails, progress=False)


@pytest.fixture(scope='module')
def first():
    poses = np.zeros((len(ROUTE), 7))
    poses[:, 0], poses[:, 6] = np.arange(len(ROUTE)), 1
    return built(ROUTE, poses=poses)


@pytest.fixture(scope='module')
def rebuilt():
    """Return a drive on which 60 places look otherwise."""
    return built([*ROUTE[:80], *OTHER[:60], *ROUTE[140:]], 1)


@pytest.fixture(scope='module')
def around():
    """Return a drive that leaves the map at place 80, and comes back at 90."""
    poses = np.zeros((240, 7))
    poses[:, 1], poses[:, 6] = np.arange(240), 1  # of another frame
    return built([*ROUTE[:80], *BYPASS, *ROUTE[90:180]], 2, poses)


def updated(place_map, drive, version=None, name='drive', settings=SETTINGS):
    version = version or Version('', base_places=len(place_map))
    return update_map(place_map, drive, name, version, settings)


def recall(place_map, drive):
    recognizer = PlaceRecognizer(place_map, RecognizerSettings())
    matches = [recognizer.update(drive.features[i : i + 1]) for i in range(len(drive))]
    return np.mean([match.accepted for match in matches])


def test_drive_like_the_map_changes_the_use_of_its_places_only(first):
    place_map, version = updated(first, built(ROUTE[20:180], 1))
    assert len(place_map) == len(first)
    assert place_map is first
    assert version.use[100] > version.use[5] == 0.9
    assert set(version.missed) == {0}
    unchanged = 'nothing is added, the map stays as it is'
    assert version.changes == ('certain of 100% of 160 images', unchanged)


def test_stretch_that_looks_otherwise_becomes_an_experience(first, rebuilt):
    place_map, version = updated(first, rebuilt)
    added = np.arange(200, len(place_map))
    assert 60 <= len(added) <= 100
    assert [session.id for session in place_map.sessions] == ['first', 'drive']
    assert (place_map.session_index[200:] == 1).all()
    related = place_map.same_as[added]
    assert (np.diff(related) >= 0).all()
    assert related.min() >= 60
    assert related.max() <= 160
    assert [place_map.ids[i] for i in added] == [str(i) for i in related]
    np.testing.assert_array_equal(place_map.poses[added], first.poses[related])
    assert any('experience' in text for text in version.changes)
    again = built([*ROUTE[:80], *OTHER[:60], *ROUTE[140:]], 3)
    assert recall(place_map, again) > recall(first, again) + 0.1
    stays, _ = updated(place_map, again, version)
    assert len(stays) <= len(place_map)  # it is known now


def test_detour_joins_the_map_as_a_stretch_of_its_own(first, around):
    place_map, version = updated(first, around)
    own = np.flatnonzero(place_map.same_as[200:] == np.arange(200, len(place_map)))
    assert 60 <= len(own) <= 75
    assert any('detour' in text for text in version.changes)
    ids = [place_map.ids[200 + i] for i in own]
    assert len(set(ids)) == len(ids)
    assert all(each.startswith('drive/') for each in ids)
    poses = place_map.poses[200 + own]  # by odometry from where the drive left the map
    np.testing.assert_allclose(poses[:, 0], poses[0, 0], atol=1e-6)
    np.testing.assert_allclose(np.diff(poses[:, 1]), 1, atol=1e-6)
    assert recall(place_map, built([*ROUTE[60:80], *BYPASS, *ROUTE[90:120]], 4)) > 0.8


def test_drive_is_kept_whole_where_there_is_room(first, rebuilt):
    room = UpkeepSettings(max_places=400)
    place_map, version = updated(first, rebuilt, settings=room)
    assert version.changes[1:] == ('added the drive, 200 images',)
    assert len(place_map) == 400
    assert [session.id for session in place_map.sessions] == ['first', 'drive']
    shown = place_map.same_as[200:] < 200
    np.testing.assert_allclose(place_map.same_as[200:][shown], np.flatnonzero(shown), atol=2)
    assert shown[:80].all()
    assert shown[145:].all()
    assert not shown[95:125].any()  # looks otherwise: no place of the map
    assert len(updated(first, rebuilt, settings=UpkeepSettings(precision='int8'))[0]) == 400
    assert len(updated(first, rebuilt, settings=UpkeepSettings())[0]) < 300  # in float32
    dense = Version('', base_places=90)  # of a route with less than half as many places as images
    assert len(updated(first, rebuilt, dense, settings=room)[0]) < 300
    short = built(ROUTE[40:130], 4)  # less than half of the route
    assert len(updated(first, short, settings=room)[0]) == 200
    part = built(ROUTE[50:155], 4)  # no room for one more session of the route
    assert len(updated(first, part, settings=UpkeepSettings(max_places=350))[0]) == 200


def test_first_and_last_drives_stay_where_there_is_room(first, rebuilt, around):
    room, place_map, version = UpkeepSettings(max_places=600), first, None
    for day, drive in enumerate((rebuilt, built(ROUTE, 3), around, built(ROUTE, 4)), 1):
        place_map, version = updated(place_map, drive, version, f'day {day}', room)
        assert len(place_map) <= 600
    starts = [int(stamp) // 10**13 for stamp in place_map.stamps]
    assert starts.count(0) == 200
    assert starts.count(4) == 200
    assert starts.count(3) == 0  # the oldest one but the first
    bypass = [BYPASS_STAMPS[0] <= stamp <= BYPASS_STAMPS[1] for stamp in place_map.stamps]
    assert sum(bypass) > 50  # there are no other places of it
    last = np.flatnonzero(np.array(starts) == 4)
    np.testing.assert_allclose(place_map.same_as[last], np.arange(200), atol=2)


def numbers_of(place_map):
    """Return the numbers of the places of the first drive that a map still has."""
    return {int(stamp // 10**9) - 1 for stamp in place_map.stamps if stamp < 10_000 * 10**9}


def test_stretch_that_vanished_is_renewed_after_max_age_drives(first, rebuilt):
    place_map, version = updated(first, rebuilt)
    before = len(place_map)
    for day in (3, 4):  # the drive that was learned from passed the stretch as well
        assert numbers_of(place_map) == set(range(200))
        drive = built([*ROUTE[:80], *OTHER[:60], *ROUTE[140:]], day)
        place_map, version = updated(place_map, drive, version)
    assert any('renewed' in text for text in version.changes)
    assert not numbers_of(place_map) & set(range(80, 140))
    assert numbers_of(place_map) >= set(range(40)) | set(range(180, 200))
    assert len(place_map) == before
    assert set(version.missed[80:140]) == {0}
    assert place_map.ids[:200] == tuple(map(str, range(200)))
    np.testing.assert_array_equal(place_map.poses[:200], first.poses)
    new = np.flatnonzero(place_map.stamps[:200] > 10_000 * 10**9)
    seconds = place_map.stamps[new] // 10**9 - 40_000 - 1
    np.testing.assert_allclose(seconds, new, atol=2)  # each place has the image of its own
    only_first = select_places(place_map, np.arange(200))
    assert recall(only_first, built([*ROUTE[:80], *OTHER[:60], *ROUTE[140:]], 9)) > 0.85


def test_vanished_stretch_is_renewed_over_the_seam_of_a_closed_route():
    place_map, version = with_seam(built([*ROUTE, *ROUTE[:45]])), None
    assert place_map.seam == 44
    place_map, version = updated(place_map, built([*ROUTE[60:], *ROUTE, *ROUTE[:40]], 1))
    assert version.changes[0] == 'certain of 100% of 380 images'  # it knows where it is
    assert 'nothing is added' in version.changes[1]
    lap = [*OTHER[:30], *ROUTE[30:170], *OTHER[30:60]]
    for day in range(2, 5):
        place_map, version = updated(place_map, built([*lap[60:], *lap[:130]], day), version)
        if day == 2:
            assert [text[:19] for text in version.changes[1:]] == ['added an experience']
            related = place_map.same_as[245:]
            assert related[0] > 140
            assert (related >= 160).sum() > 30
            assert (related < 45).sum() > 30  # places of the same road behind the seam
    new = place_map.stamps // 10**9 > 40_000
    assert new[:30].all()
    assert new[170:230].all()  # also where the end shows the start
    assert not new[60:130].any()


def test_vanished_stretch_gets_no_images_of_the_road_around_it(first, around):
    place_map, version = updated(first, around)
    missed = np.zeros(len(place_map), np.int64)
    missed[78:92] = 9
    version = replace(version, missed=tuple(missed.tolist()))
    again = built([*ROUTE[:80], *BYPASS, *ROUTE[90:180]], 3)
    place_map, _ = updated(place_map, again, version)
    assert numbers_of(place_map) == set(range(200))


def test_vanished_stretch_stays_where_no_other_session_shows_all_of_it(first, rebuilt):
    missed = np.where(np.isin(np.arange(200), np.arange(80, 140)), 9, 0)
    version = Version('', base_places=200, use=(1.0,) * 200, missed=tuple(missed.tolist()))
    place_map, _ = updated(first, rebuilt, version)
    assert len(place_map) > 240
    assert numbers_of(place_map) == set(range(200))


def test_fewer_missed_places_than_a_stretch_stay(first):
    missed = np.zeros(200, np.int64)
    missed[50 : 50 + MIN_MISSED - 1] = 10
    version = Version('', base_places=200, use=(1.0,) * 200, missed=tuple(missed.tolist()))
    drive = built(ROUTE[100:190], 1)
    assert len(updated(first, drive, version)[0]) == 200


def test_map_stays_within_its_budget_and_keeps_what_helps(first, rebuilt, around):
    settings = UpkeepSettings(max_places=250)
    place_map, version = updated(first, rebuilt, settings=settings)
    assert len(place_map) <= 250
    assert any('helped least' in text for text in version.changes)
    place_map, version = updated(place_map, around, version, settings=settings)
    assert len(place_map) <= 250
    assert recall(place_map, built(ROUTE, 7)) > 0.7


@pytest.mark.parametrize(
    ('images', 'reason'),
    [
        (OTHER, 'are certain where they are'),
        ([np.ascontiguousarray(image[:, ::-1]) for image in ROUTE], 'are certain where they are'),
        ([*ROUTE[100:180], *ROUTE[10:90]], 'cannot both be right'),
        (ROUTE[:30], 'are certain where they are'),
    ],
    ids=['another route', 'mirrored', 'wrong start', 'short'],
)
def test_drive_that_may_be_wrong_teaches_nothing(first, images, reason):
    split = keep_places(first, np.r_[0:98, 103:200])  # of two sessions
    twice = replace(first, same_as=np.r_[0:51, 50, 52:200].astype(np.int32))  # is not closed
    for place_map in (first, split, twice):
        with pytest.raises(InputError, match=reason):
            updated(place_map, built(images, 1))


@pytest.mark.parametrize(
    ('shift', 'is_possible'), [(9, True), (12, False), (-5, True), (-9, False)]
)
def test_certain_images_must_be_as_near_as_a_camera_moves(first, monkeypatch, shift, is_possible):
    def drives(*arguments):
        driven = drive_on(*arguments)
        places = driven.places.copy()
        places[100:] = np.where(places[100:] >= 0, places[100:] + shift, -1)
        places[99] = -1  # so that there are two images from 98 to 100
        return replace(driven, places=places)

    drive_on = upkeep._drive
    monkeypatch.setattr(upkeep, '_drive', drives)
    if is_possible:
        updated(first, built(ROUTE[:180], 1))
    else:
        with pytest.raises(InputError, match='images 98 and 100'):
            updated(first, built(ROUTE[:180], 1))


def test_drive_whose_thumbnails_fit_other_places_teaches_nothing():
    drive, place_map = built(ROUTE, 1, thumbnails=True), built(ROUTE, thumbnails=True)
    assert len(updated(place_map, drive)[0]) == 200
    shifted = drive.thumbnails[100:] + drive.thumbnails[:100]
    mirrored = built([np.ascontiguousarray(image[:, ::-1]) for image in ROUTE], 1, thumbnails=True)
    for wrong in (shifted, mirrored.thumbnails):
        with pytest.raises(InputError, match='thumbnails'):
            updated(place_map, replace(drive, thumbnails=wrong))


def test_places_left_out_end_their_session(first):
    places = np.r_[0:50, 52:55, 100:200]
    chosen = keep_places(first, places)
    assert [session.id for session in chosen.sessions] == ['first', 'first-2']
    assert np.bincount(chosen.session_index).tolist() == [50, 100]
    assert keep_places(first, np.arange(10, 60)).sessions == ()
    with pytest.raises(InputError, match='no place is left'):
        keep_places(first, np.arange(5))


def test_places_that_are_the_same_stay_so_without_the_first_of_them(first):
    three = merge_maps([select_places(first, np.arange(20))] * 3, 'abc')
    three = replace(three, same_as=np.tile(np.arange(20, dtype=np.int32), 3))
    chosen = select_places(three, np.arange(20, 60))
    assert chosen.same_as.tolist() == [*range(20), *range(20)]


# --------------------------------------------------------------------------------------- versions


@pytest.fixture
def path(first, tmp_path):
    path = tmp_path / 'route.stavpr'
    save_map(first, path)
    return path


@pytest.fixture
def drives(rebuilt, around, tmp_path):
    files = [tmp_path / 'rebuilt.stavpr', tmp_path / 'around.stavpr']
    for file, drive in zip(files, (rebuilt, around), strict=True):
        save_map(drive, file)
    return [str(file) for file in files]


@pytest.mark.parametrize('length', [0, 1000])
def test_damaged_version_is_kept_anew_from_the_map(first, path, length):
    """A battery that was pulled cut the copy of the present version, which the map still is."""
    before, history = current_version(path), Path(f'{path}.history')
    history.mkdir()
    old = history / f'{before.map_id}.stavpr'
    old.write_bytes(path.read_bytes()[:length])
    smaller = keep_places(first, np.arange(20))
    save_version(path, FileVersion.of(path), smaller, before, before, None)
    assert (len(load_map(path)), len(load_map(old))) == (20, len(first))


@pytest.mark.parametrize('name', ['', '/{}.stavpr'])
def test_history_that_cannot_be_written_leaves_the_map(first, path, name):
    before, content = current_version(path), path.read_bytes()
    blocked = Path(f'{path}.history{name.format(before.map_id)}')
    blocked.parent.mkdir(exist_ok=True)
    (blocked / 'file').mkdir(parents=True) if name else blocked.touch()
    with pytest.raises(OutputError, match=r'history cannot be written .*: .* is untouched'):
        save_version(path, FileVersion.of(path), first, before, before, None)
    assert path.read_bytes() == content


def test_update_log_and_rollback(path, drives, capsys):
    ids = [load_map(path).map_id]
    for drive in drives:
        assert main(['update', str(path), drive]) == 0
        ids.append(load_map(path).map_id)
    assert len(set(ids)) == 3
    assert '\nadded a' in capsys.readouterr().out
    assert main(['log', str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:16] for line in lines if not line.startswith(' ')] == ids[::-1]
    assert any('a detour' in line for line in lines)
    assert current_version(path).number == 2
    assert main(['rollback', str(path)]) == 0
    assert load_map(path).map_id == ids[1]
    assert main(['rollback', str(path), '--to', ids[0]]) == 0
    assert load_map(path).map_id == ids[0]
    assert main(['rollback', str(path)]) == 1
    assert main(['update', str(path), drives[0]]) == 0
    assert load_map(path).map_id == ids[1]  # the same again, to the last bit


def test_update_in_int8_keeps_the_drive(path, drives):
    assert main(['update', str(path), drives[0], '--precision', 'int8']) == 0
    assert len(load_map(path)) == 400


def test_update_without_other_places_keeps_the_version_before(path, first):
    before = current_version(path)
    for day in (1, 1):
        opened, place_map = FileVersion.of(path), replace(first, stamps=first.stamps + day)
        version = Version('', use=(float(day),) * 200)
        save_version(path, opened, place_map, current_version(path), version, None)
    assert [each.number for each in versions.versions(path)] == [2, 0]
    assert roll_back(path).map_id == before.map_id


def test_poisoned_drive_leaves_the_file_as_it_is(path, tmp_path, capsys):
    save_map(built(OTHER, 1), tmp_path / 'other.stavpr')
    before = path.read_bytes()
    assert main(['update', str(path), str(tmp_path / 'other.stavpr')]) == 1
    assert 'stays as it is' in capsys.readouterr().err
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ['other.stavpr', 'route.stavpr']


@pytest.mark.parametrize(
    ('step', 'call'), [('_copy', 1), ('save_map', 1), ('write_output', 1), ('_copy', 2)]
)
def test_update_that_ends_early_leaves_the_map(path, drives, monkeypatch, step, call):
    before, calls = path.read_bytes(), []
    real = getattr(versions, step)

    def fails(*arguments, **options):
        calls.append(step)
        if len(calls) == call:
            raise OutputError('the program was killed')
        return real(*arguments, **options)

    with monkeypatch.context() as ended:
        ended.setattr(versions, step, fails)
        code = main(['update', str(path), drives[0]])
    if code:
        assert path.read_bytes() == before
        assert main(['update', str(path), drives[0]]) == 0
    assert current_version(path).drive == 'rebuilt'
    assert roll_back(path).map_id
    assert path.read_bytes() == before


KILLED = """
import os, signal, sys
from stavpr_ros.commands.map import main
path, drive, left = *sys.argv[1:3], int(sys.argv[3])
def hook(event, arguments):
    global left
    writes = event == 'open' and arguments[2] & os.O_CREAT
    changes = writes or event in ('os.rename', 'os.remove', 'os.mkdir', 'os.link')
    if changes and os.path.dirname(path) in str(arguments):
        left -= 1
        if not left:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(hook)
sys.exit(main(['update', path, drive]))
"""


def test_killed_update_loses_nothing(path, drives):
    before, was_killed = path.read_bytes(), []
    for call in (3, 4, 6, 8, 99):  # files written, renamed and deleted until then
        command = [sys.executable, '-c', KILLED, path, drives[0], str(call)]
        ended = subprocess.run(command, check=False)
        was_killed.append(ended.returncode == -signal.SIGKILL)
        version, place_map = current_version(path), load_map(path)  # complete, at any time
        assert place_map.map_id == version.map_id
        assert path.read_bytes() == before or version.drive == 'rebuilt'
    assert sum(was_killed) >= 4
    assert not was_killed[-1]
    assert roll_back(path).map_id
    assert path.read_bytes() == before


def test_map_that_another_program_has_replaced_stays(path, first, rebuilt):
    opened, before = FileVersion.of(path), current_version(path)
    place_map, version = updated(first, rebuilt, before)
    save_map(replace(first, stamps=first.stamps + 1), path, force=True)
    other = path.read_bytes()
    with pytest.raises(StavprError):
        save_version(path, opened, place_map, before, version, None)
    assert path.read_bytes() == other


def test_old_versions_are_deleted(path, first, monkeypatch):
    monkeypatch.setattr(versions, 'KEPT', 2)
    for day in range(1, 4):
        opened, before = FileVersion.of(path), current_version(path)
        changed = replace(first, stamps=first.stamps + day)
        save_version(path, opened, changed, before, Version('', changes=(f'{day}',)), None)
    files = sorted(Path(f'{path}.history').glob('*.stavpr'))
    assert len(files) == 2
    assert [each.changes for each in versions.versions(path)][:3] == [('3',), ('2',), ('1',)]
    with pytest.raises(InputError, match='is no version'):
        roll_back(path, versions.versions(path)[2].map_id)


def test_versions_of_a_branch_that_was_left_are_deleted(path, first):
    folder, ids = Path(f'{path}.history'), []
    for day in (1, 2, 3):
        opened, before = FileVersion.of(path), current_version(path)
        changed = replace(first, stamps=first.stamps + day)
        ids.append(save_version(path, opened, changed, before, Version(''), None).map_id)
        (folder / 'notes.txt').touch()
        if day == 2:
            assert roll_back(path).map_id == ids[0]
            assert (folder / f'{ids[1]}.stavpr').exists()
    assert not list(folder.glob(f'{ids[1]}*'))
    assert len(list(folder.glob('*.stavpr'))) == len(versions.versions(path)) == 3
    assert (folder / 'notes.txt').exists()


@pytest.mark.parametrize('content', ['{', '[]', '{"map_id": "x"}', '\ud800'])
def test_damaged_record_is_rejected(path, content):
    folder = Path(f'{path}.history')
    folder.mkdir()
    (folder / f'{load_map(path).map_id}.json').write_text(content, errors='surrogatepass')
    with pytest.raises(StavprError, match='is damaged'):
        current_version(path)
    assert main(['log', str(path)]) == 1


def test_interrupted_update_of_images_continues(path, tmp_path, monkeypatch):
    write_images(tmp_path / 'tuesday', [*ROUTE[:80], *OTHER[:60], *ROUTE[140:]])
    extracted = []
    real = FeatureExtractor.extract

    def extract(self, images):
        extracted.append(len(images))
        if len(images) == builder.BATCH and len(extracted) == 6:
            raise KeyboardInterrupt
        return real(self, images)

    monkeypatch.setattr(FeatureExtractor, 'extract', extract)
    assert main(['update', str(path), str(tmp_path / 'tuesday')]) != 0
    assert current_version(path).number == 0
    before = sum(extracted)
    assert main(['update', str(path), str(tmp_path / 'tuesday')]) == 0
    assert sum(extracted) - before < 200
    assert current_version(path).number == 1
    assert not list(Path(f'{path}.history').glob('*.journal'))
