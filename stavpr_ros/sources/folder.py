# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A folder of image files as a sequence."""

from collections import Counter
from collections.abc import Callable, Iterator
import math
import os
from pathlib import Path
import re

import numpy as np
from stavpr_ros.errors import ImageError, InputError, left_out, SourceError
from stavpr_ros.regular_file import ElsewhereError, open_regular
from stavpr_ros.sources.bag_path import STORAGE_SUFFIXES
from stavpr_ros.sources.cameras import of_one_camera
from stavpr_ros.sources.files import decode_file, more_images, ToBytes
from stavpr_ros.sources.frame import Frame, ImageRecord
from stavpr_ros.sources.order import in_order
from stavpr_ros.sources.suffixes import HEIF, OTHER_IMAGES, SUFFIXES
from stavpr_ros.units import SECOND

VIDEOS = frozenset({
    '.264', '.265', '.360', '.3g2', '.3gp', '.asf', '.avi', '.divx', '.dv', '.f4v', '.flv',
    '.h264', '.h265', '.hevc', '.insv', '.ivf', '.lrf', '.lrv', '.m2t', '.m2ts', '.m2v', '.m4v',
    '.mjpeg', '.mjpg', '.mkv', '.mod', '.mov', '.mp4', '.mpe', '.mpeg', '.mpegts', '.mpg', '.mts',
    '.mxf', '.nut', '.ogv', '.osv', '.qt', '.rm', '.tod', '.tp', '.ts', '.vob', '.webm', '.wmv',
    '.wtv', '.y4m',
})  # fmt: skip
PROXIES = frozenset({'.lrf', '.lrv'})  # small copies that cameras put beside videos
FOREIGN = re.compile(
    r'@.*|#recycle|#snapshot|\$recycle\.bin|lost\+found|__macosx|system volume information|'
    r'_*thumb(nail)?s?',
    re.IGNORECASE,
)
"""Names of sub-folders that a NAS, an archive program or a viewer adds."""
MAX_RATIO = 5  # of images in sub-folders to images beside them, if these are the drive


def text_of(path: str | Path) -> str:
    """Return a path or name as printable text; bytes that are no UTF-8 are replaced."""
    return os.fsencode(path).decode('utf-8', 'replace')


class FolderSource:
    """
    The images of a folder in natural order, or of its sub-folders if it has few or none itself.

    Sub-folders, at any depth, are in natural order too, one after the other. Hidden files and
    folders are ignored; ``left_out`` counts other images and folders by their
    :data:`stavpr_ros.errors.CAUSES`. Iterating yields :class:`Frame` with an unknown stamp and,
    as identifier, the file's name, in a sub-folder its path from the folder. ``to_bytes`` converts
    images of 16 bits, None = by the upper byte; ``min_size`` are the rows and columns needed of
    large images, which are reduced, None = all.

    :param on_error: called with the :class:`ImageError` of a file that cannot be read, which is
        then skipped; without it the error is raised.
    :param camera: the camera to read of several in the folder, as the error names it.
    :raises SourceError: there is no such folder, or no image in it and its sub-folders, or several
        cameras.
    """

    def __init__(
        self,
        path: str | Path,
        on_error: Callable[[ImageError], None] | None = None,
        camera: str | None = None,
    ) -> None:
        self.path = Path(path)
        self.on_error = on_error
        self.to_bytes: ToBytes | None = None
        self.min_size: tuple[int, int] | None = None
        self._page_files: set[Path] = set()
        try:
            files, self.left_out = _images_of(self.path)
        except OSError as error:
            raise SourceError(
                f'{self.path} cannot be listed: {error.strerror}; check its name and permissions'
            ) from error
        if not files:
            expected = ' '.join(sorted(SUFFIXES))
            raise SourceError(
                f'{self.path} has no images: expected files ending in {expected}, there or in '
                f'sub-folders. {left_out(self.left_out)}'.rstrip('. ')
            )
        self.files = in_order(of_one_camera(files, self.path, camera), self.path)

    def __len__(self) -> int:
        """Return the number of image files, readable or not."""
        return len(self.files)

    def __iter__(self) -> Iterator[Frame]:
        """Decode one file after the other."""
        for _, frame in self._decode():
            yield frame

    @property
    def names(self) -> list[str]:
        """Return the identifiers of all images, readable or not."""
        return [text_of(file.relative_to(self.path)) for file in self.files]

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
        self.to_bytes = np.asarray  # the map decides the range of 16 bits
        # the last instant before a file counts as its own: i / 10 is not exact
        first, last = (
            math.ceil(min(t * frames_per_second - 1e-6, len(self)))
            for t in (start, start + duration)
        )
        for i, frame in self._decode(max(first, 0), last):
            yield ImageRecord.of_image(frame.image, round((i + 1) * SECOND / frames_per_second))

    def _decode(self, first: int = 0, last: int | None = None) -> Iterator[tuple[int, Frame]]:
        for i, file in enumerate(self.files[first:last], first):
            try:
                frame = Frame(self._read(file), 0, text_of(file.relative_to(self.path)))
            except ImageError as error:
                if self.on_error is None:
                    raise
                self.on_error(error)
                continue
            yield i, frame

    def _read(self, file: Path) -> np.ndarray:
        try:
            with open_regular(file) as content:
                data = content.readall()
            if not data:
                raise ImageError(
                    '0 bytes: a placeholder of a cloud, or an interrupted copy; download it again',
                    kind='elsewhere',
                )
            image = decode_file(data, None, self.min_size, self.to_bytes)
        except ElsewhereError as error:
            raise ImageError(f'{text_of(file)}: {error.strerror}', kind='elsewhere') from error
        except OSError as error:
            raise ImageError(
                f'{text_of(file)} cannot be read: {error.strerror}; check its permissions',
                kind='unreadable',
            ) from error
        except ImageError as error:
            raise ImageError(f'{text_of(file)}: {error}', kind=error.kind) from error
        if file not in self._page_files:
            self._page_files.add(file)
            self.left_out += Counter(pages=more_images(data))
        return image


def _images_of(top: Path) -> tuple[list[Path], Counter[str]]:
    """List the images of a folder, and count what is left out; links to folders are ignored."""
    beside: list[Path] = []
    below: list[Path] = []

    def fail(error: OSError) -> None:
        if not beside:  # else the sub-folders are not needed
            raise error

    unread: Counter[str] = Counter()
    for name, folders, files in os.walk(top, onerror=fail):
        visible = [folder for folder in folders if not folder.startswith('.')]
        folders[:] = [folder for folder in visible if not FOREIGN.fullmatch(folder)]
        unread['foreign'] += len(visible) - len(folders)
        paths = [Path(name, file) for file in files if not file.startswith('.')]
        images = [path for path in paths if path.suffix.lower() in SUFFIXES]
        # a link into nothing is an image that is missing
        images = [path for path in images if path.is_file() or not path.exists()]
        # an image in two formats is read in the common one
        names = {path.stem for path in images if path.suffix.lower() not in HEIF}
        images = [p for p in images if p.suffix.lower() not in HEIF or p.stem not in names]
        names |= {path.stem for path in images}
        others = (path for path in paths if path.suffix.lower() in OTHER_IMAGES)
        unread['format'] += sum(path.stem not in names for path in others)
        unread['bag'] += sum(path.suffix.lower() in STORAGE_SUFFIXES for path in paths)
        unread['video'] += sum(path.suffix.lower() in VIDEOS for path in paths)
        (beside if Path(name) == top else below).extend(images)
    is_drive = len(beside) * MAX_RATIO > len(below)
    unread['below' if is_drive else 'beside'] = len(below if is_drive else beside)
    return beside if is_drive else below, +unread
