"""Color conversions of raw pixels: byte orders, Bayer mosaics, YUV; all give new RGB arrays."""

import cv2
import numpy as np

from stavpr_ros.errors import ImageError

# rows: R, G, B of Y, U, V and 1: BT.601 in the range of video (Y 16..235), as OpenCV has it for its formats
_RGB_OF_YUV = np.array(
    [
        [1.164, 0.0, 1.596, -16 * 1.164 - 128 * 1.596],
        [1.164, -0.391, -0.813, -16 * 1.164 + 128 * (0.391 + 0.813)],
        [1.164, 2.018, 0.0, -16 * 1.164 - 128 * 2.018],
    ]
)


def convert(code: int, pixels: np.ndarray) -> np.ndarray:
    """
    Convert with one of OpenCV's codes.

    :param code: ``cv2.COLOR_...2RGB``.
    :param pixels: uint8, shape (rows, width, channels); rows may be apart.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    """
    return np.asarray(cv2.cvtColor(pixels, code))


def copy(pixels: np.ndarray) -> np.ndarray:
    """Copy RGB pixels out of the message."""
    return np.array(pixels, order='C')


def keep(pixels: np.ndarray) -> np.ndarray:
    """Leave RGB pixels alone that are a copy already."""
    return pixels


def demosaic(code: int, mosaic: np.ndarray) -> np.ndarray:
    """
    Interpolate (bilinear) the two colors that a Bayer filter took from each pixel.

    ROS names a mosaic by its top-left 2x2 pixels in reading order. So do OpenCV's codes of four letters;
    those of two letters (``BayerBG``) name the 2x2 pixels that begin at (1, 1).

    :param code: ``cv2.COLOR_Bayer....2RGB``.
    :param mosaic: uint8, shape (height, width) or (height, width, 1); rows may be apart.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    :raises ImageError: fewer than 2 rows or columns: some color is in none of the pixels.
    """
    height, width = mosaic.shape[:2]
    if min(height, width) < 2:
        raise ImageError(
            f'Bayer mosaic of {width}x{height} pixels: expected at least 2x2; check the camera driver',
            kind='size',
        )
    if min(height, width) > 2:
        return convert(code, mosaic)
    # OpenCV gives black below 3x3; mirroring by two keeps every color of the pattern in its place
    larger = cv2.copyMakeBorder(mosaic, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)
    return copy(convert(code, larger)[2:-2, 2:-2])


def nv24_to_rgb(planes: np.ndarray) -> np.ndarray:
    """
    Convert YUV 4:4:4 in two planes, which OpenCV has no code for.

    :param planes: uint8, shape (3 * height, width, 1), rows any ``step`` apart: a plane of Y, then one of
        alternating U and V, whose rows are twice as long, padding included.
    :returns: RGB, uint8, shape (height, width, 3), C-contiguous.
    """
    height, width, step = planes.shape[0] // 3, planes.shape[1], planes.strides[0]
    # the last row ends at (3 * height - 2) * step + 2 * width, which is within `planes` since width <= step
    chroma = np.lib.stride_tricks.as_strided(planes[height:], (height, width, 2), (2 * step, 2, 1))
    yuv = np.empty((height, width, 3), np.uint8)
    cv2.mixChannels([planes[:height], chroma], [yuv], [0, 0, 1, 1, 2, 2])
    return np.asarray(cv2.transform(yuv, _RGB_OF_YUV))
