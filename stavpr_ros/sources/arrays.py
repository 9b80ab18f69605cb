# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The images of a folder, a video or a bag as arrays."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from stavpr_ros.errors import ImageError
from stavpr_ros.sources import open_source, Source


class Image(np.ndarray):
    """
    An array (height, width, 3), RGB, that carries its stamp and its name; parts carry them too.

    ``stamp`` is when it was taken, ns, 0 = unknown; ``name`` the name of its file, or of its video
    or topic with a number.
    """

    def __array_finalize__(self, other: object) -> None:
        self.stamp = int(getattr(other, 'stamp', 0))
        self.name = str(getattr(other, 'name', ''))


class Images:
    """The images of a source, an :class:`Image` each; every iteration reads them again."""

    def __init__(self, source: Source) -> None:
        self.source = source

    def __len__(self) -> int:
        return len(self.source)

    def __iter__(self) -> Iterator[Image]:
        if hasattr(self.source, 'to_bytes'):
            self.source.to_bytes = np.asarray  # the map decides the range of 16 bits
        for frame in self.source:
            image = frame.image.view(Image)
            image.stamp, image.name = frame.stamp, frame.identifier
            yield image


def images(
    path: str | Path,
    topic: str | None = None,
    on_error: Callable[[ImageError], None] | None = None,
    fps: float | None = None,
    camera: str | None = None,
) -> Images:
    """
    Open a folder of images, a video or a bag, and iterate over its images.

    :param path: see :func:`stavpr_ros.sources.open_source` for all parameters.
    :returns: an iterable of :class:`Image`, uint8; uint16 where the source has 16 bits:
        :class:`stavpr_ros.Localizer` converts them as its map's.
    :raises SourceError: it cannot be read, has no images, or the topic or camera is ambiguous.
    """
    return Images(open_source(path, topic, on_error, fps, camera))
