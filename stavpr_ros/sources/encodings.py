# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pixels and messages of ROS images to RGB, uint8, shape (height, width, 3), C-contiguous.

Raw encodings (byte orders, Bayer mosaics, YUV), and messages, raw or compressed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import re
from typing import Any

import cv2
import numpy as np
from stavpr_ros.errors import ImageError
from stavpr_ros.sources import files

_FILES = {'jpeg', 'jpg', 'mjpeg', 'png'}
"""Encodings of raw messages that have the bytes of a file, of cameras on USB."""
_MEASUREMENTS = re.compile(r'(8S|16S|32[SUF]|64[SUF])C\d*')
"""Encodings of depth images, vectors and other measurements, without brightness."""
# Rows: R, G, B of Y, U, V and 1: BT.601 in the range of video (Y 16..235), as in OpenCV.
_RGB_OF_YUV = np.array(
    [
        [1.164, 0.0, 1.596, -16 * 1.164 - 128 * 1.596],
        [1.164, -0.391, -0.813, -16 * 1.164 + 128 * (0.391 + 0.813)],
        [1.164, 2.018, 0.0, -16 * 1.164 - 128 * 2.018],
    ]
)


@dataclass(frozen=True)
class Encoding:
    """
    How the pixels of one ``sensor_msgs/Image`` encoding lie in memory.

    :param channels: values per pixel.
    :param value_bytes: bytes per value, 1 or 2.
    :param to_rgb: takes uint8 (rows, width, channels), a view of the message unless the values had
        two bytes; gives an RGB array (height, width, 3), new or the same.
    :param block: (rows, columns) of the pixels that share a color: the size is a multiple of it.
    :param chroma_rows: rows of ``step`` bytes with color below the image, per row of the image.
    """

    channels: int
    value_bytes: int
    to_rgb: Callable[[np.ndarray], np.ndarray]
    block: tuple[int, int] = (1, 1)
    chroma_rows: float = 0


def convert(code: int, pixels: np.ndarray) -> np.ndarray:
    """Convert with one of OpenCV's codes, ``cv2.COLOR_...2RGB``; rows may be apart."""
    return np.asarray(cv2.cvtColor(pixels, code))


def keep(pixels: np.ndarray) -> np.ndarray:
    """Return RGB pixels as they are."""
    return pixels


def demosaic(code: int, mosaic: np.ndarray) -> np.ndarray:
    """
    Interpolate (bilinear) the two missing colors of each pixel behind a Bayer filter.

    :param code: OpenCV's, with four letters: the top-left 2x2 pixels, as ROS names a mosaic.
    :param mosaic: uint8, shape (height, width) or (height, width, 1); rows may be apart.
    :raises ImageError: fewer than 2 rows or columns: a color is missing.
    """
    height, width = mosaic.shape[:2]
    if min(height, width) < 2:
        raise ImageError(
            f'Bayer mosaic of {width}x{height} pixels: expected at least 2x2; check the camera '
            'driver',
            kind='size',
        )
    if min(height, width) > 2:
        return convert(code, mosaic)
    # OpenCV returns black below 3x3; mirroring by two keeps the colors of the pattern in place
    larger = cv2.copyMakeBorder(mosaic, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)
    return np.ascontiguousarray(convert(code, larger)[2:-2, 2:-2])


def nv24_to_rgb(planes: np.ndarray) -> np.ndarray:
    """
    Convert YUV 4:4:4 in two planes; OpenCV has no code for it.

    :param planes: uint8, shape (3 * height, width, 1), rows any ``step`` apart: a plane of Y, then
        one of alternating U and V, whose rows are twice as long, padding included.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    """
    height, width, step = planes.shape[0] // 3, planes.shape[1], planes.strides[0]
    # The last row ends at (3 * height - 2) * step + 2 * width: within `planes`, as width <= step.
    chroma = np.lib.stride_tricks.as_strided(planes[height:], (height, width, 2), (2 * step, 2, 1))
    yuv = np.empty((height, width, 3), np.uint8)
    cv2.mixChannels([planes[:height], chroma], [yuv], [0, 0, 1, 1, 2, 2])
    return np.asarray(cv2.transform(yuv, _RGB_OF_YUV))


_FROM_BGR = partial(convert, cv2.COLOR_BGR2RGB)
_FROM_RGBA = partial(convert, cv2.COLOR_RGBA2RGB)
_FROM_BGRA = partial(convert, cv2.COLOR_BGRA2RGB)
_FROM_GRAY = partial(convert, cv2.COLOR_GRAY2RGB)
_UYVY = Encoding(2, 1, partial(convert, cv2.COLOR_YUV2RGB_UYVY), block=(1, 2))
_YUYV = Encoding(2, 1, partial(convert, cv2.COLOR_YUV2RGB_YUYV), block=(1, 2))

ENCODINGS: dict[str, Encoding] = {
    'rgb8': Encoding(3, 1, keep),
    'bgr8': Encoding(3, 1, _FROM_BGR),
    'rgba8': Encoding(4, 1, _FROM_RGBA),
    'bgra8': Encoding(4, 1, _FROM_BGRA),
    'mono8': Encoding(1, 1, _FROM_GRAY),
    'mono16': Encoding(1, 2, _FROM_GRAY),
    'rgb16': Encoding(3, 2, keep),
    'bgr16': Encoding(3, 2, _FROM_BGR),
    'rgba16': Encoding(4, 2, _FROM_RGBA),
    'bgra16': Encoding(4, 2, _FROM_BGRA),
    # OpenCV's names; color is BGR there, as cv_bridge has it
    '8UC1': Encoding(1, 1, _FROM_GRAY),
    '8UC3': Encoding(3, 1, _FROM_BGR),
    '8UC4': Encoding(4, 1, _FROM_BGRA),
    # industrial cameras mean gray by it; depth cameras do not
    '16UC1': Encoding(1, 2, _FROM_GRAY),
    '16UC3': Encoding(3, 2, _FROM_BGR),
    '16UC4': Encoding(4, 2, _FROM_BGRA),
    **{
        f'bayer_{pattern}{8 * value_bytes}': Encoding(
            1, value_bytes, partial(demosaic, getattr(cv2, f'COLOR_Bayer{pattern.upper()}2RGB'))
        )
        for value_bytes in (1, 2)
        for pattern in ('rggb', 'bggr', 'gbrg', 'grbg')
    },
    'uyvy': _UYVY,
    'yuv422': _UYVY,
    'yuyv': _YUYV,
    'yuv422_yuy2': _YUYV,
    'nv12': Encoding(1, 1, partial(convert, cv2.COLOR_YUV2RGB_NV12), (2, 2), chroma_rows=0.5),
    'nv21': Encoding(1, 1, partial(convert, cv2.COLOR_YUV2RGB_NV21), (2, 2), chroma_rows=0.5),
    'nv24': Encoding(1, 1, nv24_to_rgb, chroma_rows=2),
}
"""The supported raw encodings."""
_LOWER_CASE = {name.lower(): encoding for name, encoding in ENCODINGS.items()}


def decode_message(
    message: Any,
    min_size: tuple[int, int] | None = None,
    to_bytes: files.ToBytes | None = None,
) -> np.ndarray:
    """
    Decode an image message, raw or compressed, of rclpy or rosbags, or any object with its fields.

    Raw bytes are viewed in place for any ``step``; ``rgb8`` without padding remains such a view if
    the bytes can be written, all others get memory of their own. YUV is BT.601 in the range of
    video, as in cv_bridge.

    :param message: a ``sensor_msgs/CompressedImage`` if it has a ``format``, the image of a video
        topic if it decodes itself, else a ``sensor_msgs/Image``.
    :param min_size: rows and columns that are needed of a large image, which is reduced then, see
        :func:`stavpr_ros.sources.files.reduce`; None = all.
    :param to_bytes: converts values of 16 bits; None = the upper byte.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    :raises ImageError: header and data contradict each other, the encoding is unsupported, the
        image has more than :data:`stavpr_ros.sources.files.MAX_PIXELS` pixels; or see
        :func:`stavpr_ros.sources.files.decode_file`.
    """
    if hasattr(message, 'decode'):
        return files.reduce(message.decode(), min_size)
    if hasattr(message, 'format'):
        return _decode_compressed(message, min_size, to_bytes)
    if message.encoding.lower() in _FILES:
        return files.decode_file(message.data, None, min_size, to_bytes)
    return _decode_raw(message, min_size, to_bytes)


def _decode_raw(
    message: Any, min_size: tuple[int, int] | None, to_bytes: files.ToBytes | None
) -> np.ndarray:
    """Decode a ``sensor_msgs/Image``; step may be 0, and the padding of the last row missing."""
    height, width, encoding = message.height, message.width, message.encoding
    layout = _layout(encoding)
    row = width * layout.channels * layout.value_bytes
    step = message.step or row
    rows = height + int(height * layout.chroma_rows)
    _check_header(height, width, encoding, layout, step, row)
    flat = files.flat_bytes(message.data)
    min_bytes = (rows - 1) * step + row
    if flat.size < min_bytes:
        raise ImageError(
            f'{flat.size} bytes of data for {width}x{height} {encoding} with step {step}: '
            f'expected {min_bytes} or more; the image is cut off',
            kind='cut off',
        )
    if width * height > files.MAX_PIXELS:  # last: a wrong header fails the checks above
        raise files.too_large(width, height)
    values = width * layout.channels
    if layout.value_bytes == 1:
        strides = (step, layout.channels, 1)
        pixels: np.ndarray = np.ndarray((rows, width, layout.channels), np.uint8, flat, 0, strides)
        image = files.reduce(layout.to_rgb(pixels), min_size)
        is_own = image is not pixels or (image.flags.c_contiguous and image.flags.writeable)
        return image if is_own else np.array(image, order='C')
    if to_bytes is None:  # the more significant byte lies first if big-endian
        pairs: np.ndarray = np.ndarray((rows, values, 2), np.uint8, flat, 0, (step, 2, 1))
        high = np.asarray(cv2.extractChannel(pairs, 0 if message.is_bigendian else 1))
    else:
        order = '>u2' if message.is_bigendian else '<u2'
        wide: np.ndarray = np.ndarray((rows, values), order, flat, 0, (step, 2))
        high = to_bytes(wide.astype(np.uint16))
    return files.reduce(layout.to_rgb(high.reshape(rows, width, layout.channels)), min_size)


def _decode_compressed(
    message: Any, min_size: tuple[int, int] | None, to_bytes: files.ToBytes | None
) -> np.ndarray:
    """Decode a CompressedImage: the bytes decide; ``format`` names depth images and mosaics."""
    original = message.format.partition(';')[0].strip()
    if 'compresseddepth' in message.format.lower() or _MEASUREMENTS.fullmatch(original):
        raise ImageError(
            f'compressed format {message.format!r} has depth or measurements: expected a color or '
            "gray image; choose the camera's color or gray topic",
            kind='depth',
        )
    try:
        return files.decode_file(message.data, _demosaic_of(message.format), min_size, to_bytes)
    except ImageError as error:
        raise ImageError(f'format {message.format!r}: {error}', kind=error.kind) from error


def _demosaic_of(transport: str) -> Callable[[np.ndarray], np.ndarray] | None:
    """Find the Bayer mosaic in a format such as ``bayer_rggb8; png compressed``."""
    original, _, rest = transport.partition(';')
    # target: nothing or the same mosaic, unless it was converted before compression
    _, keyword, target = rest.partition('compressed')
    layout = ENCODINGS.get(original.strip()) if original.startswith('bayer_') else None
    if layout is None or not keyword or target.strip() not in {'', original.strip()}:
        return None
    return layout.to_rgb


def _layout(encoding: str) -> Encoding:
    layout = ENCODINGS.get(encoding) or _LOWER_CASE.get(encoding.lower())
    if layout is not None:
        return layout
    problem, remedy, kind = 'is unknown', 'set the driver, or use image_proc', 'encoding'
    if _MEASUREMENTS.fullmatch(encoding):
        problem, kind = 'has depth or measurements', 'depth'
        remedy = "choose the camera's color or gray topic"
    raise ImageError(
        f'encoding {encoding!r} {problem}: expected a color or gray image, such as rgb8, bgr8, '
        f'mono8 or yuv422 (all {len(ENCODINGS)}: docs/node.md, encodings); {remedy}',
        kind=kind,
    )


def _check_header(
    height: int, width: int, encoding: str, layout: Encoding, step: int, row: int
) -> None:
    if height < 1 or width < 1:
        raise ImageError(
            f'image of {width}x{height} pixels: expected at least 1x1; check the camera driver',
            kind='size',
        )
    rows, columns = layout.block
    if height % rows or width % columns:
        raise ImageError(
            f'{encoding} image of {width}x{height} pixels: expected a width that is a multiple of '
            f'{columns} and a height that is a multiple of {rows}, since so many pixels share a '
            'color; check the camera driver',
            kind='size',
        )
    if step < row:
        raise ImageError(
            f'step of {step} bytes is too small for a row of {width} {encoding} pixels: expected '
            f'{row} or more; check the camera driver',
            kind='step',
        )
