# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The journal of a recorded map: every place on disk while it is recorded.

The file is a sequence of records: length and CRC-32 of the content (two uint32, little-endian),
and the content. The first one is a JSON object (format, version, the map that the places
continue), the second a map file of one place, which holds the settings of the features; each other
record is a place. A record that was cut off or damaged ends the journal: those before it count.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
import fcntl
import itertools
import json
import os
from pathlib import Path
import stat
import struct
import tempfile
from typing import BinaryIO, NamedTuple, Self
import zlib

import numpy as np
from stavpr_ros.errors import JournalError, OutputTakenError, StavprError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping.growing_map import GrowingMap
from stavpr_ros.mapping.map_file import load_map, open_map, save_map
from stavpr_ros.mapping.place_map import Place, PlaceMap
from stavpr_ros.output_file import FileVersion
import torch

FORMAT, VERSION = 'stavpr-journal', 1
SUFFIX = '.journal'
LONGEST = 2**28  # bytes of a record; a longer one is damaged
_FRAME = struct.Struct('<II')
_PLACE = struct.Struct('<qqHIB7d')  # number, stamp, lengths of id and thumbnail, has pose, pose
_NO_POSE = (np.nan,) * 7


@dataclass(frozen=True)
class Base:
    """
    The map that the places of a journal continue.

    :param path: its file; '' = none.
    :param places: their number.
    :param checksum: CRC-32 of their stamps.
    """

    path: str = ''
    places: int = 0
    checksum: int = 0

    @classmethod
    def of(cls, path: str, stamps: np.ndarray) -> 'Base':
        """Describe a map file by the stamps of its places, int64."""
        stamps = np.ascontiguousarray(stamps, '<i8')
        return cls(os.path.abspath(path), len(stamps), zlib.crc32(stamps.data))


class JournalPlace(NamedTuple):
    """
    A place in a journal.

    :param number: of its image, as the writer counts them.
    :param strips, weights: of its features, shapes (W, d) and (W,), float32.
    :param vector: of its features, shape (D,), float32; D = 0 without one.
    """

    number: int
    stamp: int
    identifier: str
    pose: np.ndarray | None
    strips: np.ndarray
    weights: np.ndarray
    thumbnail: bytes
    vector: np.ndarray = np.empty(0, np.float32)

    @classmethod
    def of(cls, number: int, place: Place, features: LocalFeatures, thumbnail: bytes) -> Self:
        """
        Make the record of a place.

        :param features: of its image, strips (W, 1, d).
        """
        features = features.to('cpu')
        return cls(
            number,
            place.stamp,
            place.identifier,
            place.pose,
            features.strips[:, 0].numpy(),
            features.weights[:, 0].numpy(),
            thumbnail,
            *(() if features.vectors is None else (features.vectors[0].numpy(),)),
        )

    def encode(self) -> bytes:
        """Return the content of its record."""
        identifier = self.identifier.encode()
        pose = _NO_POSE if self.pose is None else self.pose
        head = _PLACE.pack(
            self.number,
            self.stamp,
            len(identifier),
            len(self.thumbnail),
            self.pose is not None,
            *pose,
        )
        strips, weights, vector = (
            np.ascontiguousarray(a, '<f4') for a in (self.strips, self.weights, self.vector)
        )
        features = weights.data, strips.data, vector.data
        return b''.join((head, *features, identifier, self.thumbnail))


def frame(content: bytes) -> bytes:
    """Return a record: length, checksum and content."""
    return _FRAME.pack(len(content), zlib.crc32(content)) + content


def header(base: Base, template: bytes, source: str = '') -> bytes:
    """
    Return the two records that begin a journal.

    :param template: file of a map of one place, with the settings of the features.
    :param source: of the places, so that only the same work is resumed.
    """
    about = {'format': FORMAT, 'version': VERSION, 'base': asdict(base), 'source': source}
    return frame(json.dumps(about).encode()) + frame(template)


def map_bytes(place_map: PlaceMap) -> bytes:
    """
    Return the file of a map.

    :raises OutputError: there is no room for a temporary file.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'map')
        save_map(place_map, path)
        return path.read_bytes()


class JournalReader:
    """
    A journal that no one writes; it stays locked until it is closed.

    ``base`` is the map that it continues, ``source`` what it was made of, ``template`` a map of
    one place with its settings (``template_content`` its file), ``size`` the number of bytes up to
    the end of the last whole record that was read.

    :raises JournalError: it cannot be read, or a living program writes it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file = _open_locked(self.path)
        try:
            self._left = os.fstat(self._file.fileno()).st_size
            self.size = 0
            self.base, self.template = self._header()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> 'JournalReader':
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close and unlock the journal."""
        self._file.close()

    def places(self) -> Iterator[JournalPlace]:
        """Yield the places, once, in the order in which they were recorded."""
        W, d = self.template.settings.strips, self.template.dimension
        vectors = self.template.features.vectors
        D = 0 if vectors is None else vectors.shape[1]
        count = W * (d + 1) + D
        while (content := self._record()) is not None:
            number, stamp, of_id, of_thumbnail, has_pose, *pose = _PLACE.unpack_from(content)
            rest = content[_PLACE.size + 4 * count :]
            if len(rest) != of_id + of_thumbnail:
                raise JournalError(f'{self.path} has records of another version: update')
            values = np.frombuffer(content, '<f4', count, _PLACE.size)
            yield JournalPlace(
                number,
                stamp,
                rest[:of_id].decode(),
                np.array(pose) if has_pose else None,
                values[W : W * (d + 1)].reshape(W, d),
                values[:W],
                rest[of_id:],
                values[W * (d + 1) :],
            )

    def _header(self) -> tuple[Base, PlaceMap]:
        """Read the two records of the header."""
        try:
            about = json.loads(self._record() or b'')
            if about['format'] != FORMAT or about['version'] != VERSION:
                raise ValueError('another format or version')
            base, self.source = Base(**about['base']), str(about['source'])
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, 'template')
                self.template_content = self._record() or b''
                path.write_bytes(self.template_content)
                return base, load_map(path)
        except (ValueError, KeyError, TypeError, StavprError) as error:
            raise JournalError(
                f'{self.path} is no journal, or was cut off before its first place ({error})'
            ) from error

    def _record(self) -> bytes | None:
        """Return the content of the next record, None at the end, or at a damaged one."""
        head = self._file.read(_FRAME.size)
        if len(head) < _FRAME.size:
            return None
        length, checksum = _FRAME.unpack(head)
        if length > min(LONGEST, self._left):
            return None
        content = self._file.read(length)
        if len(content) < length or zlib.crc32(content) != checksum:
            return None
        self.size += _FRAME.size + length
        return content


def _open_locked(path: Path) -> BinaryIO:
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise JournalError(f'{path} cannot be read ({error.strerror}): name a journal') from error
    file = os.fdopen(number, 'rb')
    try:
        if not stat.S_ISREG(os.fstat(number).st_mode):
            raise JournalError(f'{path} is no regular file: name a journal')
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise JournalError(
            f'{path} is being written by a running program: end it first'
        ) from error
    except BaseException:
        file.close()
        raise
    return file


# ------------------------------------------------------------------------------------- recovering


@dataclass(frozen=True)
class Recovered:
    """
    A map made of a journal.

    :param path: the map's file.
    :param places: all of its places; ``recorded`` of them are from the journal.
    :param problem: why the map that they continue is not part of it, '' = it is, or there is none.
    """

    path: str
    places: int
    recorded: int
    problem: str = ''


def journals(target: str | Path) -> list[Path]:
    """Return the journals of a map and of its numbered names, oldest first."""
    target = Path(target)
    pattern = f'{target.stem}*{target.suffix}{SUFFIX}'
    try:
        found = [path for path in target.parent.glob(pattern) if _names(target, path)]
        return sorted(found, key=lambda path: path.stat().st_mtime)
    except OSError:
        return []


def _names(target: Path, journal: Path) -> bool:
    """Return whether a journal is of a map, or of a numbered name beside it."""
    number = Path(journal.name.removesuffix(SUFFIX)).stem.removeprefix(target.stem)
    return not number or (number[0] == '-' and number[1:].isdigit())


def numbered(path: str | Path) -> Iterator[Path]:
    """Yield a path and the numbered names beside it: route.stavpr, route-2.stavpr ..."""
    path = Path(path)
    yield path
    yield from (path.with_stem(f'{path.stem}-{number}') for number in itertools.count(2))


def recover(journal: str | Path, output: str | Path | None = None) -> Recovered:
    """
    Make a map of the places in a journal and of the map that they continue; delete the journal.

    :param output: file of the map, which must not exist; None = the journal's name without its
        suffix. That may be the map that is continued, which is replaced then; beside another map,
        a numbered name is taken.
    :raises JournalError: no journal, one without places, or one that is being written.
    :raises OutputError: the map cannot be written; the journal stays.
    """
    journal = Path(journal)
    with JournalReader(journal) as reader:
        base, problem = _base_map(reader.base)
        places = _with_places(base or reader.template, reader, base is not None)
        if not len(places):
            raise JournalError(f'{journal} has no places: delete it')
        recorded = len(places) - len(base or ())
        place_map = places.snapshot()
        if output is None:
            output = _save_beside(place_map, journal.with_name(journal.name.removesuffix(SUFFIX)))
        else:
            save_map(place_map, output)
        journal.unlink()
    return Recovered(str(output), len(place_map), recorded, problem)


def _base_map(base: Base) -> tuple[PlaceMap | None, str]:
    """Return the map that a journal continues, or None and why it is missing."""
    if not base.places:
        return None, ''
    try:
        place_map = load_map(base.path)
    except StavprError as error:
        return None, str(error)
    if Base.of(base.path, place_map.stamps[: base.places]) != base:
        return None, f'{base.path} is another map than the one that was continued'
    return place_map, ''


def _with_places(start: PlaceMap, reader: JournalReader, continued: bool) -> GrowingMap:
    """Return the places of a map, if it is continued, and those of a journal behind it."""
    limit = 2**31
    if continued:
        growing = GrowingMap.from_map(start, limit)
    else:
        growing = GrowingMap(start.settings, start.projection, limit, start.features.cells)
    # a map that was saved just before the end has the first places of its journal already
    saved = start.stamps[reader.base.places :].tolist() if continued else []
    for i, place in enumerate(reader.places()):
        if i < len(saved) and saved[i] == place.stamp:
            continue
        saved = []
        features = LocalFeatures(
            torch.from_numpy(place.strips[:, None].copy()),
            torch.from_numpy(place.weights[:, None].copy()),
            start.settings,
            vectors=torch.from_numpy(place.vector[None].copy()) if place.vector.size else None,
        )
        growing.add(features, place.stamp, place.identifier, place.pose, place.thumbnail)
    return growing


def _save_beside(place_map: PlaceMap, target: Path) -> Path:
    """Save a map under a name that is free, or that holds an earlier state of it."""
    for path in numbered(target):
        version = FileVersion.of(path)
        try:
            force = version if version and _begins(path, place_map) else False
            save_map(place_map, path, force=force)
            return path
        except OutputTakenError:
            continue
    raise AssertionError


def _begins(path: Path, place_map: PlaceMap) -> bool:
    """Return whether a file is a map of the first places of this one."""
    try:
        stamps = open_map(path).stamps
    except StavprError:
        return False
    return np.array_equal(stamps, place_map.stamps[: len(stamps)])
