# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Opens bag files of every kind with rosbags, without writing beside them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
import math
from pathlib import Path
import shutil
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore
from stavpr_ros.errors import SourceError
from stavpr_ros.regular_file import require_regular
from stavpr_ros.sources.bag_path import METADATA, reading, storage_files
from stavpr_ros.sources.mcap import with_end
from stavpr_ros.sources.video_topic import DEFINITIONS, FFMPEG, FOXGLOVE, ROS1_FFMPEG
from stavpr_ros.units import SECOND

LOG_SUFFIXES = ('-wal', '-journal')
"""Files of SQLite beside a database with writes that are not in the database yet."""


@dataclass(frozen=True)
class OpenBag:
    """
    A bag that is open for reading.

    :param deserialize: (bytes, message type) to message. Only types of ``sensor_msgs`` and
        ``nav_msgs`` are read, equal in every distribution, and the ones of video topics, of which
        fields may follow: no definition in the bag is needed.
    """

    path: Path
    reader: Ros1Reader | Ros2Reader | AnyReader
    deserialize: Callable[[bytes, str], Any]

    def messages(
        self, connections: list[Connection], start: float = 0.0, duration: float = math.inf
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """
        Yield the messages of connections, with their times of recording, ns, in order.

        :param start: seconds after the start of the bag.
        :param duration: seconds from there on.
        """
        with reading(self.path):
            first = self.reader.start_time + round(start * SECOND)
            last = None if math.isinf(duration) else first + round(duration * SECOND)
            yield from self.reader.messages(connections, first if start else None, last)


def message_type(connection: Connection) -> str:
    """Return the full name of the type; in bags from before 2019 ``msg`` is missing."""
    package, _, name = connection.msgtype.rpartition('/')
    return connection.msgtype if package.endswith('/msg') else f'{package}/msg/{name}'


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """
    Open a bag for as long as the block runs.

    :param path: a ROS 1 .bag file, or a folder of the parts of a split one; a ROS 2 bag: its
        folder, or its .db3 or .mcap file.
    :raises SourceError: it cannot be read.
    """
    with TemporaryDirectory(prefix='stavpr_bag_') as scratch:
        with reading(path):
            reader: Ros1Reader | Ros2Reader | AnyReader
            deserialize: Callable[[bytes, str], Any]
            files = storage_files(path) if path.is_dir() else [path]
            if files and all(each.suffix.lower() == '.bag' and each.is_file() for each in files):
                links = [_stage_file(each, Path(scratch, f'{each.stem}.bag')) for each in files]
                reader = Ros1Reader(files[0]) if len(files) == 1 else AnyReader(links)
                deserialize = _ros1_store().deserialize_ros1
            else:
                staged = _stage(path, Path(scratch))
                staged = with_end(staged, path) if staged.suffix == '.mcap' else staged
                reader = Ros2Reader(staged)
                deserialize = _deserialize_cdr
            reader.open()
        try:
            yield OpenBag(path, reader, deserialize)
        finally:
            reader.close()


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


def _deserialize_cdr(raw: bytes, kind: str) -> Any:
    store = _ros2_store()
    if kind != FOXGLOVE:
        return store.deserialize_cdr(raw, kind)
    definition = store.get_msgdef(kind)  # without the check that no bytes are left
    read = definition.deserialize_cdr_le if raw[1] else definition.deserialize_cdr_be
    return read(raw[4:], 0, definition.cls, store)[0]


def _stage(path: Path, scratch: Path) -> Path:
    """
    Link (copy where needed) a bag into a scratch folder, and return the path to open there.

    rosbags opens databases as immutable: it writes nothing, but ignores the logs of SQLite; and it
    does not quote file names. A staged copy avoids both.
    """
    if path.is_file() or not (path / METADATA).exists():
        file = path if path.is_file() else _only_storage_file(path)
        return _stage_file(file, scratch / f'bag{file.suffix.lower()}')
    folder = scratch / 'bag'
    folder.mkdir()
    for file in path.iterdir():
        if file.is_file() and not file.name.endswith(LOG_SUFFIXES):
            _stage_file(file, folder / file.name)
    return folder


def _only_storage_file(folder: Path) -> Path:
    """Return the only file of a bag whose recording ended before its metadata was written."""
    files = storage_files(folder)
    if len(files) != 1:
        names = ', '.join(file.name for file in files) or 'none'
        raise SourceError(
            f'{folder} has no {METADATA}: expected exactly one .db3 or .mcap file then, found '
            f'{names}; run `ros2 bag reindex`, or name one of the files'
        )
    return files[0]


def _stage_file(file: Path, target: Path) -> Path:
    require_regular(file)  # a pipe would never end
    logs = [
        log
        for end in LOG_SUFFIXES
        if (log := Path(f'{file}{end}')).exists() and log.stat().st_size
    ]
    if target.suffix != '.db3' or not logs:
        target.symlink_to(file.resolve())
        return target
    shutil.copyfile(file, target)
    for log in logs:
        shutil.copyfile(log, f'{target}{log.name.removeprefix(file.name)}')
    database = sqlite3.connect(target)
    try:
        # opening rolls a journal back; this writes a write-ahead log into the database
        database.execute('PRAGMA wal_checkpoint(TRUNCATE)').fetchall()
    finally:
        database.close()
    return target
