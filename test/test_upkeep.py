# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What drives add to a map, what is removed from it, and the versions of its file."""

from dataclasses import asdict, replace
import json
import os
from pathlib import Path
import signal
import subprocess
import sys

from evaluation_commands import write_images
from fixtures import route_images
import numpy as np
from places import poses_at
import pytest
from stavpr_ros.commands.map import main
from stavpr_ros.errors import InputError, OutputError, StavprError
from stavpr_ros.features import FeatureExtractor
from stavpr_ros.maintenance.same_places import with_seam
from stavpr_ros.maintenance.upkeep import update_file, update_map
from stavpr_ros.mapping import (
    build_map,
    builder,
    load_map,
    merge_maps,
    save_map,
    select_places,
    versions,
)
from stavpr_ros.mapping.versions import current_version, roll_back, save_version, Version
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.output_file import FileVersion
from stavpr_ros.sources.frame import Frame

pytestmark = pytest.mark.usefixtures('one_thread')
ROUTE, OTHER, BYPASS = (route_images(count, seed) for count, seed in ((200, 0), (120, 5), (70, 9)))


def build(images, day=0, poses=None, thumbnails=False):
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
    return build(ROUTE, poses=poses_at(range(len(ROUTE))))


@pytest.fixture(scope='module')
def rebuilt():
    """Return a drive on which 60 places look otherwise."""
    return build([*ROUTE[:80], *OTHER[:60], *ROUTE[140:]], 1)


@pytest.fixture(scope='module')
def around():
    """Return a drive that leaves the map at place 80, and comes back at 90."""
    poses = poses_at(range(240))[:, [1, 0, *range(2, 7)]]  # of another frame
    return build([*ROUTE[:80], *BYPASS, *ROUTE[90:180]], 2, poses)


def update(place_map, drive, version=None, name='drive'):
    version = version or Version('', base_places=len(place_map))
    return update_map(place_map, drive, name, version)


def recall(place_map, drive):
    recognizer = PlaceRecognizer(place_map, RecognizerSettings())
    matches = [recognizer.update(drive.features[i : i + 1]) for i in range(len(drive))]
    return np.mean([match.accepted for match in matches])


@pytest.fixture(scope='module')
def two(first):
    """Return the map with another drive."""
    return update(first, build(ROUTE, 9))[0]


def test_drive_over_the_route_becomes_a_session(first, rebuilt):
    place_map, version = update(first, rebuilt)
    assert version.changes == ('certain of 70% of 200 images', 'added the drive, 200 images')
    assert [session.id for session in place_map.sessions] == ['first', 'drive']
    assert np.bincount(place_map.session_index).tolist() == [200, 200]
    shown = place_map.same_as[200:] < 200
    related = place_map.same_as[200:][shown]
    np.testing.assert_allclose(related, np.flatnonzero(shown), atol=2)
    assert shown[:80].all()
    assert shown[145:].all()
    assert not shown[95:125].any()  # looks otherwise: no place of the map
    ids = np.array(place_map.ids)
    assert ids[200:][shown].tolist() == [str(place) for place in related]
    assert set(ids[200:][~shown]) == {f'drive/{i}' for i in np.flatnonzero(~shown)}
    np.testing.assert_array_equal(place_map.poses[200:][shown], first.poses[related])
    again = build([*ROUTE[:80], *OTHER[:60], *ROUTE[140:]], 3)
    assert recall(place_map, again) > recall(first, again) + 0.1


def test_detour_has_poses_by_odometry_from_where_it_left_the_map(first, around):
    place_map, _ = update(first, around)
    own = 200 + np.flatnonzero(place_map.same_as[200:] >= 200)
    assert 60 <= len(own) <= 75
    poses = place_map.poses[own]
    np.testing.assert_allclose(poses[:, 0], poses[0, 0], atol=1e-6)
    np.testing.assert_allclose(np.diff(poses[:, 1]), 1, atol=1e-6)
    assert recall(place_map, build([*ROUTE[60:80], *BYPASS, *ROUTE[90:120]], 4)) > 0.8


def test_map_before_its_first_update_and_latest_three_drives_stay(first, rebuilt, around):
    place_map, version = first, None
    drives = rebuilt, around, *(build(ROUTE, day) for day in (3, 4, 5))
    for day, drive in enumerate(drives, 1):
        place_map, version = update(place_map, drive, version, f'day {day}')
        assert len(place_map.sessions) == min(1 + day, 4)
    assert [session.id for session in place_map.sessions] == ['first', 'day 3', 'day 4', 'day 5']
    assert version.changes[2] == 'removed the 240 places of day 2: 3 drives are kept'
    assert place_map.features[np.arange(200)].strips.tobytes() == first.features.strips.tobytes()
    np.testing.assert_allclose(place_map.same_as[600:], np.arange(200), atol=2)
    assert place_map.ids[:200] == tuple(map(str, range(200)))


def test_no_session_of_a_merged_map_goes(first):
    """Nor the floors of a building, where each drive is on one of them."""
    other = build(OTHER)
    place_map, version = merge_maps([first, other, first], 'abc'), None
    place_map = replace(place_map, same_as=np.r_[0:320, 0:200].astype(np.int32))
    for day in range(1, 5):
        drive = build(OTHER if day == 2 else ROUTE, day)
        place_map, version = update(place_map, drive, version, f'day {day}')
    assert [s.id for s in place_map.sessions] == ['a', 'b', 'c', 'day 2', 'day 3', 'day 4']


def test_drive_over_less_than_half_of_the_route_changes_nothing(first, two):
    for place_map in (first, two):
        with pytest.raises(InputError, match=r'the drive passes 4.% of a session of the map'):
            update(place_map, build(ROUTE[100:190], 2))
    assert len(update(first, build(ROUTE[80:], 2))[0]) == 320


def test_images_at_rest_and_beyond_two_laps_are_not_added(first):
    stops = build([*ROUTE[:100], *[ROUTE[100]] * 50, *ROUTE[100:]], 1)
    assert len(update(first, stops)[0]) == pytest.approx(400, abs=2)
    closed = with_seam(build([*ROUTE, *ROUTE[:45]]))
    assert closed.seam == 44
    laps = build([*ROUTE[60:], *ROUTE, *ROUTE, *ROUTE[:40]], 1)
    place_map, version = update(closed, laps)
    assert version.changes == ('certain of 100% of 580 images', 'added the drive, 490 images')
    related = np.arange(90, 580) + 60
    np.testing.assert_allclose((place_map.same_as[245:] - related + 3) % 200, 3, atol=2)
    with pytest.raises(InputError, match=r'passes 3.% of a session'):
        update(closed, build([*ROUTE[160:], *ROUTE[:50]], 1))  # over the seam
    away = build([*ROUTE, *route_images(400, 7)], 1)
    place_map, _ = update(first, away)
    assert place_map.same_as[200:400].tolist() == pytest.approx(range(200), abs=2)
    assert len(place_map) == 600


NOISE = [*np.random.default_rng(1).integers(0, 256, (200, 96, 128, 3), np.uint8)]


@pytest.mark.parametrize(
    ('images', 'reason'),
    [
        (OTHER, 'are certain where they are'),
        ([np.ascontiguousarray(image[:, ::-1]) for image in ROUTE], 'are certain where they are'),
        (ROUTE[::-1], 'are certain where they are'),
        (NOISE, 'are certain where they are'),
        ([*ROUTE[:60], *NOISE], 'the drive passes 30% of a session'),
        ([ROUTE[80]] * 200, 'the drive passes 0% of a session'),
        ([*ROUTE[100:180], *ROUTE[10:90]], 'cannot both be right'),
        (ROUTE[:30], 'are certain where they are'),
    ],
    ids=['another route', 'mirrored', 'reversed', 'noise', 'leaves', 'rest', 'start', 'short'],
)
def test_drive_that_may_be_wrong_changes_nothing(first, two, images, reason):
    twice = replace(first, same_as=np.r_[0:51, 50, 52:200].astype(np.int32))  # is not closed
    for place_map in (first, twice, two):
        with pytest.raises(InputError, match=reason):
            update(place_map, build(images, 1))


def test_drive_whose_thumbnails_fit_other_places_changes_nothing():
    drive, place_map = build(ROUTE, 1, thumbnails=True), build(ROUTE, thumbnails=True)
    assert update(place_map, drive)[0].thumbnails == place_map.thumbnails + drive.thumbnails
    shifted = drive.thumbnails[100:] + drive.thumbnails[:100]
    mirrored = build([np.ascontiguousarray(image[:, ::-1]) for image in ROUTE], 1, thumbnails=True)
    for wrong in (shifted, mirrored.thumbnails):
        with pytest.raises(InputError, match='thumbnails'):
            update(place_map, replace(drive, thumbnails=wrong))


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


def save_next(path, place_map, version=None):
    """Save another map as the next version of a file."""
    before = current_version(path)
    return save_version(path, FileVersion.of(path), place_map, before, version or before, None)


@pytest.mark.parametrize('length', [0, 1000])
def test_damaged_version_is_kept_anew_from_the_map(first, path, length):
    """A battery that was pulled cut the copy of the present version, which the map still is."""
    before, history = current_version(path), Path(f'{path}.history')
    history.mkdir()
    old = history / f'{before.map_id}.stavpr'
    old.write_bytes(path.read_bytes()[:length])
    save_next(path, select_places(first, np.arange(20)))
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
    assert '\nadded the drive' in capsys.readouterr().out
    assert main(['log', str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:16] for line in lines if not line.startswith(' ')] == ids[::-1]
    assert any('added the drive, 240 images' in line for line in lines)
    assert current_version(path).number == 2
    assert main(['rollback', str(path)]) == 0
    assert load_map(path).map_id == ids[1]
    assert main(['rollback', str(path), '--to', ids[0]]) == 0
    assert load_map(path).map_id == ids[0]
    assert main(['rollback', str(path)]) == 1
    assert main(['update', str(path), drives[0]]) == 0
    assert load_map(path).map_id == ids[1]  # the same again, to the last bit


def test_map_with_more_drives_keeps_three_after_the_next_update(path, first):
    """Earlier versions kept five, and have the use of each place in their records."""
    drives = [build(ROUTE, day) for day in range(1, 6)]
    merged = merge_maps([first, *drives], ['first', *'12345'])
    same_as = np.tile(np.arange(200, dtype=np.int32), 6)
    save_map(replace(merged, same_as=same_as), path, force=True)
    record = asdict(Version(load_map(path).map_id, base_places=200, number=5, drive='5'))
    record |= {'use': [0.9] * 1200, 'missed': [0] * 1200}
    folder = Path(f'{path}.history')
    folder.mkdir()
    (folder / f'{record["map_id"]}.json').write_text(json.dumps(record))
    assert current_version(path).base_places == 200
    assert main(['log', str(path)]) == 0
    opened, drive = FileVersion.of(path), build(OTHER[:40] + ROUTE[40:], 6)
    version = update_file(path, opened, load_map(path), drive, '6')
    assert (version.number, version.base_places) == (6, 200)
    assert [session.id for session in load_map(path).sessions] == ['first', '4', '5', '6']
    assert roll_back(path).number == 5


def test_poisoned_drive_leaves_the_file_as_it_is(path, tmp_path, capsys):
    save_map(build(OTHER, 1), tmp_path / 'other.stavpr')
    before = path.read_bytes()
    assert main(['update', str(path), str(tmp_path / 'other.stavpr')]) == 1
    assert 'stays as it is' in capsys.readouterr().err
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ['other.stavpr', 'route.stavpr']


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
    place_map, version = update(first, rebuilt, before)
    save_map(replace(first, stamps=first.stamps + 1), path, force=True)
    other = path.read_bytes()
    with pytest.raises(StavprError):
        save_version(path, opened, place_map, before, version, None)
    assert path.read_bytes() == other


def test_old_versions_are_deleted(path, first, set_constants):
    set_constants(versions, MAX_VERSIONS=2)
    for day in range(1, 4):
        later = replace(first, stamps=first.stamps + day)
        save_next(path, later, Version('', changes=(f'{day}',)))
    files = sorted(Path(f'{path}.history').glob('*.stavpr'))
    assert len(files) == 2
    assert [version.changes for version in versions.versions(path)][:3] == [('3',), ('2',), ('1',)]
    with pytest.raises(InputError, match='is no version'):
        roll_back(path, versions.versions(path)[2].map_id)


def test_versions_of_a_branch_that_was_left_are_deleted(path, first):
    folder, ids = Path(f'{path}.history'), []
    for day in (1, 2, 3):
        later = replace(first, stamps=first.stamps + day)
        ids.append(save_next(path, later, Version('')).map_id)
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
