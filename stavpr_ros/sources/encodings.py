"""Messages' and files' bytes to one kind of image: RGB, uint8, shape (height, width, 3), C-contiguous."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from PIL import Image

from stavpr_ros.errors import ImageError

MAX_PIXELS = 64_000_000
"""Largest compressed image that is decoded: a small file may claim a picture that fills the memory."""

COMPRESSED_FORMATS = ('JPEG', 'PNG', 'BMP', 'TIFF', 'PPM', 'WEBP')
"""What :func:`decode_compressed` reads, in Pillow's names."""

NOT_PICTURES = frozenset({'16UC1', '16SC1', '32FC1', '32SC1', '64FC1', '32FC3'})
"""Encodings of depth images and of measurements: there is no brightness in them."""


@dataclass(frozen=True)
class Encoding:
    """
    How the pixels of one ``sensor_msgs/Image`` encoding lie in memory.

    :param channels: values per pixel.
    :param value_bytes: bytes per value, 1 or 2; of two only the more significant one is used.
    :param to_rgb: takes the uint8 view (height, width, channels), gives a new RGB array (height, width, 3).
    """

    channels: int
    value_bytes: int
    to_rgb: Callable[[np.ndarray], np.ndarray]


def _convert(code: int, pixels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(pixels, code))


def _copy(pixels: np.ndarray) -> np.ndarray:
    return np.array(pixels, order='C')


_FROM_BGR = partial(_convert, cv2.COLOR_BGR2RGB)
_FROM_RGBA = partial(_convert, cv2.COLOR_RGBA2RGB)
_FROM_BGRA = partial(_convert, cv2.COLOR_BGRA2RGB)
_FROM_GREY = partial(_convert, cv2.COLOR_GRAY2RGB)

ENCODINGS: dict[str, Encoding] = {
    'rgb8': Encoding(3, 1, _copy),
    'bgr8': Encoding(3, 1, _FROM_BGR),
    'rgba8': Encoding(4, 1, _FROM_RGBA),
    'bgra8': Encoding(4, 1, _FROM_BGRA),
    'mono8': Encoding(1, 1, _FROM_GREY),
    'mono16': Encoding(1, 2, _FROM_GREY),
    'rgb16': Encoding(3, 2, _copy),
    'bgr16': Encoding(3, 2, _FROM_BGR),
    'rgba16': Encoding(4, 2, _FROM_RGBA),
    'bgra16': Encoding(4, 2, _FROM_BGRA),
    # OpenCV's names; colour is BGR there, as cv_bridge has it
    '8UC1': Encoding(1, 1, _FROM_GREY),
    '8UC3': Encoding(3, 1, _FROM_BGR),
    '8UC4': Encoding(4, 1, _FROM_BGRA),
}
"""Every raw encoding that is read; a further one is a further row."""


def decode_image(
    height: int,
    width: int,
    encoding: str,
    is_bigendian: bool,
    step: int,
    data: Any,
) -> np.ndarray:
    """
    Decode the fields of a raw ``sensor_msgs/Image``.

    The bytes are viewed in place, whatever ``step`` and the byte order are; the one copy made is the result,
    so it stays valid when the message goes. Sixteen bits become eight by dropping the lower byte.

    :param height: rows.
    :param width: pixels per row.
    :param encoding: a key of :data:`ENCODINGS`.
    :param is_bigendian: byte order of 16 bit values.
    :param step: bytes from one row to the next; rows may be padded.
    :param data: the bytes: anything with the buffer protocol. The last row's padding may be missing.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous, own memory.
    :raises ImageError: header and data contradict each other, or the encoding is not read.
    """
    layout = _layout(encoding)
    if height < 1 or width < 1:
        raise ImageError(f'image of {width}x{height} pixels: expected at least 1x1; check the camera driver')
    row = width * layout.channels * layout.value_bytes
    if step < row:
        raise ImageError(
            f'step of {step} bytes is too small for a row of {width} {encoding} pixels: expected {row} or '
            'more; check the camera driver'
        )
    flat = _flat_bytes(data)
    needed = (height - 1) * step + row
    if flat.size < needed:
        raise ImageError(
            f'{flat.size} bytes of data for {width}x{height} {encoding} with step {step}: expected {needed} '
            'or more; the image is cut off'
        )
    # of a 16 bit value only the more significant byte is viewed, which lies first if big-endian
    offset = layout.value_bytes - 1 if not is_bigendian else 0
    pixels: np.ndarray = np.ndarray(
        (height, width, layout.channels),
        np.uint8,
        flat,
        offset,
        (step, layout.channels * layout.value_bytes, layout.value_bytes),
    )
    return layout.to_rgb(pixels)


def decode_message(message: Any) -> np.ndarray:
    """
    Decode an image message: a ``sensor_msgs/Image`` of rclpy or of rosbags, or anything with its fields.

    :returns: RGB, uint8, shape (height, width, 3).
    :raises ImageError: see :func:`decode_image`.
    """
    return decode_image(
        message.height,
        message.width,
        message.encoding,
        bool(message.is_bigendian),
        message.step,
        message.data,
    )


def decode_compressed(data: Any) -> np.ndarray:
    """
    Decode the bytes of an image file: JPEG, PNG, BMP, TIFF, PNM, WebP.

    Grey, 16 bit and transparent images come out as RGB uint8 too; a rotation that the camera noted (EXIF) is
    applied.

    :param data: the file's bytes: anything with the buffer protocol.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    :raises ImageError: not such a file, damaged, cut off, or of more than :data:`MAX_PIXELS` pixels.
    """
    flat = _flat_bytes(data)
    _check_size(flat)
    try:
        image = cv2.imdecode(flat, cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise ImageError(f'compressed image of {flat.size} bytes is damaged: {error}') from error
    if image is None:
        raise ImageError(f'compressed image of {flat.size} bytes is damaged or cut off: copy or record anew')
    return _FROM_BGR(image)


def _layout(encoding: str) -> Encoding:
    layout = ENCODINGS.get(encoding)
    if layout is not None:
        return layout
    known = ', '.join(ENCODINGS)
    if encoding in NOT_PICTURES:
        raise ImageError(
            f'encoding {encoding!r} holds depth or measurements, not a picture: expected one of {known}; '
            "choose the camera's colour or grey topic"
        )
    raise ImageError(
        f'encoding {encoding!r} is not read: expected one of {known}; set the driver, or use image_proc'
    )


def _flat_bytes(data: Any) -> np.ndarray:
    """View any buffer as bytes, shape (size,); an array that is not contiguous is copied."""
    if isinstance(data, np.ndarray):
        return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
    view = memoryview(data)
    return np.frombuffer(view, np.uint8) if view.nbytes else np.empty(0, np.uint8)


def _check_size(flat: np.ndarray) -> None:
    """Read the header only: the decoder would take the memory first and complain afterwards."""
    try:
        with Image.open(BytesIO(flat.data), formats=COMPRESSED_FORMATS) as header:
            width, height = header.size
    except Exception as error:  # a damaged header makes Pillow raise errors of many kinds
        raise ImageError(
            f'{flat.size} bytes are no image, or damaged: expected {", ".join(COMPRESSED_FORMATS)}: {error}',
        ) from error
    if width * height > MAX_PIXELS:
        raise ImageError(
            f'compressed image of {width}x{height} pixels: expected at most {MAX_PIXELS}; scale it down'
        )
