# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Image messages: the bytes of each raw encoding, written from its definition, and files."""

from types import SimpleNamespace

import cv2
import numpy as np

# channel of the message at which red, green and blue lie
CHANNELS = {
    'rgb8': (0, 1, 2),
    'bgr8': (2, 1, 0),
    'rgba8': (0, 1, 2),
    'bgra8': (2, 1, 0),
    'mono8': (0, 0, 0),
    'mono16': (0, 0, 0),
    'rgb16': (0, 1, 2),
    'bgr16': (2, 1, 0),
    'rgba16': (0, 1, 2),
    'bgra16': (2, 1, 0),
    '8UC1': (0, 0, 0),
    '8UC3': (2, 1, 0),
    '8UC4': (2, 1, 0),
    '16UC1': (0, 0, 0),
    '16UC3': (2, 1, 0),
    '16UC4': (2, 1, 0),
}
PATTERNS = ('rggb', 'bggr', 'gbrg', 'grbg')
BAYER = {f'bayer_{pattern}{bits}': pattern for pattern in PATTERNS for bits in (8, 16)}
# where the two Y, U and V of a pair of pixels lie
PAIRS = {
    'uyvy': (1, 3, 0, 2),
    'yuv422': (1, 3, 0, 2),
    'yuyv': (0, 2, 1, 3),
    'yuv422_yuy2': (0, 2, 1, 3),
}
PLANES = {'nv12': (0, 1), 'nv21': (1, 0), 'nv24': (0, 1)}  # where U and V lie in the second plane
YUV = [*PAIRS, *PLANES]


def raw(encoding, height, width, step, data, big=False):
    """Return a message of raw pixels."""
    fields = {'height': height, 'width': width, 'encoding': encoding, 'is_bigendian': big}
    return SimpleNamespace(**fields, step=step, data=data)


def file_message(data, transport=''):
    """Return a message with the bytes of a file."""
    return SimpleNamespace(format=transport, data=data)


def encode(suffix, rgb, *options):
    """Return the file of an image, RGB or gray, by OpenCV."""
    image = rgb if rgb.ndim == 2 else rgb[..., ::-1].copy()
    return cv2.imencode(suffix, image, options)[1].tobytes()


def is_deep(encoding):
    return encoding.endswith('16') or encoding.startswith('16')


def pad_rows(rows, padding):
    """Rows of bytes as a message's (step, bytes), with junk after every row."""
    rows = np.hstack([rows, np.full((len(rows), padding), 99, np.uint8)])
    return rows.shape[1], rows.tobytes()


def noise(encoding, height, width, big=False, padding=0):
    """Random pixels as a message's (step, bytes), and the RGB that must come out."""
    alpha = 'a' in encoding or encoding.endswith('4')
    channels = 4 if alpha else max(CHANNELS[encoding]) + 1
    deep = is_deep(encoding)
    dtype = np.dtype(np.uint16 if deep else np.uint8).newbyteorder('>' if big else '<')
    values = np.random.default_rng(1).integers(0, 2**16, (height, width, channels)).astype(dtype)
    expected = (values >> 8 if deep else values)[..., CHANNELS[encoding]].astype(np.uint8)
    return *pad_rows(values.reshape(height, -1).view(np.uint8), padding), expected


def mosaic(encoding, scene, big=False):
    """Return the rows of bytes of a sensor behind the filter."""
    height, width = scene.shape[:2]
    seen = np.zeros((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            color = BAYER[encoding][2 * (y % 2) + x % 2]
            seen[y, x] = scene[y, x, 'rgb'.index(color)]
    if not is_deep(encoding):
        return seen
    low = np.full_like(seen, 201)
    return np.dstack([seen, low] if big else [low, seen]).reshape(height, -1)


def packed_yuv(encoding, yuv, padding=0):
    """Return YUV (height, width, 3) as (step, bytes); the first pixel sets shared colors."""
    height, width = yuv.shape[:2]
    if encoding in PAIRS:
        y0, y1, u, v = PAIRS[encoding]
        quads = np.zeros((height, width // 2, 4), np.uint8)
        quads[..., y0], quads[..., y1] = yuv[:, ::2, 0], yuv[:, 1::2, 0]
        quads[..., u], quads[..., v] = yuv[:, ::2, 1], yuv[:, ::2, 2]
        return pad_rows(quads.reshape(height, -1), padding)
    u, v = PLANES[encoding]
    shared = yuv if encoding == 'nv24' else yuv[::2, ::2]
    chroma = np.zeros((*shared.shape[:2], 2), np.uint8)
    chroma[..., u], chroma[..., v] = shared[..., 1], shared[..., 2]
    step, luma_bytes = pad_rows(yuv[..., 0], padding)
    wide = 2 * padding if encoding == 'nv24' else padding
    return step, luma_bytes + pad_rows(chroma.reshape(len(chroma), -1), wide)[1]
