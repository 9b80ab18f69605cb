# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""MCAP files that rosbags refuses: of another profile, or without an end after a power loss."""

from io import BufferedReader, RawIOBase
from pathlib import Path, PosixPath
from typing import Any

from stavpr_ros.errors import SourceError
from stavpr_ros.sources.notes import note_once

MAGIC = b'\x89MCAP0\r\n'
DATA_END, FOOTER = 0x0F, 0x02  # codes of records: a byte, eight bytes of length, and content
HEAD, BLOCK = 9, 4096
END = b'\x0f\x04' + bytes(11) + b'\x02\x14' + bytes(27) + MAGIC  # without a summary


def with_end(staged: Path, path: Path) -> Path:
    """
    Return the path to open an MCAP by: its whole records and an end, if it has none.

    :param staged: the link to the file.
    :param path: the file, for messages.
    :raises SourceError: it is of another profile than ros2.
    """
    size, at = staged.stat().st_size, len(MAGIC)
    with staged.open('rb') as file:
        start = file.read(at + HEAD + 100)
        profile = start[at + HEAD + 4 :][: start[at + HEAD] if len(start) > at + HEAD else 0]
        if start[: at + 1] != MAGIC + b'\x01':
            return staged  # no MCAP
        if profile != b'ros2':
            raise SourceError(
                f'{path} is an MCAP of profile {profile.decode(errors="replace")!r}: expected '
                'ros2; give the bag that it was made of, or convert it to a bag of ROS 2'
            )
        file.seek(size - at)
        if file.read() == MAGIC:
            return staged
        while size > BLOCK and file.seek(size - BLOCK) and not any(file.read(BLOCK)):
            size -= BLOCK  # room that was allocated and not written
        while len(head := file.read(HEAD) if file.seek(at) else b'') == HEAD:
            end = at + HEAD + int.from_bytes(head[1:], 'little')
            if end > size or head[0] in (0, DATA_END, FOOTER):
                break
            at = end
    note_once(
        f'{path} has no end, as after a power loss: its whole records are read, all but the last '
        f'{size - at} bytes; `mcap recover` makes a file with an index'
    )
    cut = _CutPath(staged)
    cut.size = at
    return cut


class _CutPath(PosixPath):
    """The path of a file that is read up to ``size``, with an end behind it."""

    size: int

    def open(self, *_: Any, **__: Any) -> Any:
        return BufferedReader(_Cut(Path(self), self.size))


class _Cut(RawIOBase):
    def __init__(self, path: Path, size: int) -> None:
        self._file, self._size, self._at = path.open('rb'), size, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = (0, self._at, self._size + len(END))[whence] + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        rest = self._size - self._at
        self._file.seek(self._at)
        data = self._file.read(min(len(buffer), rest)) if rest > 0 else END[-rest:][: len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
