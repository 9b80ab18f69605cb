# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
An open map file: manifest, and parts that are read by their position.

Nothing is mapped into memory: a mapped file that another program shortens ends the process.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import hashlib
import io
import json
import math
import os
from pathlib import Path
import time
from typing import Any
import weakref

import numpy as np
from stavpr_ros.errors import MapFileError, SettingsError, UnavailableError, UnfitMapError
from stavpr_ros.memory import aligned_empty

# Name of a type in safetensors files: its NumPy type; BF16 is only passed on.
DTYPES = {
    'F64': np.float64, 'I64': np.int64, 'U64': np.uint64, 'F32': np.float32, 'I32': np.int32,
    'U32': np.uint32, 'F16': np.float16, 'BF16': np.uint16, 'I16': np.int16, 'U16': np.uint16,
    'I8': np.int8, 'U8': np.uint8, 'BOOL': np.bool_,
}  # fmt: skip
PIECE = 2**22  # bytes that have one hash
AT_ONCE = 2**20  # bytes hashed at a time
BUILD_AGAIN = 'get it from a backup, or build it again'


@dataclass(frozen=True)
class Part:
    """
    An array in a file, or one to be written.

    :param dtype: key of :data:`DTYPES`.
    :param start: its first byte in the file.
    :param hashes: SHA-256 of every ``PIECE`` bytes.
    :param content: what to write: contiguous arrays, one after the other.
    """

    dtype: str
    shape: tuple[int, ...]
    start: int = 0
    hashes: Sequence[str] = ()
    content: Iterable[np.ndarray] = ()

    @property
    def size(self) -> int:
        """Return the number of bytes."""
        return math.prod(self.shape) * np.dtype(DTYPES[self.dtype]).itemsize

    @property
    def pieces(self) -> int:
        """Return the number of hashes."""
        return -(-self.size // PIECE)


class MapFile:
    """
    An open map file; it may be replaced or deleted meanwhile. Thread-safe.

    :param file: closed with this object.

    ``size`` is the number of bytes of the file when it was opened.
    """

    def __init__(self, file: io.FileIO, path: Path) -> None:
        self.path, self._file = path, file
        status = os.fstat(file.fileno())
        self.size, self._written = status.st_size, status.st_mtime_ns
        self.map_id = ''
        self.manifest: dict[str, Any] = {}
        self.parts: dict[str, Part] = {}
        weakref.finalize(self, file.close)

    @property
    def problem(self) -> str:
        """Return why nothing can be read any more, '' = the file is the one that was opened."""
        now = os.fstat(self._file.fileno())
        if (now.st_size, now.st_mtime_ns) == (self.size, self._written):
            return ''
        return (
            f'map {self.path} has been overwritten since it was opened: load it again (to replace '
            'a map in use, write another file and rename it, as `mv` does)'
        )

    def fill(self, array: np.ndarray, start: int) -> None:
        """
        Read bytes from a position on into a contiguous array.

        :raises MapFileError: the file is too short, or has been overwritten by another one.
        """
        view = array.reshape(-1).view(np.uint8).data if array.size else memoryview(b'')
        while len(view) and (count := os.preadv(self._file.fileno(), [view], start)):
            view, start = view[count:], start + count
        if self.problem:  # after reading, so that nothing later can have been read
            raise MapFileError(self.problem)
        if len(view):
            raise self.damage_error(f'is truncated: byte {start} is missing')

    def bytes_at(self, start: int, count: int) -> bytes:
        """Read bytes; they must be within the file, checked before memory is taken."""
        if start < 0 or count < 0 or start + count > self.size:
            raise self.damage_error(
                f'has {self.size} bytes, {count} from byte {start} on are missing: it is truncated'
            )
        content = np.empty(count, np.uint8)
        self.fill(content, start)
        return content.tobytes()

    def read(self, name: str) -> np.ndarray:
        """Read a part whole, checked, into memory that begins with a cache line."""
        part = self.parts[name]
        self.verify(name)
        content = aligned_empty((part.size,), np.uint8)
        self.fill(content, part.start)
        return content.view(DTYPES[part.dtype]).reshape(part.shape)

    def verify(self, *names: str, rest: Callable[[float], None] = lambda seconds: None) -> None:
        """
        Compare parts with their hashes, all without names.

        :param rest: called after every ``AT_ONCE`` bytes with the seconds that they took.
        :raises MapFileError: names the damaged part and where it is in the file.
        """
        for name in names or self.parts:
            part = self.parts[name]
            for i, sha256 in enumerate(part.hashes):
                start = part.start + i * PIECE
                end = min(start + PIECE, part.start + part.size)
                if self._hash(start, end, rest) != sha256:
                    raise self.damage_error(
                        f'is damaged: bytes {start} to {end}, of part {name}, do not match their '
                        'hash'
                    )

    def _hash(self, start: int, end: int, rest: Callable[[float], None]) -> str:
        digest, content = hashlib.sha256(), np.empty(min(AT_ONCE, end - start), np.uint8)
        for at in range(start, end, AT_ONCE):
            began, piece = time.perf_counter(), content[: min(AT_ONCE, end - at)]
            self.fill(piece, at)
            digest.update(piece.data)
            rest(time.perf_counter() - began)
        return digest.hexdigest()

    def require_whole(self) -> None:
        """Raise MapFileError if the file has holes: it claims more than there is."""
        try:
            hole = os.lseek(self._file.fileno(), 0, os.SEEK_HOLE)
        except (AttributeError, OSError):  # unknown to the operating or the file system
            return
        if hole < self.size:
            raise MapFileError(
                f'map {self.path} has a hole at byte {hole} (a sparse file): copy it with '
                f'cp --sparse=never, {BUILD_AGAIN}'
            )

    def damage_error(self, what: str) -> MapFileError:
        """Return the error for this file."""
        return MapFileError(f'map {self.path} {what}: {BUILD_AGAIN}')

    def foreign_error(self, why: str) -> MapFileError:
        """Return the error for a file of something else."""
        return MapFileError(
            f'{self.path} is no map, or a damaged one ({why}): build one with build_map'
        )


@contextmanager
def errors_of(path: Path) -> Iterator[None]:
    """
    Turn every error in the block into one that names the map file and a remedy.

    :raises MapFileError: the only error of any content.
    """
    try:
        yield
    except MapFileError:
        raise
    except FileNotFoundError as error:
        raise MapFileError(f'map {path} does not exist: make one with build_map') from error
    except (OSError, MemoryError) as error:
        reason = getattr(error, 'strerror', None) or 'not enough memory'
        raise MapFileError(f'map {path} cannot be read ({reason}): name a map file') from error
    except (SettingsError, UnavailableError) as error:  # the manifest is as it was written
        raise UnfitMapError(
            f'map {path} is of another version, or requires another package ({error}): install or '
            'update it'
        ) from error
    except Exception as error:
        raise MapFileError(
            f'map {path} is damaged or was not written by this program '
            f'({type(error).__name__}: {error}): {BUILD_AGAIN}'
        ) from error


def read_json(text: bytes, what: str) -> Any:
    """
    Parse JSON as strictly as it is written: UTF-8, no key twice, no NaN.

    :raises ValueError: names what it is.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        entries = dict(pairs)
        if len(entries) < len(pairs):
            raise ValueError('a key is there twice')
        return entries

    def constant(name: str) -> None:
        raise ValueError(f'{name} is no number')

    try:
        return json.loads(text.decode(), object_pairs_hook=once, parse_constant=constant)
    except RecursionError:
        raise ValueError(f'{what} is nested too deeply') from None
    except ValueError as error:
        raise ValueError(f'{what} is no JSON: {error}') from error
