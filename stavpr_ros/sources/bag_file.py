# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Opens bag files of every kind with rosbags, without writing beside them."""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from functools import cache
from heapq import merge
from itertools import pairwise
import math
import os
from pathlib import Path, PureWindowsPath
import re
import shutil
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Ros1Reader

# its own requirements: YAML of ruamel, zstd of Python 3.14 or its backport
from rosbags.rosbag2.reader import YAML, zstd  # type: ignore[attr-defined]
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore
from stavpr_ros.errors import SourceError
from stavpr_ros.sources.bag_path import (
    MAGIC,
    METADATA,
    reading,
    storage_files,
    storage_kind,
    STORAGE_SUFFIXES,
    ZSTD,
)
from stavpr_ros.sources.mcap import with_end
from stavpr_ros.sources.notes import note_once
from stavpr_ros.sources.video_topic import DEFINITIONS, FFMPEG, FOXGLOVE, ROS1_FFMPEG
from stavpr_ros.units import SECOND

LOG_SUFFIXES = ('-wal', '-journal')
"""Files of SQLite beside a database with writes that are not in the database yet."""
WAL_HEADER = 32  # bytes; others mean that the log began anew
OVERLAP = SECOND // 2  # parts of a split bag follow each other, but for messages out of order
COMPRESSIONS = {'', 'lz4', 'zstd'}  # of chunks of MCAP


@dataclass(frozen=True)
class OpenBag:
    """
    A bag that is open for reading.

    :param readers: of its files.
    :param is_ros1: whether its messages are of ROS 1.
    """

    path: Path
    readers: list[Any]
    is_ros1: bool

    @property
    def topics(self) -> dict[str, list[Connection]]:
        """Return the connections of each topic, of all files."""
        topics: dict[str, list[Connection]] = {}
        for connection in (each for reader in self.readers for each in reader.connections):
            topics.setdefault(connection.topic, []).append(connection)
        return topics

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """
        Return a message of a type.

        Only types of ``sensor_msgs`` and ``nav_msgs`` are read, equal in every distribution, and
        the ones of video topics, of which fields may follow: no definition in the bag is needed.
        """
        return _ros1_store().deserialize_ros1(raw, kind) if self.is_ros1 else _read_cdr(raw, kind)

    def messages(
        self, topics: Collection[str], start: float = 0.0, duration: float = math.inf
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """
        Yield the messages of topics, with their times of recording, ns, in order.

        :param start: seconds after the start of the bag.
        :param duration: seconds from there on.
        """
        with reading(self.path):
            first = min(_span(each)[0] for each in self.readers) + round(start * SECOND)
            last = None if math.isinf(duration) else first + round(duration * SECOND)
            wanted = [[c for c in each.connections if c.topic in topics] for each in self.readers]
            parts = [
                _read(reader)(connections, first if start else None, last)
                for reader, connections in zip(self.readers, wanted, strict=True)
                if connections  # none would be all
            ]
            for connection, time_ns, raw in merge(*parts, key=lambda each: each[1]):
                is_packed = not self.is_ros1 and bytes(raw[:4]) in MAGIC  # ZSTD; no start of CDR
                yield connection, time_ns, zstd.decompress(raw) if is_packed else raw


def message_type(connection: Connection) -> str:
    """Return the full name of the type; in bags from before 2019 ``msg`` is missing."""
    package, _, name = connection.msgtype.rpartition('/')
    return connection.msgtype if package.endswith('/msg') else f'{package}/msg/{name}'


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """
    Open a bag for as long as the block runs.

    The content of the files decides what they are; the metadata of a ROS 2 bag only state which
    files and messages there should be, and what is missing is logged.

    :param path: a ROS 1 .bag file, or a folder of the parts of a split one; a ROS 2 bag: its
        folder, or its .db3 or .mcap file.
    :raises SourceError: it cannot be read.
    """
    with ExitStack() as stack:
        with reading(path):
            names, counts = _stated(path) if path.is_dir() else ([], {})
            files, missing = _files(path, names) if path.is_dir() else ([path], [])
            readers, kinds, damaged = [], set(), []
            for file in files:
                try:
                    with reading(file):
                        reader, kind = _open_file(file, stack)
                except SourceError as error:  # the other parts of the bag may be whole
                    damaged.append(error)
                    continue
                readers.append(reader)
                kinds.add(kind)
            for reason in damaged:
                if not readers:
                    raise reason
                note_once(f'a part of {path} is left out: {reason}')
            if len(kinds) > 1 or (len(files) > 1 and not names and '.bag' not in kinds):
                _require_parts(path, files, readers)
            bag = OpenBag(path, readers, '.bag' in kinds)
            _note_missing(bag, missing, counts)
        yield bag


def _open_file(file: Path, stack: ExitStack) -> tuple[Any, str]:
    """Return an open reader of one file, and its kind."""
    reader, kind = _reader(file, stack)
    reader.open()
    stack.callback(reader.close)
    unknown = {each.compression for each in reader.chunks} if kind == '.mcap' else set()
    if unknown := unknown - COMPRESSIONS:
        raise SourceError(
            f'{file} is compressed by {", ".join(sorted(unknown))}: expected lz4 or zstd; convert '
            'it with the program that wrote it'
        )
    return reader, kind


def _read(reader: Any) -> Callable[..., Iterator[tuple[Connection, int, bytes]]]:
    """Return what yields the messages of a file, of MCAP without an index as they were written."""
    has_no_index = isinstance(reader, McapReader) and not reader.chunks
    return reader.messages_scan if has_no_index else reader.messages


def _span(reader: Any) -> tuple[int, int]:
    """Return the times of the first and last message, ns; the first is larger if there is none."""
    of = getattr(reader, 'metadata', reader)  # only readers of ROS 1 have the times themselves
    return of.start_time, of.end_time


def _stated(folder: Path) -> tuple[list[str], dict[str, int]]:
    """Return the names of the files, and the messages of each topic, by the metadata."""
    file = folder / METADATA
    if not file.exists():
        return [], {}
    content = file.read_bytes()
    try:
        stated = YAML(typ='safe').load(content)['rosbag2_bagfile_information']
        names = [PureWindowsPath(each).name for each in stated['relative_file_paths']]
        topics = stated.get('topics_with_message_count') or []
        counts = {each['topic_metadata']['name']: int(each['message_count']) for each in topics}
    except Exception as error:  # garbage raises errors of any type
        reason = f'{type(error).__name__}: {error}'.partition('\n')[0]
        note_once(f'{file} is damaged or of another program ({reason}): read without it')
        return [], {}
    return names, counts


def _files(folder: Path, names: list[str]) -> tuple[list[Path], list[str]]:
    """Return the files of a bag, and the names of the ones that are missing."""
    present = {file.name.lower(): file for file in sorted(folder.iterdir())}
    files = [present[name.lower()] for name in names if name.lower() in present]
    missing = [name for name in names if name.lower() not in present]
    if missing or not names:  # perhaps renamed
        others = storage_files(folder)
        others += [
            file
            for file in present.values()
            if names and file.is_file() and storage_kind(file) in STORAGE_SUFFIXES
        ]
        files += [file for file in dict.fromkeys(others) if file not in files]
    if not files:
        listed = f' with {", ".join(missing)}' if missing else ''
        raise SourceError(
            f'{folder} is no bag: expected a folder{listed}, or a .db3 or .mcap file; copy the '
            'files of the bag beside its metadata.yaml'
        )
    return files, missing


def _require_parts(folder: Path, files: list[Path], readers: list[Any]) -> None:
    """Reject files without metadata that are not the parts of one bag: other names or times."""
    spans = sorted(map(_span, readers))
    apart = all(one[1] <= two[0] + OVERLAP for one, two in pairwise(spans))
    if len({re.sub(r'_\d+\.', '.', file.name.lower()) for file in files}) > 1 or not apart:
        raise SourceError(
            f'{folder} has no {METADATA} that can be read: expected exactly one .db3 or .mcap '
            f'file then, or the parts of one bag, found {", ".join(each.name for each in files)}; '
            'name one of the files'
        )


def _note_missing(bag: OpenBag, missing: list[str], counts: dict[str, int]) -> None:
    """Log in one line what the metadata state and the files do not have."""
    topics, notes = bag.topics, [f'{name} is missing' for name in missing]
    for topic, count in counts.items():
        present = sum(each.msgcount for each in topics.get(topic, []))
        if present < count:
            notes.append(f'{topic} has {present} of {count} messages')
    if notes:
        note_once(f'{bag.path} has less than its {METADATA} states: {", ".join(notes)}')


def _reader(file: Path, stack: ExitStack) -> tuple[Any, str]:
    """
    Return a reader of one file, not open yet, and its kind; with copies as long as the stack is.

    rosbags opens databases as immutable: it writes nothing, but ignores the logs of SQLite; and it
    does not quote file names.
    """
    kind = storage_kind(file)
    source = file
    if kind == ZSTD:
        with _scratch(file, 'it is compressed', file.stat().st_size, stack) as folder:
            source = folder / 'bag'
            with (
                file.open('rb') as packed,
                zstd.open(packed) as whole,
                source.open('wb') as target,
            ):
                shutil.copyfileobj(whole, target)
        kind = storage_kind(source)
    if kind == '.bag':
        return Ros1Reader(source), kind
    if kind == '.mcap':
        return McapReader(with_end(source, file)), kind
    if kind != '.db3':
        raise SourceError(f'{file} is no bag: expected a database of SQLite, MCAP or ROS 1 .bag')
    logs = [log for end in LOG_SUFFIXES if _has_bytes(log := Path(f'{file}{end}'))]
    if logs:
        size = sum(each.stat().st_size for each in (file, *logs))
        reason = f'{logs[0].name} has writes that are not in it, as while it is recorded'
        with _scratch(file, reason, size, stack) as folder:
            source = _with_logs(file, logs, folder / 'bag')
    return Sqlite3Reader(Path(quote(os.fsencode(source)))), kind


def _has_bytes(file: Path) -> bool:
    return file.exists() and file.stat().st_size > 0


@contextmanager
def _scratch(file: Path, reason: str, size: int, stack: ExitStack) -> Iterator[Path]:
    """Make a temporary folder for a copy; an error names how much room it needs, and why."""
    try:
        yield Path(stack.enter_context(TemporaryDirectory(prefix='stavpr_bag_')))
    except OSError as error:
        raise SourceError(
            f'{file} needs a temporary copy of {size / 1e6:.0f} MB or more, as {reason}: '
            f'{error.strerror}; set TMPDIR to a folder with so much room that can be written'
        ) from error


def _with_logs(file: Path, logs: list[Path], target: Path) -> Path:
    """Copy a database and its logs, and write them into the copy."""
    for _ in range(3):  # a recorder may write the log into the database and begin it anew
        before = [log.read_bytes()[:WAL_HEADER] for log in logs]
        shutil.copyfile(file, target)
        copies = [
            Path(shutil.copyfile(log, f'{target}{log.name.removeprefix(file.name)}'))
            for log in logs
        ]
        if before == [copy.read_bytes()[:WAL_HEADER] for copy in copies]:
            break
    database = sqlite3.connect(target)
    try:
        # opening rolls a journal back; this writes a write-ahead log into the database
        database.execute('PRAGMA wal_checkpoint(TRUNCATE)').fetchall()
    finally:
        database.close()
    return target


@cache
def _ros1_store() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in (DEFINITIONS | {FFMPEG: ROS1_FFMPEG}).items():
        store.register(get_types_from_msg(text, name))
    return store


@cache
def _ros2_store() -> Typestore:
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _read_cdr(raw: bytes, kind: str) -> Any:
    store = _ros2_store()
    if kind != FOXGLOVE:
        return store.deserialize_cdr(raw, kind)
    definition = store.get_msgdef(kind)  # without the check that no bytes are left
    read = definition.deserialize_cdr_le if raw[1] else definition.deserialize_cdr_be
    return read(raw[4:], 0, definition.cls, store)[0]
