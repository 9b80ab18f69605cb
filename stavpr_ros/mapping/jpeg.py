# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sizes of JPEG images from their headers, of many images at once, before any is decoded."""

import numpy as np

MAX_THUMBNAIL_PIXELS = 2**24  # 50 MB when it is decoded
MAX_SEGMENTS = 64  # before the frame header
FIRST_FRAME, LAST_FRAME = 0xC0, 0xC2  # markers: baseline, extended, progressive
FRAME_BYTES = 10  # marker, length, precision, height, width, components


def jpeg_pixels(content: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """
    Return the number of pixels of each image; -1 = not a JPEG, 0 = an empty image.

    :param content: the images one after the other, shape (bytes,), uint8.
    :param ends: end of each image in ``content``, not decreasing, shape (n,), int64.
    """
    starts = np.concatenate([[0], ends[:-1]]).astype(np.int64)
    pixels = np.where(ends > starts, -1, 0)
    padded = np.append(content, np.zeros(FRAME_BYTES, np.uint8))
    # numbers of the images whose header is not found yet, and positions of the next marker
    images = np.flatnonzero(ends - starts >= 2 + FRAME_BYTES)
    images = images[(padded[starts[images]] == 0xFF) & (padded[starts[images] + 1] == 0xD8)]
    at = starts[images] + 2
    for _ in range(MAX_SEGMENTS):
        inside = at + FRAME_BYTES <= ends[images]
        images, at = images[inside], at[inside]
        if not len(images):
            break
        header = padded[at[:, None] + np.arange(FRAME_BYTES)].astype(np.int64)
        frame = (header[:, 1] >= FIRST_FRAME) & (header[:, 1] <= LAST_FRAME)
        frame &= header[:, 0] == 0xFF
        sizes = (header[:, 5] * 256 + header[:, 6]) * (header[:, 7] * 256 + header[:, 8])
        pixels[images[frame]] = np.where(sizes[frame] > 0, sizes[frame], -1)
        length = header[:, 2] * 256 + header[:, 3]
        # no frame header after the scan starts (0xDA) or the image ends (0xD9)
        go_on = (header[:, 0] == 0xFF) & (header[:, 1] >= 0xC0) & ~frame & (length >= 2)
        go_on &= (header[:, 1] != 0xDA) & (header[:, 1] != 0xD9)
        images, at = images[go_on], (at + 2 + length)[go_on]
    return pixels
