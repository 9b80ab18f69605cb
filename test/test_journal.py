# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The journal: every recorded place is on disk, whatever ends a recording or build_map."""

from dataclasses import asdict, replace
import json
import os
from pathlib import Path
import re
import struct
import subprocess
import sys
import time
from types import SimpleNamespace
import zlib

from fixtures import disk_of
from map_files import alter
import numpy as np
from pipelines import Log, process, save, settings_of
from places import poses_at
import pytest
from stavpr_ros.commands import map as map_command
from stavpr_ros.errors import JournalError, OutputTakenError
from stavpr_ros.features import FeatureExtractor, LocalFeatures
from stavpr_ros.mapping import build_map, journal_writer, KeyframeSettings, load_map, save_map
from stavpr_ros.mapping.builder import build_journal
from stavpr_ros.mapping.journal import (
    Base,
    frame,
    JournalPlace,
    JournalReader,
    MAGIC,
    PIECE,
    row_of,
)
from stavpr_ros.mapping.journal_map import journal_map, journals, recover
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.mapping.place_map import Place
from stavpr_ros.pipeline import Pipeline, read_map
from stavpr_ros.pipeline.saving import recover_maps
from stavpr_ros.sources.frame import Frame

BYTES = (0, 5, 9, 13, 20, 1500)  # of each part of a record


@pytest.fixture
def target(tmp_path):
    return tmp_path / 'route.stavpr'


@pytest.fixture
def start(target, request):
    """Make a pipeline that records with a journal; close the journals at the end."""

    def start(operation='mapping', loaded=None, target=target, **settings):
        def open_journal(base, template):
            return JournalWriter.create(target, base, template, print)

        pipeline = Pipeline(settings_of(**settings), operation, open_journal)
        request.addfinalizer(lambda: kill(pipeline))
        if loaded:
            pipeline.change(loaded=read_map(str(loaded), pipeline.settings))
        return pipeline

    return start


def kill(pipeline):
    """Leave the journal as a killed process does: it is written, and no longer locked."""
    pipeline.close_journals(delete_route=False)


def journal_of(target):
    return target.with_name(f'{target.name}.journal')


def wait_until(condition):
    end = time.monotonic() + 180
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def stamps(path):
    return load_map(path).stamps.tolist()


def seconds(*values):
    return [value * 10**9 for value in values]


def assert_equal(path, place_map):
    """Compare all parts of the map in a file with a map."""
    result = load_map(path)
    assert result.settings == place_map.settings
    for name in ('strips', 'weights'):
        assert np.array_equal(getattr(result.features, name), getattr(place_map.features, name))
    np.testing.assert_array_equal(result.stamps, place_map.stamps)
    np.testing.assert_array_equal(result.poses, place_map.poses)
    assert (result.ids, result.thumbnails) == (place_map.ids, place_map.thumbnails)


def places_of(place_map):
    for i in range(len(place_map)):
        features, thumbnail = place_map.features[i : i + 1], place_map.thumbnails[i]
        yield JournalPlace(i, place_map.place(i), features, thumbnail)


@pytest.fixture
def journal_path(small_map, target):
    """Write a journal of a whole map; return its path."""
    writer = JournalWriter.create(target, Base(), small_map, print)
    for place in places_of(small_map):
        writer.append(place)
    writer.close()
    return writer.path


# ----------------------------------------------------------------------------------------- files


def test_recover_returns_every_part_of_every_place(journal_path, small_map, target):
    result = recover(journal_path)
    assert (result.path, result.places, result.recorded) == (str(target), 60, 60)
    assert_equal(target, small_map)
    assert os.listdir(target.parent) == ['route.stavpr']


def test_journal_of_version_2_with_vectors_is_recovered(journal_path, small_map, target, caplog):
    """They are in the map of its header, and behind the strips of each place but the last."""
    section = {'vectors': {'version': 1, 'required': False, 'data': None}}
    with JournalReader(journal_path) as reader:
        template = alter(
            reader.template_content,
            lambda manifest: manifest['sections'].update(section),
            vectors__vectors=np.ones((1, 2), np.float32),
        )
    end = row_of(small_map.features).itemsize
    *records, last = [place.encode() for place in places_of(small_map)]
    frames = [frame(record[:end] + bytes(8) + record[end:]) for record in records]
    journal_path.write_bytes(b''.join([header_with(), frame(template), *frames, frame(last)]))
    assert recover(journal_path).places == 60
    assert_equal(target, small_map)
    assert caplog.messages == [f'the vectors of whole images in {journal_path} are ignored']


def test_fault_at_every_write_loses_no_synced_place(
    small_map, target, tmp_path, monkeypatch, set_constants
):
    """Copies of the journal without a write, with half of it, and with zeros in its stead."""
    set_constants(journal_writer, SYNC_PERIOD=0.01)
    journal, places = journal_of(target), list(places_of(small_map))[:20]
    number = appended = synced = forgotten = 0
    writes, pwrite, fsync = [], os.pwrite, os.fsync

    def is_journal(file):
        return journal.exists() and os.path.samestat(os.fstat(file), journal.stat())

    def logged_pwrite(file, content, offset):
        nonlocal appended
        written = bytes(content) if is_journal(file) else b''  # else of the file that replaces it
        writes.append((journal.read_bytes(), offset, written, forgotten, synced))
        size = pwrite(file, content, offset)
        appended = number if written else appended
        return size

    def logged_fsync(file):
        nonlocal synced
        count = appended
        fsync(file)
        synced = count if is_journal(file) else synced

    monkeypatch.setattr(os, 'pwrite', logged_pwrite)
    monkeypatch.setattr(os, 'fsync', logged_fsync)
    writer = JournalWriter.create(target, Base(), small_map, print)
    for number, place in enumerate(places, 1):
        writer.append(place)
        if number % 4 == 0:
            wait_until(lambda count=number: synced == count)
        if number == 10:
            forgotten, inode = 8, journal.stat().st_ino
            writer.forget(forgotten, Base())
            wait_until(lambda inode=inode: journal.stat().st_ino != inode)
    writer.close()
    monkeypatch.undo()
    copy = tmp_path / 'copy.stavpr'
    for before, offset, written, first, count in writes:
        cut, n = before[:offset] if written else before, len(written)
        for content in (cut, cut + written[: n // 2], cut + bytes(n), cut + bytes(8)):
            journal_of(copy).write_bytes(content)
            try:
                result = stamps(recover(journal_of(copy)).path)
            except JournalError:
                result = []
            assert set(small_map.stamps[first:count].tolist()) <= set(result)
            for path in tmp_path.glob('copy*'):
                path.unlink()
    assert len(writes) >= 23  # header, places, and the rewritten ones


def scale(place, **factors):
    factors = {name: getattr(place.features, name) * factors[name] for name in factors}
    return place._replace(features=replace(place.features, **factors))


@pytest.mark.parametrize(
    'damage',
    [
        lambda record, place: bytes(8),
        lambda record, place: bytes(len(record)),
        lambda record, place: record[:-1],
        *(lambda record, _, at=at: record[:at] + b'U' + record[at + 1 :] for at in BYTES),
        lambda record, place: frame(b''),
        lambda record, place: frame(b'short'),
        lambda record, place: frame(place.encode()[:-2000]),
        lambda record, place: frame(place.encode().replace(b'place 30', b'place \xff0')),
        lambda record, place: scale(place, strips=1e30),
        lambda record, place: scale(place, strips=np.nan),
        lambda record, place: scale(place, weights=-1),
        lambda record, place: place._replace(place=Place(pose=np.ones(7))),
        lambda record, place: place._replace(place=Place(stamp=2**62)),
        lambda record, place: place._replace(thumbnail=b'no image'),
        lambda record, place: place._replace(number=29),  # again
        lambda record, place: place._replace(number=28),  # in another order
    ],
)
def test_damage_costs_one_place_and_the_journal_is_kept(journal_path, small_map, target, damage):
    content, log = journal_path.read_bytes(), Log()
    with JournalReader(journal_path) as reader:
        ends = [reader.end, *(reader.end for _ in reader.places())]
    record = damage(content[ends[30] : ends[31]], list(places_of(small_map))[30])
    record = record if isinstance(record, bytes) else frame(record.encode())
    journal_path.write_bytes(content[: ends[30]] + record + content[ends[31] :])
    assert recover_maps(target, log) == str(target)
    assert stamps(target) == seconds(*range(1, 31), *range(32, 61))
    kept = target.with_name(f'{journal_path.name}.damaged')
    assert f'{kept} is kept' in log.of('error')
    assert set(os.listdir(target.parent)) == {target.name, kept.name}
    assert recover_maps(target, log) == ''  # the next start


def places_in(path):
    with JournalReader(path) as reader:
        return [place.number for place in reader.places()]


def test_flipped_bit_costs_at_most_one_record(small_map, target):
    """One in each byte of the heads, and in bytes all over the file; none in the header."""
    writer = JournalWriter.create(target, Base(), small_map, print)
    for place in list(places_of(small_map))[:4]:
        writer.append(place)
    writer.close()
    content, rng = writer.path.read_bytes(), np.random.default_rng(0)
    with JournalReader(writer.path) as reader:
        ends = [reader.begin // 2, reader.begin, *(reader.end for _ in reader.places())]
    heads = {at for end in (0, *ends[:-1]) for at in range(end, end + 16)}
    numbers, spread = set(range(4)), range(0, len(content), len(content) // 250)
    with writer.path.open('r+b', buffering=0) as file:
        for at in heads | {at + int(rng.integers(20)) for at in spread[:-1]}:
            os.pwrite(file.fileno(), bytes([content[at] ^ 1 << int(rng.integers(8))]), at)
            lost = set() if at < ends[1] else {np.searchsorted(ends[2:], at, 'right')}
            assert set(places_in(writer.path)) == numbers - lost, at
            os.pwrite(file.fileno(), content[at : at + 1], at)
    assert writer.path.read_bytes() == content


def bytes_read():
    """Return the bytes that this process has read so far."""
    return int(Path('/proc/self/io').read_text().split()[1])


def claim(length):
    """Return a valid head of a record that is not there."""
    head = struct.pack('<4sII', MAGIC, length, 0)
    return head + zlib.crc32(head).to_bytes(4, 'little')


@pytest.mark.parametrize(
    'inserted',
    [MAGIC, MAGIC + bytes(4), claim(2**24), claim(2**24) + bytes(5000), frame(b'x')],
    ids=['magic', 'short magic', 'claims', 'spread claims', 'records'],
)
def test_whole_records_between_any_bytes_are_read_in_linear_time(journal_path, inserted):
    content = journal_path.read_bytes()
    with JournalReader(journal_path) as reader:
        middle = [reader.end for _ in reader.places()][29]
    inserted *= 2 * 10**6 // len(inserted)
    journal_path.write_bytes(content[:middle] + inserted + content[middle:] + inserted)
    before = bytes_read()
    assert places_in(journal_path) == list(range(60))
    assert bytes_read() - before <= 2 * (journal_path.stat().st_size + PIECE)


def test_journal_with_half_a_header_is_resumed_and_mended(journal_path):
    content = journal_path.read_bytes()
    with JournalReader(journal_path) as reader:
        begin = reader.begin
    for at in (50, begin - 50):
        journal_path.write_bytes(content[:at] + bytes(9) + content[at + 9 :])
        writer, last = JournalWriter.resume(JournalReader(journal_path), print)
        writer.close()
        assert (last, journal_path.read_bytes()) == (59, content)


def test_journal_that_ends_with_zeros_and_a_hole_is_read_at_once(journal_path):
    with journal_path.open('ab') as file:
        file.write(bytes(10**6))
        file.truncate(2**40)
    with JournalReader(journal_path) as reader:
        assert len(list(reader.places())) == 60
        assert 'no whole record' in reader.problem


def header_with(**changes):
    about = {'format': 'stavpr-journal', 'version': 2, 'source': ''} | asdict(Base()) | changes
    return frame(json.dumps(about).encode())


@pytest.mark.parametrize(
    ('content', 'text'),
    [
        (b'', 'no JSON'),
        (b'\xff' * 100, 'no JSON'),
        (frame(b'[' * 5000), 'nested too deeply|no JSON'),
        (header_with(path=7), 'another format'),
        (header_with(places='9'), 'another format'),
        (header_with(version=1), 'another format'),
        (header_with(), 'is no map, or a damaged one'),  # and no map
    ],
)
def test_file_with_an_invalid_header_stops_no_start_and_is_kept(content, text, target):
    path, log = journal_of(target), Log()
    path.write_bytes(content)
    with pytest.raises(JournalError, match=f'is no journal, or its header is damaged.*{text}'):
        recover(path)
    assert recover_maps(target, log) == ''
    assert path.read_bytes() == content


def test_create_on_a_full_disk_leaves_no_journal(small_map, target):
    """Without room for a map, and with room for the map in its header only."""
    save_map(small_map, target)
    for size in (1000, target.stat().st_size):
        with pytest.raises(JournalError, match='File too large'), disk_of(size):
            JournalWriter.create(target, Base(), small_map, print)
        assert os.listdir(target.parent) == [target.name]


def test_recover_what_is_no_file_or_in_use_fails(small_map, target, tmp_path):
    os.mkfifo(tmp_path / 'fifo')
    writer = JournalWriter.create(target, Base(), small_map, print)
    for path, text in (
        (tmp_path / 'missing', 'cannot be read'),
        (tmp_path / 'fifo', 'expected a regular file'),
        (writer.path, 'written by a running program'),
    ):
        with pytest.raises(JournalError, match=text):
            recover(path)
    writer.close()
    with pytest.raises(JournalError, match='has no places'):
        recover(writer.path)


def test_recover_to_a_file_that_exists_fails_and_keeps_both(journal_path, small_map, tmp_path):
    path = tmp_path / 'other.stavpr'
    save_map(small_map, path)
    with pytest.raises(OutputTakenError, match='exists already'):
        recover(journal_path, path)
    assert journal_path.exists()
    assert recover(journal_path, tmp_path / 'new.stavpr').places == 60


# -------------------------------------------------------------------------------------- recording


def test_saving_deletes_the_journal_and_later_places_open_another(start, route, target):
    pipeline = start()
    process(pipeline, route[:3])
    save(pipeline, target)
    assert journals(target) == []
    process(pipeline, route[3:5], first=3)
    kill(pipeline)
    assert recover(journals(target)[0]).recorded == 2
    assert stamps(target) == seconds(1, 2, 3, 4, 5)  # in the file that was continued
    assert os.listdir(target.parent) == ['route.stavpr']


def test_saving_while_places_are_recorded_keeps_those_in_the_journal(start, route, target):
    pipeline = start()
    process(pipeline, route[:3])
    snapshot = pipeline.snapshot()
    process(pipeline, route[3:5], first=3)
    save_map(snapshot.places, target)
    snapshot.mark_saved(str(target))
    process(pipeline, route[5:6], first=5)
    kill(pipeline)
    result = recover(journals(target)[0])
    assert (result.places, result.recorded) == (6, 3)
    assert stamps(target) == seconds(1, 2, 3, 4, 5, 6)


def test_kill_between_saving_and_the_journal_duplicates_nothing(start, route, target):
    pipeline = start()
    process(pipeline, route[:3])
    save_map(pipeline.snapshot().places, target)  # and the process is killed
    process(pipeline, route[3:4], first=3)
    kill(pipeline)
    assert recover(journals(target)[0]).path == str(target)
    assert stamps(target) == seconds(1, 2, 3, 4)

    pipeline = start(loaded=target)
    process(pipeline, route[4:6], first=4)
    save_map(pipeline.snapshot().places, target, force=True)
    kill(pipeline)
    assert recover(journals(target)[0]).places == 6
    assert stamps(target) == seconds(1, 2, 3, 4, 5, 6)
    assert os.listdir(target.parent) == ['route.stavpr']


@pytest.mark.parametrize('change', ['another', 'missing', 'damaged'])
def test_recover_without_the_map_that_was_continued_keeps_the_places(
    start, small_map, route, target, tmp_path, change
):
    base = tmp_path / 'base.stavpr'
    save_map(small_map, base)
    pipeline = start(loaded=base)
    process(pipeline, route[:4], first=100)
    kill(pipeline)
    if change == 'another':
        save_map(load_map(base), tmp_path / 'copy.stavpr')
        save_map(replace(small_map, stamps=small_map.stamps + 1), base, force=True)
    elif change == 'missing':
        base.unlink()
    else:
        base.write_bytes(b'PK')
    log = Log()
    assert recover_maps(target, log) == str(target)
    assert len(load_map(target)) == 4
    assert 'base.stavpr' in log.of('error')


def test_recover_beside_another_map_takes_a_numbered_name(start, small_map, route, target):
    save_map(small_map, target)
    pipeline = start()
    process(pipeline, route[:4], first=100)
    kill(pipeline)
    assert recover(journals(target)[0]).path == str(target.with_stem('route-2'))
    assert (len(load_map(target)), len(load_map(target.with_stem('route-2')))) == (60, 4)


def test_journal_of_a_second_recording_takes_a_numbered_name(start, route, target):
    first, second = start(), start()
    process(first, route[:2])
    process(second, route[:3])
    names = [path.name for path in journals(target)]
    assert sorted(names) == ['route-2.stavpr.journal', 'route.stavpr.journal']
    kill(first)
    log = Log()
    assert recover_maps(target, log) == str(target)  # and the living one keeps its own
    assert 'written by a running program' in log.lines[1][1]
    assert [path.name for path in journals(target)] == ['route-2.stavpr.journal']


def test_journal_of_a_route_follows_evictions(start, route, target, set_constants):
    set_constants(journal_writer, SLACK=0)
    pipeline = start('loop_closure', exclude_places=1, max_places=24)
    process(pipeline, [route[i % 60] for i in range(130)])
    held = pipeline.snapshot().places
    (path,) = journals(target)
    # of 9,000 a place; rewritten by the thread that syncs
    wait_until(lambda: os.path.getsize(path) <= 600_000)
    kill(pipeline)
    result = recover(path)
    output = load_map(result.path)
    n = len(held)
    assert n <= len(output) < 80
    assert output.stamps[-n:].tolist() == held.stamps.tolist()
    assert np.allclose(output.features.strips[:, -n:], held.features.strips, atol=1e-6)


def test_changes_keep_the_journal_of_unsaved_places(start, small_map, route, target, tmp_path):
    """Of the operation, and of the map, which discards them."""
    other = tmp_path / 'other.stavpr'
    save_map(small_map, other)
    pipeline = start()
    process(pipeline, route[:6])
    pipeline.change(operation='localization')
    process(pipeline, route[:6], first=50)
    pipeline.change(operation='mapping')
    process(pipeline, route[6:8], first=6)
    pipeline.change(operation='localization')
    pipeline.change(loaded=read_map(str(other), pipeline.settings))
    assert recover(journals(target)[0]).places == 8
    assert stamps(target) == seconds(*range(1, 9))


# ---------------------------------------------------------------------------------------- the disk


@pytest.mark.parametrize('removed', ['the folder', 'the journal'])
def test_removed_journal_is_reported_and_written_anew(start, route, tmp_path, capsys, removed):
    target = tmp_path / 'maps' / 'route.stavpr'
    target.parent.mkdir()
    pipeline = start(target=target)
    process(pipeline, route[:6])
    journal_of(target).unlink()
    if removed == 'the folder':
        target.parent.rmdir()
    wait_until(journal_of(target).exists)
    wait_until(lambda: 'was removed: its places are written anew' in capsys.readouterr().out)
    process(pipeline, route[6:9], first=6)
    kill(pipeline)
    assert recover(journals(target)[0]).recorded == 9
    assert stamps(target) == seconds(*range(1, 10))


FULL = """
import resource, signal, sys
from pipelines import Log, process, settings_of
from fixtures import route_images
from stavpr_ros.mapping.journal_map import recover
from stavpr_ros.mapping.journal_writer import JournalWriter
from stavpr_ros.pipeline import Pipeline

target, output, case = sys.argv[1:]
writers, unlimited = [], (resource.RLIM_INFINITY,) * 2

def open_journal(base, template):
    writers.append(JournalWriter.create(target, base, template, print))
    return writers[0]

pipeline = Pipeline(settings_of(), 'mapping', open_journal)
images = route_images(60)
process(pipeline, images[:1])
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
process(pipeline, images[1:50], first=1)
assert writers[0].failed
if case == 'room':
    resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
process(pipeline, images[50:], first=50)
assert len(pipeline.places) == 60
[journal] = pipeline.close_journals(False)
resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
print(recover(journal, output).places)
"""


@pytest.mark.parametrize('case', ['room', 'none'])
def test_full_disk_ends_neither_the_recording_nor_the_journal(case, target, tmp_path):
    """Its stand-in is RLIMIT_FSIZE."""
    output = tmp_path / 'recovered.stavpr'
    command = [sys.executable, '-c', FULL, str(target), str(output), case]
    path = os.pathsep.join([os.path.dirname(__file__), *sys.path])
    environment = os.environ | {'PYTHONPATH': path}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count('cannot be written (') == 1, done.stdout
    places = int(done.stdout.split()[-1])
    assert places == 60 if case == 'room' else 10 < places < 50
    assert stamps(output) == seconds(*range(1, places + 1))


# An interrupted build_map continues where it was, in memory that does not grow

EXTRACTOR = FeatureExtractor('gradient')


class StopError(Exception):
    """The work is interrupted."""


@pytest.fixture
def frames(route):
    return [Frame(image, (i + 1) * 10**9, f'image {i}') for i, image in enumerate(route)]


POSES = poses_at(range(60))


def until(frames, count):
    """Yield frames up to a number, and then interrupt the work."""
    yield from frames[:count]
    raise StopError


@pytest.mark.parametrize('keyframes', [None, KeyframeSettings(distance=1.5)])
def test_build_journal_interrupted_twice_gives_the_map_of_one_run(frames, tmp_path, keyframes):
    target, journal = tmp_path / 'route.stavpr', tmp_path / 'route.stavpr.journal'
    options = {'keyframes': keyframes, 'progress': False}
    for count in (20, 45):
        with pytest.raises(StopError):
            build_journal(until(frames, count), EXTRACTOR, target, 'drive', POSES, **options)
    with JournalReader(journal) as reader:
        assert 15 <= [place.number for place in reader.places()][-1] < 45
    content = journal.read_bytes()
    journal.write_bytes(content.replace(content[-20_000:-19_991], bytes(9)))
    build_journal(frames, EXTRACTOR, target, 'drive', POSES, **options)
    save_map(journal_map(journal), target)
    assert_equal(target, build_map(frames, EXTRACTOR, POSES, **options))
    assert build_journal(frames, EXTRACTOR, target, 'drive', POSES, **options) == journal


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
