# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Output files: complete or absent, never over somebody else's, one writer at a time."""

from concurrent.futures import ThreadPoolExecutor
import contextlib
import os
import stat
import subprocess
import sys
import threading

from fixtures import disk_of
import pytest
from stavpr_ros.errors import OutputError, OutputTakenError
from stavpr_ros.output_file import (
    atomic_output,
    csv_kind,
    FileVersion,
    HTML,
    JSON,
    MAP,
    PNG,
    RECORDING,
    require_replaceable,
    write_output,
)

# writes half a file, reports it, and waits to be killed
WRITER = """
import sys, time
from stavpr_ros.output_file import atomic_output, JSON
with atomic_output(sys.argv[1], JSON, force=True) as file:
    file.write(b'{"half":')
    file.flush()
    print('half', flush=True)
    time.sleep(1000)
"""


def names(folder):
    return sorted(os.listdir(folder))


@pytest.fixture
def writer(tmp_path):
    """Start a process that has written half of a file; kill it at the end."""
    processes = []

    def start(path):
        command = [sys.executable, '-c', WRITER, str(path)]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE))
        assert processes[-1].stdout.readline() == b'half\n'
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def test_write_output_new_file_has_content_and_the_usual_mode(tmp_path):
    path = tmp_path / 'a.json'
    write_output(path, '{"ä": 1}', JSON, force=False)
    (tmp_path / 'usual').touch()
    assert path.read_text(encoding='utf-8') == '{"ä": 1}'
    assert path.stat().st_mode == (tmp_path / 'usual').stat().st_mode
    assert names(tmp_path) == ['a.json', 'usual']


def test_write_output_existing_file_is_replaced_only_by_force(tmp_path):
    path = tmp_path / 'a.json'
    path.write_text('{}')
    with pytest.raises(OutputTakenError, match='exists already: choose another name, or replace'):
        write_output(path, '[]', JSON, force=False)
    assert path.read_text() == '{}'
    write_output(path, '[]', JSON, force=True)
    assert path.read_text() == '[]'


@pytest.mark.parametrize('mode', [0o600, 0o660])
def test_write_output_keeps_mode_of_the_replaced_file(mode, tmp_path):
    path = tmp_path / 'a.json'
    path.write_text('{}')
    path.chmod(mode)
    with atomic_output(path, JSON, force=True) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == mode  # before there is content
        file.write(b'[]')
    assert (stat.S_IMODE(path.stat().st_mode), path.read_text()) == (mode, '[]')


def test_write_output_never_replaces_a_write_protected_file(tmp_path):
    path = tmp_path / 'a.json'
    path.write_text('{}')
    path.chmod(0o444)
    for force in (True, FileVersion.of(path)):
        with pytest.raises(OutputTakenError, match=r'a.json is write-protected: chmod u\+w'):
            write_output(path, '[]', JSON, force)
    assert path.read_text() == '{}'


@pytest.mark.parametrize('exists', [False, True])
def test_write_output_symlink_stays_and_its_target_is_written(exists, tmp_path):
    target, link = tmp_path / 'disk' / 'a.json', tmp_path / 'a.json'
    target.parent.mkdir()
    if exists:
        target.write_text('{}')
    link.symlink_to('disk/a.json')
    write_output(link, '[]', JSON, force=exists)
    assert link.is_symlink()
    assert (target.read_text(), names(target.parent)) == ('[]', ['a.json'])


def test_atomic_output_error_in_the_block_leaves_what_was_there(tmp_path):
    path = tmp_path / 'a.json'
    path.write_text('{}')

    def interrupt():
        with atomic_output(path, JSON, force=True) as file:
            file.write(b'x')
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert (path.read_text(), names(tmp_path)) == ('{}', ['a.json'])


def test_atomic_output_is_locked_until_the_end_committed_or_not(tmp_path):
    path = tmp_path / 'a.json'
    with atomic_output(path, JSON) as file:
        for part, content in ((b'[1,', b'[1,'), (b'2]', b'[1,2]')):
            with pytest.raises(OutputTakenError, match='written by another program'):
                write_output(path, '[]', JSON, force=True)
            file.write(part)
            file.commit()
            assert path.read_bytes() == content
    assert names(tmp_path) == ['a.json']
    write_output(path, '[]', JSON, force=True)


def test_atomic_output_many_writers_at_once_exactly_one_wins(tmp_path):
    path, start = tmp_path / 'a.json', threading.Barrier(8)

    def write(number):
        start.wait()
        with contextlib.suppress(OutputTakenError):
            write_output(path, f'[{number}]', JSON, force=False)
            return number

    with ThreadPoolExecutor(8) as pool:
        (winner,) = (number for number in pool.map(write, range(8)) if number is not None)
    assert (path.read_text(), names(tmp_path)) == (f'[{winner}]', ['a.json'])


def test_atomic_output_killed_writer_leaves_what_the_next_one_sweeps(writer, tmp_path):
    path, other = tmp_path / 'a.json', tmp_path / 'b.json'
    path.write_text('{}')
    process, living = writer(path), writer(other)
    process.kill()
    process.wait()
    assert (path.read_text(), len(names(tmp_path))) == ('{}', 3)
    write_output(tmp_path / 'c.json', '[]', JSON, force=False)
    assert len(names(tmp_path)) == 3, 'the temporary of the living writer stays'
    with pytest.raises(OutputTakenError, match='written by another program'):
        write_output(other, '[]', JSON, force=True)
    assert living.poll() is None


def test_write_output_on_a_full_disk_leaves_what_was_there(tmp_path):
    path, match = tmp_path / 'a.json', r'written .File too large.; what was there is untouched'
    path.write_text('{}')
    with pytest.raises(OutputError, match=match), disk_of(10_000):
        write_output(path, '[' + ' ' * 100_000, JSON, force=True)
    assert (path.read_text(), names(tmp_path)) == ('{}', ['a.json'])


def test_name_without_room_for_suffixes_is_refused_before_the_work(tmp_path):
    for name in ('r' * 221, 'ü' * 120, 'r' * 20_000):
        with pytest.raises(OutputError, match=r'the name .{60}\.\.\. has \d+ bytes: expected at'):
            require_replaceable(tmp_path / name, JSON)
    require_replaceable(tmp_path / ('r' * 220), JSON)


def test_require_replaceable_names_what_is_wrong(tmp_path):
    os.mkfifo(tmp_path / 'fifo')
    (tmp_path / 'loop').symlink_to('loop')
    for name, text in (
        ('', 'is a folder: name a file in it'),
        ('missing/a', 'does not exist: make it first'),
        ('fifo', 'is no regular file: it is never replaced'),
        ('loop', 'cannot be written'),
    ):
        with pytest.raises(OutputError, match=text):
            require_replaceable(tmp_path / name, JSON, force=True)
    with pytest.raises(OutputError, match='only `record` writes to the standard output'):
        require_replaceable('-', JSON)
    require_replaceable(tmp_path / 'new', JSON)


@pytest.mark.parametrize(
    ('kind', 'content'),
    [
        (MAP, b'\x10\0\0\0\0\0\0\0{"__metadata__":{"format":"stavpr-map"}}'),
        (RECORDING, b'{"stamp": 1, "frame_id": ""}\n'),
        (JSON, b'\n[1]'),
        (PNG, b'\x89PNG\r\n'),
        (HTML, b'<!DOCTYPE html>\n'),
        (csv_kind(['a', 'b']), b'a,b\r\n1,2'),
    ],
)
def test_write_output_replaces_its_own_kind_only(kind, content, tmp_path):
    path = tmp_path / 'file'
    path.write_bytes(content)
    write_output(path, content * 2, kind, force=True)
    path.write_text('# {"stavpr-map"')
    with pytest.raises(OutputTakenError, match='never replaced'):
        write_output(path, content, kind, force=True)
    assert path.read_text() == '# {"stavpr-map"'
