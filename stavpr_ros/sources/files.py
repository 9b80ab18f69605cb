# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image files to RGB, uint8, shape (height, width, 3), C-contiguous."""

from collections.abc import Callable
from io import BytesIO
import re
from typing import Any

import cv2
import numpy as np
from PIL import Image
from stavpr_ros.errors import ImageError

MAX_PIXELS = 64_000_000
"""Largest decoded image: the header of a small file may claim one that exhausts the memory."""

JPEG_MARKER = re.compile(rb'\xff[\xc0-\xcf\xd9-\xfe]')
"""Markers before a segment (length and bytes), and the end; never within compressed pixels."""
END_OF_JPEG = b'\xff\xd9'
PNG_SIGNATURE, PNG_CHUNK = 8, 12  # bytes before the first chunk; of a chunk without its data

JPEG_FORMATS = ('JPEG', 'MPO')  # MPO: several images, the first is read

LARGE_PIXELS, ENOUGH_PIXELS = 1024 * 768, 640 * 480
"""Images of more pixels than the first are reduced, until they have at most the second."""

REDUCED_JPEG = {
    1: cv2.IMREAD_COLOR,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    8: cv2.IMREAD_REDUCED_COLOR_8,
}
"""Decoders of a JPEG at a fraction of its size; they skip most of the work."""

COMPRESSED_FORMATS = ('JPEG', 'PNG', 'BMP', 'TIFF', 'PPM', 'WEBP')
"""The supported files, in Pillow's names."""


def reduction(height: int, width: int, least: tuple[int, int] | None) -> int:
    """
    Return by what the sides of a large image are divided, a power of two; 1 for a small image.

    :param least: rows and columns that must remain; None = all.
    """
    divisor = 1
    if least is None or height * width <= LARGE_PIXELS:
        return divisor
    while (
        height * width > ENOUGH_PIXELS
        and not (height % 2 or width % 2)
        and (height // 2 >= least[0] and width // 2 >= least[1])
    ):
        height, width, divisor = height // 2, width // 2, 2 * divisor
    return divisor


def reduce(image: np.ndarray, least: tuple[int, int] | None) -> np.ndarray:
    """
    Reduce an image by :func:`reduction`: blocks of 2 x 2 pixels are averaged, again and again.

    :param image: uint8, shape (height, width, channels).
    :returns: the same image if it is not large.
    """
    height, width = image.shape[:2]
    divisor = reduction(height, width, least)
    while divisor > 1:
        height, width, divisor = height // 2, width // 2, divisor // 2
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)  # its fast case
    return image


def flat_bytes(data: Any) -> np.ndarray:
    """View any buffer as bytes, shape (size,); an array that is not contiguous is copied."""
    if isinstance(data, np.ndarray):
        return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
    view = memoryview(data)
    return np.frombuffer(view, np.uint8) if view.nbytes else np.empty(0, np.uint8)


def decode_file(
    data: Any,
    demosaic: Callable[[np.ndarray], np.ndarray] | None = None,
    least: tuple[int, int] | None = None,
) -> np.ndarray:
    """
    Decode the bytes of an image file: JPEG, PNG, BMP, TIFF, PNM, WebP.

    Gray, 16 bit and transparent images become RGB uint8 too; a rotation in the EXIF data is
    applied.

    :param data: the file's bytes: anything with the buffer protocol.
    :param demosaic: converts a gray image (height, width), a Bayer mosaic, to RGB; not called if
        the file has color.
    :param least: rows and columns that are needed of a large image, which is reduced then; None =
        all.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    :raises ImageError: not such a file, damaged, cut off, or of more than :data:`MAX_PIXELS`
        pixels.
    """
    flat = flat_bytes(data)
    header = _check_file(flat)
    mode, flag = header.mode, cv2.IMREAD_COLOR
    if header.format in JPEG_FORMATS:
        flag = REDUCED_JPEG[min(8, reduction(header.height, header.width, least))]
    try:
        # Pillow's modes of one channel: L of 8 bits, I or I;16 of more
        if demosaic is not None and (mode == 'L' or mode.startswith('I')):
            return reduce(demosaic(_unpack(flat, cv2.IMREAD_GRAYSCALE)), least)
        return np.asarray(cv2.cvtColor(reduce(_unpack(flat, flag), least), cv2.COLOR_BGR2RGB))
    except cv2.error as error:
        raise ImageError(
            f'compressed image of {flat.size} bytes is damaged: {error}', kind='damaged'
        ) from error


def _unpack(flat: np.ndarray, mode: int) -> np.ndarray:
    image = cv2.imdecode(flat, mode)
    if image is None:
        raise _damaged(flat.size)
    return np.asarray(image)


def _damaged(size: int) -> ImageError:
    return ImageError(
        f'compressed image of {size} bytes is damaged or cut off: copy or record it again',
        kind='damaged',
    )


def _check_file(flat: np.ndarray) -> Image.Image:
    """Check the header and return it, closed, before the decoder allocates the image."""
    try:
        with Image.open(BytesIO(flat.data), formats=COMPRESSED_FORMATS) as header:
            width, height = header.size
    except Image.DecompressionBombError as error:
        raise ImageError(
            f'{error}: expected at most {MAX_PIXELS}; scale it down', kind='too large'
        ) from error
    except Exception as error:  # a damaged header raises errors of any type
        raise ImageError(
            f'{flat.size} bytes are no image, or damaged: expected '
            f'{", ".join(COMPRESSED_FORMATS)}: {error}',
            kind='damaged',
        ) from error
    if width * height > MAX_PIXELS:
        raise too_large(width, height)
    if header.format in JPEG_FORMATS:
        _check_end_of_jpeg(flat.tobytes())
    if header.format == 'PNG':
        _check_chunks_of_png(flat.data)
    return header


def _check_end_of_jpeg(data: bytes) -> None:
    """Reject an incomplete image: OpenCV before version 5 fills the rest with gray."""
    # segment by segment: a thumbnail or a video in the file may contain the same two bytes
    at = 2
    while marker := JPEG_MARKER.search(data, at):
        at = marker.end()
        if marker[0] == END_OF_JPEG:
            return
        at += int.from_bytes(data[at : at + 2], 'big')
    raise ImageError(
        f'compressed image of {len(data)} bytes is cut off: expected the end of a JPEG; copy it '
        'again',
        kind='cut off',
    )


def _check_chunks_of_png(data: memoryview) -> None:
    """Reject chunks longer than the file: OpenCV allocates a chunk before it reads it."""
    at = PNG_SIGNATURE
    while at + PNG_CHUNK <= len(data):
        length = int.from_bytes(data[at : at + 4], 'big')
        at += PNG_CHUNK + length
        if at > len(data):
            raise _damaged(len(data))


def too_large(width: int, height: int) -> ImageError:
    """Return the error of an image of more than :data:`MAX_PIXELS` pixels."""
    return ImageError(
        f'image of {width}x{height} pixels: expected at most {MAX_PIXELS}; scale it down',
        kind='too large',
    )
