# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writing the journal of a recorded map, on a thread of its own."""

from collections.abc import Callable, Iterable
from contextlib import suppress
import fcntl
from functools import partial
import os
from pathlib import Path
import tempfile
import threading
import time

from stavpr_ros.errors import JournalError, OutputError
from stavpr_ros.mapping.journal import Base, frame, header, JournalPlace, JournalReader, SUFFIX
from stavpr_ros.mapping.map_file import save_map
from stavpr_ros.mapping.place_map import Map
from stavpr_ros.output_file import create_temporary, explain, numbered_names, sync_folder, write_at

SYNC_PERIOD = 1.0  # seconds between syncs, and between attempts after an error
MAX_WAITING = 2**28  # most bytes that wait for room on the disk
SLACK = 2**24  # bytes of forgotten places, and half of the file, before it is rewritten
PIECE = 2**20  # bytes copied at a time


class JournalWriter:
    """
    Appends places to a journal; an error of the disk does not stop the recording.

    Places are written at once, and synced every second by another thread. While the disk is full
    they wait, and are written when there is room again. A journal that is removed from its folder
    is written anew. All calls must come from one thread.

    :param path: path of the journal; ``file`` its descriptor, locked.
    :param ends: ends of its header and of each place, bytes.
    :param begin: returns the header of a journal by its base.
    :param log: called with an error, once.

    ``failed`` is whether the disk is full: the last places are in memory only.
    """

    def __init__(
        self,
        path: Path,
        file: int,
        ends: Iterable[int],
        base: Base,
        begin: Callable[[Base], bytes],
        log: Callable[[str], object],
    ) -> None:
        self.path, self._file, self._ends = path, file, list(ends)
        self._base, self._begin, self._log = base, begin, log
        self._waiting: list[bytes] = []
        self._first = self._needed = 0  # numbers of the first place, and of the first one needed
        self._dirty = self.failed = self._rebased = self._closing = self._deleting = False
        self._condition = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='journal', daemon=True)
        self._thread.start()

    @classmethod
    def create(
        cls,
        target: str | Path,
        base: Base,
        template: Map,
        log: Callable[[str], object],
        source: str = '',
    ) -> 'JournalWriter':
        """
        Begin a journal.

        :param target: file that the map will be saved to; the journal is beside it.
        :param base: the map that the places continue.
        :param template: a map of one place with the settings of the features.
        :param source: what makes the places, see :func:`stavpr_ros.mapping.journal.header`.
        :raises JournalError: it cannot be created.
        """
        try:
            beside = Path(target).absolute().parent
            with tempfile.TemporaryDirectory(dir=beside, prefix='.journal-') as folder:
                save_map(template, Path(folder, 'map'))
                begin = partial(header, template=Path(folder, 'map').read_bytes(), source=source)
            path, file = _create(Path(target), begin(base))
        except (OSError, OutputError) as error:
            raise JournalError(
                f'no journal can be written beside {target} ({error}): make room, or name a '
                'file elsewhere'
            ) from error
        return cls(path, file, [len(begin(base))], base, begin, log)

    @classmethod
    def resume(
        cls, reader: JournalReader, log: Callable[[str], object]
    ) -> tuple['JournalWriter', int]:
        """
        Continue a journal behind its last whole place, or before its first damage.

        :param reader: reader of the journal; it is closed.
        :returns: the writer, and the number of that place, -1 = none.
        :raises OutputError: it cannot be written.
        """
        ends, last = [reader.begin], -1
        for place in reader.places():
            if reader.problem:
                break
            ends.append(reader.end)
            last = place.number
        begin = partial(header, template=reader.template_content, source=reader.source)
        head = begin(reader.base)
        with explain(reader.path):
            file = os.open(reader.path, os.O_RDWR | os.O_CLOEXEC)
            reader.close()
            fcntl.flock(file, fcntl.LOCK_EX)
            os.ftruncate(file, ends[-1])
            if len(head) == ends[0]:  # not of version 2; half of it may be damaged
                write_at(file, head, 0)
        return cls(reader.path, file, ends, reader.base, begin, log), last

    def append(self, place: JournalPlace) -> None:
        """Add a place: it is in the file when this returns, and synced a second later."""
        content = frame(place.encode())
        with self._condition:
            if len(self._ends) == 1 and not self._waiting:
                self._first = place.number
            full = self.failed and sum(map(len, self._waiting)) > MAX_WAITING
            self._waiting.append(b'' if full else content)  # the error is logged
            if not self.failed:
                self._write_waiting()

    def forget(self, until: int, base: Base | None = None) -> None:
        """
        Drop the first places, which were evicted or are in a map file.

        :param until: number of the first one that is needed; numbers count places.
        :param base: the map that the others continue now; None = as before.
        """
        with self._condition:
            self._needed = max(until, self._needed)
            if base is not None:
                self._base, self._rebased = base, True
                self._condition.notify()

    def close(self, delete: bool = False) -> None:
        """Sync everything, or delete the journal, and unlock it."""
        with self._condition:
            self._closing, self._deleting = True, delete
            self._condition.notify()
        self._thread.join()
        if delete and not self._is_removed():
            self.path.unlink(missing_ok=True)
        os.close(self._file)

    def _is_removed(self) -> bool:
        return not os.fstat(self._file).st_nlink

    def _write_waiting(self) -> None:
        """Write the places that wait; the lock is held."""
        try:
            write_at(self._file, b''.join(self._waiting), self._ends[-1])
        except OSError as error:
            self._report(error)
            return
        for content in self._waiting:
            self._ends.append(self._ends[-1] + len(content))
        self._waiting.clear()
        self._dirty = True

    def _run(self) -> None:
        """Sync, and rewrite the file where needed, every second."""
        closing = False
        while not closing:
            with self._condition:
                self._condition.wait_for(lambda: self._closing or self._rebased, SYNC_PERIOD)
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
                self.failed = bool(self._waiting)
            except (OSError, OutputError) as error:
                with self._condition:
                    self._report(error)
                    self._dirty = True
                time.sleep(0 if closing else SYNC_PERIOD)

    def _rewrite_if_needed(self) -> None:
        """Make a new file if the base changed, most places are forgotten, or it was removed."""
        with self._condition:
            # others that are forgotten may still wait
            count = min(max(0, self._needed - self._first), len(self._ends) - 1)
            begin, end = self._ends[count], self._ends[-1]
            base, rebased, removed = self._base, self._rebased, self._is_removed()
        if not (rebased or removed) and begin - self._ends[0] <= max(SLACK, end // 2):
            return
        head = self._begin(base)
        target = self.path.with_name(self.path.name.removesuffix(SUFFIX))
        path, file = _create(target, head) if removed else create_temporary(self.path)
        try:
            write_at(file, head, 0)
            self._copy(file, begin, end, len(head))
            os.fsync(file)
            with self._condition:
                self._copy(file, end, self._ends[-1], len(head) + end - begin)  # came meanwhile
                if removed:
                    self._log(f'{self.path} was removed: its places are written anew to {path}')
                    self.path = path
                else:
                    os.replace(path, self.path)
                os.close(self._file)
                self._file, self._dirty = file, True
                self._ends = [end - begin + len(head) for end in self._ends[count:]]
                self._first += count
                self._rebased = self._base != base
        except BaseException:
            path.unlink(missing_ok=True)
            os.close(file)
            raise
        sync_folder(self.path.parent)

    def _copy(self, file: int, begin: int, end: int, to: int) -> None:
        """Copy a part of this file to a position in another."""
        for at in range(begin, end, PIECE):
            write_at(file, os.pread(self._file, min(PIECE, end - at), at), at - begin + to)

    def _report(self, error: Exception) -> None:
        """Log an error, unless it lasts; the lock is held."""
        with suppress(OSError):
            os.ftruncate(self._file, self._ends[-1])  # a part of a place
        if not self.failed:
            self._log(
                f'the journal {self.path} cannot be written ({error}): places since then are in '
                'memory only; make room, or save the map elsewhere'
            )
        self.failed = True


def _create(target: Path, head: bytes) -> tuple[Path, int]:
    """Begin and lock the journal of a file, or of the first numbered name that has none."""
    target.parent.mkdir(parents=True, exist_ok=True)
    for path in numbered_names(target):
        journal = path.with_name(path.name + SUFFIX)
        with suppress(FileExistsError):
            file = os.open(journal, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            try:
                fcntl.flock(file, fcntl.LOCK_EX)
                write_at(file, head, 0)
                os.fsync(file)
                sync_folder(journal.parent)
            except OSError:
                journal.unlink()
                os.close(file)
                raise
            return journal, file
    raise AssertionError
