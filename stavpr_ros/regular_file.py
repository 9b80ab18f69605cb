# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Opening a file by name without ever waiting for it or reading a device."""

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


def open_regular(path: str | Path) -> io.FileIO:
    """
    Open a regular file for reading, unbuffered; symbolic links are followed.

    :raises OSError: it does not exist, cannot be read, or is a pipe, a device, a folder.
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
    """
    Reject a name of anything but a regular file.

    :raises OSError: as :func:`open_regular`.
    """
    try:
        _require_regular(os.stat(path).st_mode)
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, str(error)) from error


def _require_regular(mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), 'special')
        raise OSError(errno.EINVAL, f'it is {kind}, expected a regular file')
