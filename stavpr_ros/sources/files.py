# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image files to RGB, uint8, shape (height, width, 3), C-contiguous."""

from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
import re
from typing import Any, TYPE_CHECKING

import cv2
import numpy as np
from stavpr_ros.errors import ImageError
from stavpr_ros.sources import frame

if TYPE_CHECKING:
    from PIL import Image

MAX_PIXELS = frame.MAX_PIXELS

JPEG_MARKER = re.compile(rb'\xff[\xc0-\xcf\xd9-\xfe]')
"""Markers before a segment (length and bytes), and the end; never within compressed pixels."""
END_OF_JPEG = b'\xff\xd9'
MORE_JPEG = b'\xaa' * 64 + b''.join(b'\xff%c' % i + b'\xaa' * 64 for i in range(0xD0, 0xD8))
"""Pixels, also behind each of the eight marks of a restart."""
PNG_SIGNATURE, PNG_CHUNK = 8, 12  # bytes before the first chunk; of a chunk without its data
END_OF_PNG = b'IEND'
TIFF_ROWS, TIFF_TILE = 278, (322, 323)  # tags: rows of a strip; width and height of a tile
ALL_ROWS = 2**24  # and more: the strip is the image

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

ToBytes = Callable[[np.ndarray], np.ndarray]
"""Converts values of 16 bits, uint16, to uint8, of the same shape."""
RANGE_IMAGES, PERCENTILES = 20, (0.5, 99.5)
"""The first images of a map, and the shares of their values, that decide the range in use."""
ORIENTATION = 0x0112  # tag of EXIF
HEIF = re.compile(rb'....ftyp(hei[cfmsx]|hev[cmsx]|mif1|msf1)', re.DOTALL)
TIFF = b'II*\0', b'MM\0*', b'II+\0', b'MM\0+'  # the last two are of more than 4 GB
WIDE_TIFF = ('TIFF', 'F'), ('TIFF', 'I')  # Pillow's modes of 32 bits, which OpenCV does not read

COMPRESSED_FORMATS = ('JPEG', 'PNG', 'BMP', 'TIFF', 'PPM', 'WEBP')
"""The supported files, in Pillow's names."""


def reduction(height: int, width: int, min_size: tuple[int, int] | None) -> int:
    """
    Return by what the sides of a large image are divided, a power of two; 1 for a small image.

    :param min_size: rows and columns that must remain; None = all.
    """
    divisor = 1
    if min_size is None or height * width <= LARGE_PIXELS:
        return divisor
    while (
        height * width > ENOUGH_PIXELS
        and not (height % 2 or width % 2)
        and (height // 2 >= min_size[0] and width // 2 >= min_size[1])
    ):
        height, width, divisor = height // 2, width // 2, 2 * divisor
    return divisor


def reduce(image: np.ndarray, min_size: tuple[int, int] | None) -> np.ndarray:
    """
    Reduce an image by :func:`reduction`: blocks of 2 x 2 pixels are averaged, again and again.

    :param image: uint8, shape (height, width, channels).
    :returns: the same image if it is not large.
    """
    height, width = image.shape[:2]
    divisor = reduction(height, width, min_size)
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


def upper_byte(values: np.ndarray) -> np.ndarray:
    """Return the upper bytes of values of 16 bits, uint16, as uint8."""
    return (values >> 8).astype(np.uint8)


class RangeFinder:
    """Converts images of 16 bits by their upper byte, and counts their values."""

    def __init__(self) -> None:
        self.images, self._counts = 0, np.zeros(65536, np.int64)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        self.images += 1
        self._counts += np.bincount(values.reshape(-1), minlength=65536)
        return upper_byte(values)

    @property
    def value_range(self) -> tuple[int, int] | None:
        """Return the :data:`PERCENTILES` of all values; None = there were none."""
        if not self.images:
            return None
        ends = self._counts.sum() * np.array(PERCENTILES) / 100
        low, high = np.searchsorted(np.cumsum(self._counts), ends).tolist()
        return low, max(high, low + 1)


def scale(value_range: tuple[int, int] | None) -> ToBytes | None:
    """Return the conversion that scales values of 16 bits to 0 .. 255; None for None."""
    if value_range is None:
        return None
    scaled = np.interp(np.arange(65536), value_range, (0, 255))
    return np.round(scaled).astype(np.uint8).__getitem__


def decode_file(
    data: Any,
    demosaic: Callable[[np.ndarray], np.ndarray] | None = None,
    min_size: tuple[int, int] | None = None,
    to_bytes: ToBytes | None = None,
) -> np.ndarray:
    """
    Decode the bytes of an image file: JPEG, PNG, BMP, TIFF, PNM, WebP, HEIC (extra ``heif``).

    Gray and transparent images become RGB too; a rotation in the EXIF data is applied.

    :param data: the file's bytes: anything with the buffer protocol.
    :param demosaic: converts a gray image (height, width), a Bayer mosaic, to RGB; not called if
        the file has color.
    :param min_size: rows and columns that are needed of a large image, which is reduced then;
        None = all.
    :param to_bytes: converts images of 16 bits; None = the upper byte.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    :raises ImageError: not such a file, damaged, cut off, or of more than :data:`MAX_PIXELS`
        pixels.
    """
    flat = flat_bytes(data)
    header, turn = check_file_header(flat, MAX_PIXELS)
    flag = cv2.IMREAD_COLOR  # OpenCV rounds color TIFF of 16 bits, and takes the upper byte else
    if header.format in JPEG_FORMATS:
        flat = _complete_jpeg(flat)
        flag = REDUCED_JPEG[min(8, reduction(header.height, header.width, min_size))]
    # Pillow's modes of one channel: L of 8 bits, I or I;16 of more
    if is_mosaic := demosaic is not None and (header.mode == 'L' or header.mode.startswith('I')):
        flag = cv2.IMREAD_GRAYSCALE
    image = _unpack(flat, flag if to_bytes is None else flag | cv2.IMREAD_ANYDEPTH, header)
    if image is None:
        raise _damage_error(flat.size)
    if image.dtype == np.uint16:
        image = (to_bytes or upper_byte)(image)
    image = _apply_orientation(image, turn)
    if demosaic is not None and is_mosaic:
        if image.ndim == 3:  # a TIFF that OpenCV does not decode: three equal channels
            image = np.ascontiguousarray(image[..., 0])
        return reduce(demosaic(image), min_size)
    code = cv2.COLOR_BGR2RGB if image.ndim == 3 else cv2.COLOR_GRAY2RGB
    return np.asarray(cv2.cvtColor(reduce(image, min_size), code))


def _unpack(flat: np.ndarray, flag: int, header: 'Image.Image') -> np.ndarray | None:
    """Return gray or BGR, uint8 or uint16, as stored; None = it cannot be decoded."""
    is_pillows = header.format == 'HEIF' or (header.format, header.mode) in WIDE_TIFF
    if not (is_pillows or _has_own_maximum(header)):
        try:
            image = cv2.imdecode(flat, flag | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:  # beyond a limit of OpenCV
            image = None
        if image is not None or header.format != 'TIFF':
            return image
    from PIL import Image, ImageOps

    try:
        with Image.open(BytesIO(flat.data), formats=[str(header.format)]) as file:
            upright = ImageOps.exif_transpose(file)
        if upright.mode not in ('F', 'I'):
            return np.asarray(upright.convert('RGB'))[..., ::-1]
    except Exception:  # damage raises errors of any type
        return None
    values, limit = np.asarray(upright), 1 if upright.mode == 'F' else 65535
    if not (values.min() >= 0 and values.max() <= limit):
        raise ImageError(
            f'{header.format} with values from {values.min():g} to {values.max():g}: expected 0 '
            f'to {limit}; convert it to 16 bits',
            kind='depth',
        )
    return np.round(values * (65535 / limit)).astype(np.uint16)


def _has_own_maximum(header: 'Image.Image') -> bool:
    """Return whether a PNM has another largest value than OpenCV expects, which does not scale."""
    decoder = [tile.args for tile in getattr(header, 'tile', ()) if header.format == 'PPM']
    return bool(decoder) and isinstance(decoder[0], tuple) and decoder[0][1] not in (255, 65535)


def _apply_orientation(image: np.ndarray, turn: int) -> np.ndarray:
    """Apply the orientation of EXIF, 1 to 8."""
    if turn >= 5:
        image = image.swapaxes(0, 1)
    rows, columns = -1 if turn in (3, 4, 7, 8) else 1, -1 if turn in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(image[::rows, ::columns])


def _damage_error(size: int) -> ImageError:
    return ImageError(
        f'compressed image of {size} bytes is damaged or cut off: copy or record it again',
        kind='damaged',
    )


def check_file_header(flat: np.ndarray, max_pixels: int) -> tuple['Image.Image', int]:
    """
    Check what a file claims, which OpenCV allocates before it reads.

    :param flat: the file's bytes, shape (size,), uint8.
    :returns: the header, closed, and the orientation by EXIF, 1 to 8.
    :raises ImageError: see :func:`decode_file`.
    """
    from PIL import Image, UnidentifiedImageError  # not in a node of raw images

    formats: tuple[str, ...] = COMPRESSED_FORMATS
    kind = 'damaged'
    if HEIF.match(flat[:12].tobytes()):
        formats, kind = ('HEIF',), 'format'
        try:
            from pillow_heif import register_heif_opener
        except ImportError as error:
            raise ImageError(
                'HEIC is read by pillow-heif, which is not installed: pip install pillow-heif, or '
                'convert the images to JPEG',
                kind=kind,
            ) from error
        register_heif_opener()
    try:
        with Image.open(BytesIO(flat.data), formats=formats) as header:
            sizes = header.size, _part_of_tiff(header)
            is_large = max(width * height for width, height in sizes) > max_pixels
            turn = 1 if is_large else _turn_of(header, flat)
    except Image.DecompressionBombError as error:
        raise ImageError(
            f'{error}: expected at most {MAX_PIXELS}; scale it down', kind='too large'
        ) from error
    except Exception as error:  # a damaged header raises errors of any type
        reason = '' if isinstance(error, UnidentifiedImageError) else f': {error}'
        kind = 'format' if flat[:4].tobytes() in TIFF else kind
        raise ImageError(
            f'{flat.size} bytes are no image, or damaged, or of a kind that is not read: expected '
            f'{", ".join(formats)} of 8 or 16 bits{reason}',
            kind=kind,
        ) from error
    for width, height in sizes:
        if width * height > max_pixels:
            raise too_large(width, height)
    if header.format == 'PNG':
        _check_chunks_of_png(flat.data)
    return header, turn


def more_images(data: bytes) -> int:
    """Return how many pages, frames or views a file has behind its first one, which is decoded."""
    from PIL import Image

    try:
        with Image.open(BytesIO(data)) as header:
            return int(getattr(header, 'n_frames', 1)) - 1
    except Exception:  # damage raises errors of any type
        return 0


def _turn_of(header: 'Image.Image', flat: np.ndarray) -> int:
    """Return the orientation by EXIF, 1 to 8; decoders turn TIFF and HEIC themselves."""
    late = header.format == 'PNG' and b'eXIf' in flat.tobytes()  # it may be behind the pixels
    if header.format in ('TIFF', 'HEIF') or not ('exif' in header.info or late):
        return 1
    try:
        turn = header.getexif().get(ORIENTATION, 1)
    except Exception:  # damage raises errors of any type
        return 1
    return turn if turn in range(2, 9) else 1


def _part_of_tiff(header: 'Image.Image') -> tuple[int, int]:
    """Return width and height of the strips or tiles that a TIFF claims, (0, 0) = none."""
    tags = getattr(header, 'tag_v2', {})
    if TIFF_TILE[0] in tags:
        return int(tags[TIFF_TILE[0]]), int(tags[TIFF_TILE[1]])
    rows = int(tags.get(TIFF_ROWS, 0))
    return header.width, rows if rows < ALL_ROWS else 0


def _complete_jpeg(flat: np.ndarray) -> np.ndarray:
    """Add the end if only this is missing; OpenCV before version 5 fills the rest with gray."""
    data = flat.tobytes()
    # segment by segment: a thumbnail or a video in the file may contain the same two bytes
    at = 2
    while marker := JPEG_MARKER.search(data, at):
        at = marker.end()
        if marker[0] == END_OF_JPEG:
            return flat
        at += int.from_bytes(data[at : at + 2], 'big')
    from PIL import Image  # prints no warnings

    pixels, images = data.rstrip(b'\xff'), []
    with suppress(Exception):  # damage raises errors of any type
        for more in (b'', MORE_JPEG):  # what follows the last pixel changes none
            with Image.open(BytesIO(pixels + more + END_OF_JPEG)) as image:
                images.append(image.tobytes())
        if images[0] == images[1]:
            return np.frombuffer(pixels + END_OF_JPEG, np.uint8)
    raise ImageError(
        f'compressed image of {len(data)} bytes is cut off: expected the end of a JPEG; copy it '
        'again',
        kind='cut off',
    )


def _check_chunks_of_png(data: memoryview) -> None:
    """Reject chunks longer than the file: OpenCV allocates a chunk before it reads it."""
    at, kind = PNG_SIGNATURE, b''
    while kind != END_OF_PNG and at < len(data):
        length, kind = int.from_bytes(data[at : at + 4], 'big'), bytes(data[at + 4 : at + 8])
        at += PNG_CHUNK + length
        if at > len(data):
            raise _damage_error(len(data))


def too_large(width: int, height: int) -> ImageError:
    """Return the error of an image of more than :data:`MAX_PIXELS` pixels."""
    return ImageError(
        f'image of {width}x{height} pixels: expected at most {MAX_PIXELS}; scale it down',
        kind='too large',
    )
