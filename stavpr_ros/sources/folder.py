# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A folder of image files as a sequence."""

from collections.abc import Callable, Iterator
import math
import os
from pathlib import Path
import re

import numpy as np
from stavpr_ros.errors import ImageError, InputError, SourceError
from stavpr_ros.sources.files import decode_file
from stavpr_ros.sources.frame import Frame, ImageRecord
from stavpr_ros.units import SECOND

SUFFIXES = frozenset({'.jpg', '.jpeg', '.png', '.bmp', '.tif', '.tiff', '.pgm', '.ppm', '.webp'})


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Return a sort key with ``2.jpg`` before ``10.jpg`` (and ``01`` before ``1``)."""
    # the parts alternate between text and number: equal positions have equal types
    parts = re.split(r'(\d+)', name)
    return [int(part) if i % 2 else part.casefold() for i, part in enumerate(parts)], name


def text_of(path: str | Path) -> str:
    """Return a path or name as printable text; bytes that are no UTF-8 are replaced."""
    return os.fsencode(path).decode('utf-8', 'replace')


class FolderSource:
    """
    The images of a folder in natural order, or of its sub-folders if it has none itself.

    Sub-folders, at any depth, are in natural order too, one after the other. Hidden files and
    folders are left out. Iterating yields :class:`Frame` with an unknown stamp and, as identifier,
    the file's name, in a sub-folder its path from the folder.

    :param on_error: called with the :class:`ImageError` of a file that cannot be read, which is
        then skipped; without it the error is raised.
    :raises SourceError: there is no such folder, or no image in it and its sub-folders.
    """

    def __init__(
        self, path: str | Path, on_error: Callable[[ImageError], None] | None = None
    ) -> None:
        self.path = Path(path)
        self.on_error = on_error
        try:
            files = [file for file in self.path.iterdir() if _is_image(file)]
            files = files or _images_below(self.path)
        except OSError as error:
            raise SourceError(
                f'{self.path} cannot be listed: {error.strerror}; check its name and permissions'
            ) from error
        if not files:
            expected = ' '.join(sorted(SUFFIXES))
            raise SourceError(
                f'{self.path} has no images: expected files ending in {expected}, there or in '
                'sub-folders'
            )
        self.files: list[Path] = sorted(files, key=self._order)

    def __len__(self) -> int:
        """Return the number of image files, readable or not."""
        return len(self.files)

    def __iter__(self) -> Iterator[Frame]:
        """Decode one file after the other."""
        for _, frame in self._numbered():
            yield frame

    def records(
        self, frames_per_second: float, start: float = 0.0, duration: float = math.inf
    ) -> Iterator[ImageRecord]:
        """
        Yield the images as messages; file i, from 1, has the stamp i / frames_per_second.

        :param frames_per_second: assumed frame rate, above 0.
        :param start: seconds after the first file.
        :param duration: seconds from there on.
        """
        if not frames_per_second > 0:
            raise InputError(f'{frames_per_second} frames per second: expected more than 0')
        # the last instant before a file counts as its own: i / 10 is not exact
        first, last = (
            math.ceil(min(t * frames_per_second - 1e-6, len(self)))
            for t in (start, start + duration)
        )
        for i, frame in self._numbered(max(first, 0), last):
            yield ImageRecord.of_image(frame.image, round((i + 1) * SECOND / frames_per_second))

    def _order(self, file: Path) -> list[tuple[list[str | int], str]]:
        return [natural_key(part) for part in file.relative_to(self.path).parts]

    def _numbered(self, first: int = 0, last: int | None = None) -> Iterator[tuple[int, Frame]]:
        for i, file in enumerate(self.files[first:last], first):
            try:
                frame = Frame(_read(file), 0, text_of(file.relative_to(self.path)))
            except ImageError as error:
                if self.on_error is None:
                    raise
                self.on_error(error)
                continue
            yield i, frame


def _images_below(folder: Path) -> list[Path]:
    """List the images in sub-folders; symbolic links to folders are not followed."""

    def fail(error: OSError) -> None:
        raise error

    images = []
    for name, folders, files in os.walk(folder, onerror=fail):
        folders[:] = [each for each in folders if not each.startswith('.')]
        images += [file for file in (Path(name, each) for each in files) if _is_image(file)]
    return images


def _is_image(file: Path) -> bool:
    return file.suffix.lower() in SUFFIXES and not file.name.startswith('.') and file.is_file()


def _read(file: Path) -> np.ndarray:
    try:
        return decode_file(file.read_bytes())
    except OSError as error:
        raise ImageError(
            f'{text_of(file)} cannot be read: {error.strerror}; check its permissions',
            kind='unreadable',
        ) from error
    except ImageError as error:
        raise ImageError(f'{text_of(file)}: {error}', kind=error.kind) from error
