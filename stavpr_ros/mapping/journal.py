# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The journal of a recorded map: every place on disk while it is recorded.

The file is a sequence of records, see :func:`frame`. The first two are equal: a JSON object
(format, version, the map that the places continue), a newline, and a map file of one place, which
has the settings of the features. Each other record is a place, and their numbers increase. A
damaged record costs no other one: a record ends before the next valid head, whatever length its
own head claims.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
import fcntl
import io
from itertools import chain, pairwise
import json
import os
from pathlib import Path
import re
import struct
from typing import NamedTuple, Self
import zlib

import numpy as np
from stavpr_ros.errors import JournalError, StavprError, UnfitMapError
from stavpr_ros.features import LocalFeatures
from stavpr_ros.mapping.map_container import errors_of, MapFile, read_json
from stavpr_ros.mapping.map_content import require_jpegs, require_weights
from stavpr_ros.mapping.map_file import in_memory, map_of
from stavpr_ros.mapping.place_map import Map, Place
from stavpr_ros.mapping.stored_features import require_normalized
from stavpr_ros.regular_file import open_regular

FORMAT, VERSION = 'stavpr-journal', 3
SUFFIX = '.journal'
MAGIC = b'\x93SVJ'
PIECE = 2**20  # bytes searched at a time
SECTOR = 4096  # bytes skipped where the disk has an error
_HEAD = struct.Struct('<4sII')  # MAGIC, length and CRC-32 of the content; its own CRC-32 follows
_HEAD_BYTES = _HEAD.size + 4
_HEADS = re.compile(MAGIC + rb'(?=...[\0-\x0f])', re.DOTALL)  # records of at most 2**28 bytes


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

    :param number: number of its image, as the writer counts; increases from place to place.
    :param features: features of its image, strips (W, 1, d).
    :param thumbnail: a small JPEG, empty = none.
    """

    number: int
    place: Place
    features: LocalFeatures
    thumbnail: bytes

    def encode(self) -> bytes:
        """Return the content of its record."""
        stamp, identifier = self.place.stamp, self.place.identifier.encode()
        pose = np.nan if self.place.pose is None else self.place.pose
        strips, weights = self.features.strips[:, 0], self.features.weights[:, 0]
        row = np.zeros((), row_of(self.features))
        sizes = len(identifier), len(self.thumbnail)
        values = self.number, stamp, *sizes, pose, weights, strips
        for name, value in zip(row.dtype.names or (), values, strict=True):
            row[name] = value
        return b''.join((row.data, identifier, self.thumbnail))

    @classmethod
    def decode(cls, content: bytes, template: Map) -> Self:
        """
        Make a place of the content of its record.

        :param template: a map with the settings of the features.
        :raises ValueError: not of this format, or values that no map file has.
        :raises StavprError: likewise.
        """
        row = np.frombuffer(content, row_of(template.features), 1)[0]
        # older journals have a vector of the whole image before the identifier
        vector = len(content) - row.nbytes - int(row['of_id']) - int(row['of_thumbnail'])
        rest = content[row.nbytes + max(vector, 0) :]
        identifier, thumbnail = rest[: row['of_id']].decode(), rest[row['of_id'] :]
        if len(thumbnail) != row['of_thumbnail']:
            raise ValueError(f'its thumbnail has {len(thumbnail)} of {row["of_thumbnail"]} bytes')
        require_jpegs(np.frombuffer(thumbnail, np.uint8), np.array([len(thumbnail)]))
        require_weights(row['weights'])
        strips, weights = row['strips'].copy(), row['weights'].copy()
        require_normalized(strips, 'strips', 0)
        features = LocalFeatures(
            strips[:, None], weights[:, None], template.settings, template.features.cells
        )
        stamps, poses = np.array([row['stamp']]), row['pose'][None]
        places = Map(features, template.projection, stamps, (identifier,), poses)
        return cls(int(row['number']), places.place(0), features, thumbnail)


def row_of(features: LocalFeatures) -> np.dtype:
    """Return the fields of a place, all little-endian; identifier and thumbnail follow them."""
    W, d = features.settings.strips, features.dimension
    return np.dtype(
        [('number', '<i8'), ('stamp', '<i8'), ('of_id', '<u4'), ('of_thumbnail', '<u4'),
         ('pose', '<f8', 7), ('weights', '<f4', W), ('strips', '<f4', (W, d))]
    )  # fmt: skip


def frame(content: bytes) -> bytes:
    """
    Return a record: its head and its content, which is not empty.

    The head is ``MAGIC``, length and CRC-32 of the content, and the CRC-32 of these, each number
    a little-endian uint32.
    """
    head = _HEAD.pack(MAGIC, len(content), zlib.crc32(content))
    return b''.join((head, _checksum(head), content))


def _checksum(head: bytes) -> bytes:
    return zlib.crc32(head).to_bytes(4, 'little')


def header(base: Base, template: bytes, source: str = '') -> bytes:
    """
    Return the two equal records that begin a journal.

    :param template: file of a map of one place, with the settings of the features.
    :param source: name of the work that makes the places: only the same is resumed.
    """
    about = {'format': FORMAT, 'version': VERSION, 'source': source} | asdict(base)
    return 2 * frame(json.dumps(about).encode() + b'\n' + template)


class JournalReader:
    """
    A journal that no one writes; it stays locked until it is closed.

    ``base`` is the map that it continues, ``source`` what it was made of, ``template`` a map of
    one place with its settings (``template_content`` its file). ``start`` and ``end`` are where
    the content of the last whole record is, in bytes; ``problem`` the first damage that was found
    so far, '' = none.

    :raises JournalError: it cannot be read, or a living program writes it.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self.problem, self.start, self.end = Path(path), '', 0, 0
        try:
            self._file = open_regular(self.path)
        except OSError as error:
            raise JournalError(
                f'{path} cannot be read ({error.strerror}): name a journal'
            ) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._size = os.fstat(self._file.fileno()).st_size
            self._read_header()
        except BaseException as error:
            self.close()
            if isinstance(error, BlockingIOError):
                text = f'{path} is being written by a running program: end it first'
                raise JournalError(text) from error
            raise

    def __enter__(self) -> 'JournalReader':
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close and unlock the journal."""
        self._file.close()

    def places(self) -> Iterator[JournalPlace]:
        """Yield the places in the order in which they were recorded; skip what is damaged."""
        last = -1
        for content in self._records(self.begin):
            try:
                place = JournalPlace.decode(content, self.template)
                if place.number <= last:
                    raise ValueError(f'number {place.number} follows {last}')
            except (ValueError, StavprError) as error:
                problem = f'the place up to byte {self.end} is invalid: {error}'
                self.problem = self.problem or problem
                continue
            last = place.number
            yield place

    def _read_header(self) -> None:
        """Read the first of the two equal records that is whole."""
        records = self._records(0)
        content = next(records, b'')
        about, _, self.template_content = content.partition(b'\n')
        if not self.template_content:  # version 2: two records, one each
            self.template_content = next(records, b'')
        try:
            match read_json(about, 'its first record'):
                case {
                    'format': name, 'version': 2 | 3 as version, 'source': str(source),
                    'path': str(path), 'places': int(places), 'checksum': int(checksum),
                } if name == FORMAT:  # fmt: skip
                    self.source, self.base = source, Base(path, places, checksum)
                case _:
                    raise ValueError('another format or version')
            with io.FileIO(os.memfd_create('template'), 'r+b') as raw, errors_of(self.path):
                raw.write(self.template_content)
                self.template = in_memory(map_of(MapFile(raw, self.path)))
        except UnfitMapError as error:
            raise JournalError(str(error)) from error
        except (ValueError, OSError, StavprError) as error:
            raise JournalError(
                f'{self.path} is no journal, or its header is damaged ({error}): move it elsewhere'
            ) from error
        self.begin = self.end if version == 2 else 2 * len(frame(content))
        self.end, self.problem = self.begin, ''  # one of two records is enough

    def _records(self, at: int) -> Iterator[bytes]:
        """Yield the contents of whole records; each byte of the file is read at most twice."""
        heads = chain(self._heads(at), ((self._size, 0, 0),))
        for (begin, length, checksum), (following, _, _) in pairwise(heads):
            start = begin + _HEAD_BYTES
            content = self.read(start, length) if start + length <= following else b''
            if not content or zlib.crc32(content) != checksum:
                continue
            if begin > at:
                self.problem = self.problem or f'no whole record at byte {at}'
            self.start, self.end = start, start + length
            at = self.end
            yield content
        if at < self._size:
            self.problem = self.problem or f'no whole record at byte {at}'

    def _heads(self, at: int) -> Iterator[tuple[int, int, int]]:
        """Yield positions, lengths and checksums of the valid heads from a position on."""
        while at < self._size:
            try:
                at = os.lseek(self._file.fileno(), at, os.SEEK_DATA)
            except OSError:  # a hole up to the end
                return
            piece = self.read(at, PIECE)
            for match in _HEADS.finditer(piece):
                head = piece[match.start() : match.start() + _HEAD_BYTES]
                if head[_HEAD.size :] == _checksum(head[: _HEAD.size]):
                    _, length, checksum = _HEAD.unpack_from(head)
                    yield at + match.start(), length, checksum
            at += max(len(piece) - _HEAD_BYTES + 1, 1) if piece else SECTOR

    def read(self, at: int, count: int) -> bytes:
        """Return the bytes from a position on, fewer at the end or where the disk has an error."""
        with suppress(OSError):
            return os.pread(self._file.fileno(), max(0, min(count, self._size - at)), at)
        return b''
