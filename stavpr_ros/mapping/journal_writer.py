# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writing the journal of a recorded map, on a thread of its own."""

from array import array
from collections.abc import Callable, Iterable
from contextlib import suppress
import fcntl
import os
from pathlib import Path
import threading
import time

from stavpr_ros.errors import JournalError, OutputError
from stavpr_ros.mapping.journal import (
    Base,
    frame,
    header,
    JournalPlace,
    JournalReader,
    map_bytes,
    numbered,
    SUFFIX,
)
from stavpr_ros.mapping.place_map import PlaceMap
from stavpr_ros.output_file import create_temporary, sync_folder

SYNC_PERIOD = 1.0  # seconds between syncs, and between attempts after an error
WAITING = 2**28  # most bytes that wait for room on the disk
SLACK = 2**24  # bytes of forgotten places, and half of the file, before it is rewritten
PIECE = 2**20  # bytes copied at a time


class JournalWriter:
    """
    Appends places to a journal; an error of the disk does not stop the recording.

    Places are written at once, and synced every second by another thread. While the disk is full
    they wait, and are written when there is room again. All calls must come from one thread.

    :param path: of the journal; ``file`` its descriptor, locked, ``ends`` the end of each place.
    :param start: size of its header, which ``base``, ``template`` and ``source`` are in, see
        :func:`stavpr_ros.mapping.journal.header`.
    :param log: called with an error, once.
    """

    def __init__(
        self,
        path: Path,
        file: int,
        start: int,
        ends: Iterable[int],
        base: Base,
        template: bytes,
        source: str,
        log: Callable[[str], object],
    ) -> None:
        self.path, self._file, self._start = path, file, start
        self._ends = array('q', ends)
        self._size = self._ends[-1] if self._ends else start
        self._base, self._template, self._source, self._log = base, template, source, log
        self._waiting: list[bytes] = []
        self._forgotten = 0  # of the places in the file and of those that wait
        self._dirty = self._problem = False
        self._rebased = self._closing = self._deleting = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='journal', daemon=True)
        self._thread.start()

    @classmethod
    def create(
        cls,
        target: str | Path,
        base: Base,
        template: PlaceMap,
        log: Callable[[str], object],
        source: str = '',
    ) -> 'JournalWriter':
        """
        Begin a journal.

        :param target: file that the map will be saved to; the journal is beside it.
        :param base: the map that the places continue.
        :param template: a map of one place with the settings of the features.
        :raises JournalError: it cannot be created.
        """
        try:
            content = map_bytes(template)
            begin = header(base, content, source)
            path, file = _create(Path(target))
            _write(file, begin, 0)
            os.fsync(file)
            sync_folder(path.parent)
        except (OSError, OutputError) as error:
            raise JournalError(
                f'no journal can be written beside {target} ({error}): make room, or set another '
                'save_path'
            ) from error
        return cls(path, file, len(begin), (), base, content, source, log)

    @classmethod
    def resume(
        cls, reader: JournalReader, log: Callable[[str], object]
    ) -> tuple['JournalWriter', int]:
        """
        Continue a journal behind its last whole place.

        :param reader: of the journal; it is closed.
        :returns: the writer, and the number of that place, -1 = none.
        """
        start, last, ends = reader.size, -1, array('q')
        for place in reader.places():
            ends.append(reader.size)
            last = place.number
        size = ends[-1] if ends else start
        file = os.open(reader.path, os.O_RDWR | os.O_CLOEXEC)
        reader.close()
        fcntl.flock(file, fcntl.LOCK_EX)
        os.ftruncate(file, size)
        made = cls(
            reader.path,
            file,
            start,
            ends,
            reader.base,
            reader.template_content,
            reader.source,
            log,
        )
        return made, last

    @property
    def failed(self) -> bool:
        """Return whether the disk is full: the last places are in memory only."""
        return self._problem

    def append(self, place: JournalPlace) -> None:
        """Add a place: it is in the file when this returns, and synced a second later."""
        content = frame(place.encode())
        with self._changed:
            full = self._problem and sum(map(len, self._waiting)) > WAITING
            self._waiting.append(b'' if full else content)  # the error is logged
            if not self._problem:
                self._write_waiting()

    def forget(self, count: int, base: Base | None = None) -> None:
        """
        Drop the first places, which were evicted or are in a map file.

        :param base: the map that the others continue now; None = as before.
        """
        with self._changed:
            self._forgotten += count
            if base is not None:
                self._base, self._rebased = base, True
                self._changed.notify()

    def close(self, delete: bool = False) -> None:
        """Sync everything, or delete the journal, and unlock it."""
        with self._changed:
            self._closing, self._deleting = True, delete
            self._changed.notify()
        self._thread.join()
        if delete:
            self.path.unlink(missing_ok=True)
        os.close(self._file)

    def _write_waiting(self) -> None:
        """Write the places that wait; the lock is held."""
        try:
            _write(self._file, b''.join(self._waiting), self._size)
        except OSError as error:
            self._report(error)
            return
        for content in self._waiting:
            self._size += len(content)
            self._ends.append(self._size)
        self._waiting.clear()
        self._dirty, self._problem = True, False

    def _run(self) -> None:
        """Sync, and rewrite the file where needed, every second."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._rebased, SYNC_PERIOD)
                if self._deleting:
                    return
                closing = self._closing
                if self._waiting:
                    self._write_waiting()
                dirty, self._dirty = self._dirty, False
            try:
                if dirty:
                    os.fsync(self._file)
                self._rewrite_if_needed()
            except (OSError, OutputError) as error:
                with self._changed:
                    self._report(error)
                    self._dirty = True
                time.sleep(0 if closing else SYNC_PERIOD)
            if closing:
                return

    def _rewrite_if_needed(self) -> None:
        """Make a new file of the places that are still needed, if the base changed or many go."""
        with self._changed:
            # some of the forgotten ones may still wait
            count, base, rebased = min(self._forgotten, len(self._ends)), self._base, self._rebased
            begin, end = self._ends[count - 1] if count else self._start, self._size
        if not rebased and begin - self._start <= max(SLACK, end // 2):
            return
        content = header(base, self._template, self._source)
        temporary, file = create_temporary(self.path)
        try:
            _write(file, content, 0)
            moved = begin - len(content)
            self._copy(file, begin, end, moved)
            os.fsync(file)
            with self._changed:
                self._copy(file, end, self._size, moved)  # places that came meanwhile
                os.replace(temporary, self.path)
                os.close(self._file)
                self._file, self._dirty = file, True
                self._ends = array('q', (end - moved for end in self._ends[count:]))
                self._start, self._size = len(content), self._size - moved
                self._forgotten -= count
                self._rebased = self._base != base
        except BaseException:
            temporary.unlink(missing_ok=True)
            os.close(file)
            raise
        sync_folder(self.path.parent)

    def _copy(self, file: int, begin: int, end: int, moved: int) -> None:
        """Copy a part of this file to another, ``moved`` bytes nearer to its start."""
        for at in range(begin, end, PIECE):
            _write(file, os.pread(self._file, min(PIECE, end - at), at), at - moved)

    def _report(self, error: Exception) -> None:
        """Log an error, unless it lasts; the lock is held."""
        with suppress(OSError):
            os.ftruncate(self._file, self._size)  # a part of a place
        if not self._problem:
            self._log(
                f'the journal {self.path} cannot be written ({error}): places since then are in '
                'memory only; make room, or save the map elsewhere'
            )
        self._problem = True


def _create(target: Path) -> tuple[Path, int]:
    """Create and lock the journal of a file, or of the first numbered name that has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    for path in numbered(target):
        journal = path.with_name(path.name + SUFFIX)
        with suppress(FileExistsError):
            file = os.open(journal, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            fcntl.flock(file, fcntl.LOCK_EX)
            return journal, file
    raise AssertionError


def _write(file: int, content: bytes, offset: int) -> None:
    """Write all bytes at an offset; the system may take them in parts."""
    rest = memoryview(content)
    while rest:
        written = os.pwrite(file, rest, offset)
        rest, offset = rest[written:], offset + written
