# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Opens bag files of every kind with rosbags, without writing beside them."""

from collections.abc import Collection, Iterable, Iterator
from contextlib import closing, contextmanager, ExitStack
from dataclasses import dataclass
from functools import cache
from heapq import merge
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
from stavpr_ros.sources import bag_path
from stavpr_ros.sources.bag_path import METADATA, reading, storage_kind, ZSTD
from stavpr_ros.sources.mcap import with_end
from stavpr_ros.sources.notes import note_once
from stavpr_ros.sources.video_topic import DEFINITIONS, FFMPEG, FOXGLOVE, ROS1_FFMPEG
from stavpr_ros.units import SECOND

LOG_SUFFIXES = ('-wal', '-journal')
"""Files of SQLite beside a database with writes that are not in the database yet."""


@dataclass(frozen=True)
class OpenBag:
    """
    A bag that is open for reading.

    :param readers: readers of its files.
    """

    path: Path
    readers: list[Any]

    @property
    def is_ros1(self) -> bool:
        """Return whether its messages are of ROS 1."""
        return all(isinstance(reader, Ros1Reader) for reader in self.readers)

    @property
    def topics(self) -> dict[str, list[Connection]]:
        """Return the connections of each topic, of all files."""
        topics: dict[str, list[Connection]] = {}
        for reader in self.readers:
            for connection in reader.connections:
                topics.setdefault(connection.topic, []).append(connection)
        return topics

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """
        Return a message of a type.

        Only types of ``sensor_msgs`` and ``nav_msgs`` are read, equal in every distribution, and
        the ones of video topics, of which fields may follow: no definition in the bag is needed.
        """
        store = _store(self.is_ros1)
        if self.is_ros1:
            return store.deserialize_ros1(raw, kind)
        if kind != FOXGLOVE:
            return store.deserialize_cdr(raw, kind)
        definition = store.get_msgdef(kind)  # without the check that no bytes are left
        read = definition.deserialize_cdr_le if raw[1] else definition.deserialize_cdr_be
        return read(raw[4:], 0, definition.cls, store)[0]

    def messages(
        self, topics: Collection[str], start: float = 0.0, duration: float = math.inf
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """
        Yield the messages of topics, with their times of recording, ns, in order.

        :param start: seconds after the start of the bag.
        :param duration: seconds from there on.
        """
        with reading(self.path):
            starts = (getattr(reader, 'metadata', reader).start_time for reader in self.readers)
            first = min(starts) + round(start * SECOND)
            last = None if math.isinf(duration) else first + round(duration * SECOND)
            parts = []
            for reader in self.readers:
                has_index = not isinstance(reader, McapReader) or reader.chunks
                read = reader.messages if has_index else reader.messages_scan
                connections = [row for row in reader.connections if row.topic in topics]
                if connections:  # none would be all
                    parts.append(read(connections, first if start else None, last))
            for connection, time_ns, raw in merge(*parts, key=lambda row: row[1]):
                # begins as ZSTD, and no CDR
                is_packed = not self.is_ros1 and bytes(raw[:4]) in bag_path.MAGIC
                yield connection, time_ns, zstd.decompress(raw) if is_packed else raw


def message_type(connection: Connection) -> str:
    """Return the full name of the type; in bags from before 2019 ``msg`` is missing."""
    package, _, name = connection.msgtype.rpartition('/')
    return connection.msgtype if package.endswith('/msg') else f'{package}/msg/{name}'


def message_count(connections: Iterable[Connection]) -> int:
    """Return the messages that a bag states of connections."""
    return sum(connection.msgcount for connection in connections)


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
            names, counts = _read_metadata(path) if path.is_dir() else ([], {})
            files = _files(path, names) if path.is_dir() else [path]
            readers, damaged = [], []
            for file in files:
                try:
                    with reading(file):
                        readers.append(_open_file(file, stack))
                except SourceError as error:  # the other parts of the bag may be whole
                    damaged.append(error)
            if not readers:
                raise damaged[0]
            for reason in damaged:
                note_once(f'a part of {path} is left out: {reason}')
            bag = OpenBag(path, readers)
            _note_missing(bag, names, files, counts)
        yield bag


def _read_metadata(folder: Path) -> tuple[list[str], dict[str, int]]:
    """Return the names of the files, and the messages of each topic, by the metadata."""
    file = folder / METADATA
    if not file.exists():
        return [], {}
    content = file.read_bytes()
    try:
        information = YAML(typ='safe').load(content)['rosbag2_bagfile_information']
        names = [PureWindowsPath(path).name for path in information['relative_file_paths']]
        topics = information.get('topics_with_message_count') or []
        counts = {entry['topic_metadata']['name']: int(entry['message_count']) for entry in topics}
    except Exception as error:  # garbage raises errors of any type
        reason = f'{type(error).__name__}: {error}'.partition('\n')[0]
        note_once(f'{file} is damaged or of another program ({reason}): read without it')
        return [], {}
    return names, counts


def _files(folder: Path, names: list[str]) -> list[Path]:
    """Return the files of a bag that are present; without metadata, they are alike in name."""
    lower_names = {name.lower() for name in names}
    files = {file for file in folder.iterdir() if file.name.lower() in lower_names}
    if len(files) < len(names) or not names:  # perhaps renamed
        files.update(bag_path.storage_files(folder))
    others = {file.name.lower() for file in files if file.suffix.lower() != '.bag'}
    if not files or (not names and len({re.sub(r'_\d+\.', '.', name) for name in others}) > 1):
        raise SourceError(
            f'{folder} has no {METADATA} with the names of its files: expected exactly one .db3 '
            'or .mcap file then, or the parts of one bag, found '
            f'{", ".join(sorted(file.name for file in files)) or "none"}; name one of the files'
        )
    return sorted(files)


def _note_missing(
    bag: OpenBag, names: list[str], files: list[Path], counts: dict[str, int]
) -> None:
    """Log in one line what the metadata state and the files do not have."""
    topics, present = bag.topics, {file.name.lower() for file in files}
    notes = [f'{name} is missing' for name in names if name.lower() not in present]
    totals = {topic: message_count(topics.get(topic, [])) for topic in counts}
    rows = ((topic, totals[topic], count) for topic, count in counts.items())
    notes += [f'{topic} has {n} of {count} messages' for topic, n, count in rows if n < count]
    if notes:
        note_once(f'{bag.path} has less than its {METADATA} states: {", ".join(notes)}')


def _open_file(file: Path, stack: ExitStack) -> Any:
    """Return an open reader of one file, which the stack closes, or of a temporary copy."""
    # rosbags opens databases as immutable, without the logs of SQLite, and quotes no file names
    source, kind = file, storage_kind(file)
    logs = [Path(f'{file}{end}') for end in LOG_SUFFIXES]
    logs = [log for log in logs if log.exists() and log.stat().st_size]
    if logs or kind == ZSTD:
        source = _copy(file, logs, stack)
        kind = storage_kind(source)
    reader: Any
    if kind == '.bag':
        reader = Ros1Reader(source)
    elif kind == '.mcap':
        reader = McapReader(with_end(source, file))
    elif kind == '.db3':
        reader = Sqlite3Reader(Path(quote(os.fsencode(source))))
    else:
        raise SourceError(f'{file} is no bag: expected a database of SQLite, MCAP or ROS 1 .bag')
    reader.open()
    stack.callback(reader.close)
    return reader


def _copy(file: Path, logs: list[Path], stack: ExitStack) -> Path:
    """Return a copy of a file: with the writes of its logs, else decompressed."""
    try:
        target = Path(stack.enter_context(TemporaryDirectory(prefix='stavpr_bag_')), 'bag')
        if not logs:
            with zstd.open(file) as whole, target.open('wb') as copy:
                shutil.copyfileobj(whole, copy)
            return target
        for part in (file, *logs):
            shutil.copyfile(part, f'{target}{part.name.removeprefix(file.name)}')
        with closing(sqlite3.connect(target)) as database:
            # opening rolls a journal back; this writes a write-ahead log into the database
            database.execute('PRAGMA wal_checkpoint(TRUNCATE)').fetchall()
        return target
    except OSError as error:
        size = sum(part.stat().st_size for part in (file, *logs))
        writes = f'{logs[0].name} has writes that are not in it' if logs else 'it is compressed'
        raise SourceError(
            f'{file} needs a temporary copy of {size / 1e6:.0f} MB or more, as {writes}: '
            f'{error.strerror}; set TMPDIR to a folder with so much room that can be written'
        ) from error


@cache
def _store(is_ros1: bool) -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
    definitions = DEFINITIONS | ({FFMPEG: ROS1_FFMPEG} if is_ros1 else {})
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    return store
