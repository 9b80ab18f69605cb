# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write a file completely or not at all, and never over one of another program."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
import fcntl
import hashlib
import io
import itertools
import os
from pathlib import Path
import shutil
import stat
from typing import NamedTuple

from stavpr_ros.errors import OutputError, OutputTakenError
from stavpr_ros.regular_file import open_regular

HEAD = 4096  # first bytes of a file, enough to recognize its kind
WRITABLE = 0o222  # bits of a mode
MAX_NAME = 220  # bytes of a file's name; Linux takes 255, with the suffixes of journals


@dataclass(frozen=True)
class FileKind:
    """A kind of output file."""

    name: str  # in error messages
    matches: Callable[[bytes], bool]  # whether a file that begins with these bytes is of this kind


MAP = FileKind('map', lambda head: head[8:9] == b'{' and b'"stavpr-map"' in head)
RECORDING = FileKind('recording of matches', lambda head: head.startswith(b'{"stamp": '))
JSON = FileKind('JSON file', lambda head: head.lstrip()[:1] in (b'{', b'['))
PNG = FileKind('PNG image', lambda head: head.startswith(b'\x89PNG'))
NPY = FileKind('NumPy array', lambda head: head.startswith(b'\x93NUMPY'))
ANY = FileKind('file', lambda head: True)
ONNX = FileKind('ONNX file', lambda head: head[:1] == b'\x08')  # its first field: the version
HTML = FileKind('HTML page', lambda head: head.lstrip().lower().startswith(b'<!doctype html'))


def csv_kind(columns: list[str]) -> FileKind:
    """Return the kind of a CSV file with these names in its first line."""
    line = ','.join(columns).encode()
    return FileKind('CSV file with these columns', lambda head: head.startswith(line))


class FileVersion(NamedTuple):
    """Identity of a file as it was last written; this module makes another file each time."""

    device: int
    inode: int
    mtime_ns: int

    @classmethod
    def of(cls, path: str | Path) -> 'FileVersion | None':
        """Return the version of the file that is there now, None = none."""
        with suppress(OSError):
            there = os.stat(path)
            return cls(there.st_dev, there.st_ino, there.st_mtime_ns)
        return None


Force = bool | FileVersion  # whether to replace a file of the kind; a version: that file only


class AtomicFile(io.BufferedWriter):
    """A new file that takes its place when it is committed; see :func:`atomic_output`."""

    def __init__(self, path: str | Path, kind: FileKind, force: Force) -> None:
        require_replaceable(path, kind, force)
        self._target, self._kind, self._force = Path(os.path.realpath(path)), kind, force
        self.committed = False
        self._temporary, file = create_temporary(self._target)
        super().__init__(io.FileIO(file, 'r+'))
        with suppress(FileNotFoundError):
            there = os.stat(self._target)
            with suppress(PermissionError):
                os.fchown(file, there.st_uid, there.st_gid)
            os.fchmod(file, stat.S_IMODE(there.st_mode))

    def commit(self) -> None:
        """
        Sync the file, and let it replace its target the first time; writing may go on.

        :raises OutputTakenError: meanwhile the target came into being, or changed its kind.
        """
        self.flush()
        os.fsync(self.fileno())
        if not self.committed:
            require_replaceable(self._target, self._kind, self._force)
            os.replace(self._temporary, self._target)
            self.committed = True
            sync_folder(self._target.parent)

    def abandon(self) -> None:
        """Close the file without what is not flushed; delete it if it is not committed."""
        if not self.committed:
            self._temporary.unlink(missing_ok=True)
        self.raw.close()


@contextmanager
def atomic_output(path: str | Path, kind: FileKind, force: Force = False) -> Iterator[AtomicFile]:
    """
    Write a file; when the block ends it is complete under its name, or not there.

    Mode and owner of a file that is replaced are kept, and so is a symbolic link, whose target is
    replaced. File and folder are synced.

    :param force: replace an existing file of this kind; a version: only if it is that one.
    :raises OutputTakenError: the file exists, unless it may be replaced, or is being written.
    :raises OutputError: it cannot be written; what was there is untouched.
    """
    with explain(path):
        file = AtomicFile(path, kind, force)
        try:
            yield file
            if not file.closed:  # by the block, which abandoned it
                file.commit()
        finally:
            file.abandon()


def write_output(path: str | Path, content: str | bytes, kind: FileKind, force: Force) -> None:
    """Write a file at once, text as UTF-8; see :func:`atomic_output`."""
    with atomic_output(path, kind, force) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """
    Make a folder of files; when the block ends it is complete under its name, or not there.

    The block makes the folder that is yielded, of the same name in a temporary one, which is
    locked like the temporaries of :func:`atomic_output`. Files and folders are synced.

    :raises OutputTakenError: there is something of this name already, or it is being written.
    :raises OutputError: it cannot be written.
    """
    target = Path(os.path.abspath(path))
    with explain(path):
        require_room(target.parent / f'{target.name}.new')
        if os.path.lexists(target):
            raise OutputTakenError(
                f'{path} exists already: expected a new folder; remove it or choose another name'
            )
        temporary, lock = create_temporary(target, is_folder=True)
        new = temporary / target.name
        try:
            yield new
            for entry in (*new.iterdir(), new):
                sync_folder(entry)
            os.rename(new, target)  # fails where a file, or a folder with content, came meanwhile
            sync_folder(target.parent)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            os.close(lock)


def require_room(path: str | Path) -> None:
    """
    Reject a path at which no file can be made.

    :raises OutputError: it is a folder, its folder is missing or write-protected, or its name is
        too long.
    """
    if (size := len(os.fsencode(os.path.basename(path)))) > MAX_NAME:
        name = os.path.basename(path)[:60]
        raise OutputError(f'the name {name}... has {size} bytes: expected at most {MAX_NAME}')
    if os.path.isdir(path):
        raise OutputError(f'{path} is a folder: name a file in it')
    folder = os.path.dirname(os.path.realpath(path))
    if not os.path.isdir(folder):
        raise OutputError(f'the folder of {path} does not exist: make it first')
    if not os.access(folder, os.W_OK):
        raise OutputError(f'the folder of {path} is write-protected: name another')


def require_replaceable(path: str | Path, kind: FileKind, force: Force = False) -> None:
    """
    Reject a file that must not, or cannot, be written; for a check before long work.

    :raises OutputTakenError: it exists, and is no file of this kind, write-protected, or ``force``
        is not given.
    :raises OutputError: its folder is missing or write-protected.
    """
    if os.fspath(path) == '-':
        raise OutputError('-: only `record` writes to the standard output: name a file, as ./-')
    target = os.path.realpath(path)
    require_room(target)
    if not os.path.lexists(target):
        return
    with explain(path):
        mode = os.stat(target).st_mode
        if not stat.S_ISREG(mode):
            raise OutputTakenError(f'{path} exists and is no regular file: it is never replaced')
        if force and not (mode & WRITABLE and os.access(target, os.W_OK)):  # root may write all
            raise OutputTakenError(f'{path} is write-protected: chmod u+w, or name another file')
        with open_regular(target) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise _busy(path) from error
            head = file.read(HEAD)
    if head and not kind.matches(head):
        raise OutputTakenError(f'{path} exists and is no {kind.name}: it is never replaced')
    if force is not True and (force is False or force != FileVersion.of(target)):
        raise OutputTakenError(
            f'{path} exists already: choose another name, or replace it by --force (services: '
            'overwrite)'
        )


def _busy(path: str | Path) -> OutputTakenError:
    return OutputTakenError(
        f'{path} is being written by another program: wait, or name another file'
    )


def create_temporary(target: Path, is_folder: bool = False) -> tuple[Path, int]:
    """
    Create the temporary file, or folder, of a target, locked as long as it is open.

    A killed writer leaves one without a lock; such files in the same folder are deleted.

    :returns: its path, and its descriptor.
    :raises OutputTakenError: another program writes the target.
    """
    name = hashlib.sha256(os.fsencode(target.name)).hexdigest()[:12]
    temporary = target.parent / f'.stavpr-{name}'
    flags = os.O_RDONLY if is_folder else os.O_RDWR | os.O_CREAT | os.O_EXCL
    while True:
        _delete_stale(target.parent)
        try:
            if is_folder:
                temporary.mkdir()
            file = os.open(temporary, flags | os.O_CLOEXEC, 0o666)
        except FileExistsError as error:
            raise _busy(target) from error
        fcntl.flock(file, fcntl.LOCK_EX)
        if _is_at(temporary, file):
            return temporary, file
        os.close(file)  # another writer took it for a stale one before it was locked


def _delete_stale(folder: Path) -> None:
    """Delete the temporaries of killed writers: temporaries without a lock."""
    for path in folder.glob('.stavpr-' + '[0-9a-f]' * 12):
        with suppress(OSError):  # locked, gone, or of another user
            file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if _is_at(path, file):
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
            finally:
                os.close(file)


def _is_at(path: Path, file: int) -> bool:
    """Return whether an open file, or folder, is still the one of this name."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file), os.lstat(path))
    return False


def numbered_names(path: str | Path) -> Iterator[Path]:
    """Yield a path and the numbered names beside it: route.stavpr, route-2.stavpr ..."""
    path = Path(path)
    yield path
    yield from (path.with_stem(f'{path.stem}-{number}') for number in itertools.count(2))


def write_at(file: int, content: bytes | memoryview, offset: int) -> None:
    """Write all bytes at an offset of an open file; the system may take them in parts."""
    rest = memoryview(content)
    while rest:
        count = os.pwrite(file, rest, offset)
        rest, offset = rest[count:], offset + count


def sync_folder(folder: Path) -> None:
    """Write the names in a folder, or the content of a file, to the disk."""
    file = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(file)
    finally:
        os.close(file)


@contextmanager
def explain(path: str | Path) -> Iterator[None]:
    """
    Turn an error of the operating system into one that names the file that is being written.

    :raises OutputError: for every OSError of the block.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(
            f'{path} cannot be written ({error.strerror or error}); what was there is untouched'
        ) from error
