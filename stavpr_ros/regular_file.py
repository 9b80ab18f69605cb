# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Opening a file by name: no device, nothing that waits, and no pointer to its content."""

import errno
import io
import os
from pathlib import Path
import stat

_KINDS = {
    stat.S_IFDIR: 'a folder',
    stat.S_IFIFO: 'a pipe',
    stat.S_IFSOCK: 'a socket',
    stat.S_IFCHR: 'a device',
    stat.S_IFBLK: 'a device',
}
POINTERS = {
    b'version https://git-lfs': 'a pointer of Git LFS instead of the content: run `git lfs pull`',
    b'/annex/objects/': 'a pointer of git-annex instead of the content: run `git annex get`',
}
"""The first bytes of files that replace others, and what to do."""
MAX_POINTER, MAX_TARGET = 1024, 60  # bytes, characters


class ElsewhereError(OSError):
    """The content of a file is not on this machine."""


def elsewhere(path: str | Path) -> str:
    """Return what replaces the content of a file, and what to do; '' = it is here or unknown."""
    path = Path(path)
    if path.is_symlink() and not path.exists():
        target = os.readlink(path)
        remedy = 'run `git annex get`' if '/annex/' in target else 'copy the file'
        return f'a link into nothing, {target[-MAX_TARGET:]}: {remedy}'
    if path.is_file() and path.stat().st_size <= MAX_POINTER:
        content = path.read_bytes()
        return next((text for first, text in POINTERS.items() if content.startswith(first)), '')
    return ''


def home_folder() -> Path:
    """Return the home of the user, ``/`` of one without, as containers have it."""
    home = Path(os.path.expanduser('~'))
    return home if home.is_absolute() else Path('/')


def open_regular(path: str | Path) -> io.FileIO:
    """
    Open a regular file for reading, unbuffered; symbolic links are followed.

    :raises OSError: it does not exist, cannot be read, or is a pipe, a device, a folder; an
        :class:`ElsewhereError` if its content is not on this machine.
    """
    require_regular(path)  # before it is opened: opening alone can have an effect on devices
    file = io.FileIO(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), 'rb')
    try:
        _require_regular(os.fstat(file.fileno()).st_mode)  # it may have been replaced
    except BaseException:
        file.close()
        raise
    return file


def require_regular(path: str | Path) -> None:
    """Raise OSError, as :func:`open_regular` does, if a name is of no regular file."""
    try:
        if text := elsewhere(path):
            raise ElsewhereError(errno.ENOENT, f'it is {text}')
        _require_regular(os.stat(path).st_mode)
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, str(error)) from error


def _require_regular(mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), 'special')
        raise OSError(errno.EINVAL, f'it is {kind}, expected a regular file')
