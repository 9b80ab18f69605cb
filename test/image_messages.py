# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images as messages, in the encodings that cameras send."""

import array

import cv2
import numpy as np
from sensor_msgs.msg import CompressedImage, Image


def image_message(
    image: np.ndarray, stamp: int, encoding: str = 'rgb8', padding: int = 0
) -> Image:
    """Return an image message in an encoding, with padded rows."""
    if encoding == 'bgr8':
        image = image[:, :, ::-1]
    elif encoding in ('rgba8', 'bgra8'):
        order = image if encoding == 'rgba8' else image[:, :, ::-1]
        image = np.dstack([order, np.full(image.shape[:2], 255, np.uint8)])
    elif encoding in ('mono8', 'mono16'):
        image = image.astype(np.float64).mean(axis=2).astype(np.uint8)
        if encoding == 'mono16':
            image = (image.astype('>u2') << 8) + 7
            image = image.astype('>u2')
    rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
    rows = np.hstack([rows, np.full((len(rows), padding), 99, np.uint8)])
    message = Image(
        height=image.shape[0], width=image.shape[1], encoding=encoding, step=rows.shape[1]
    )
    message.is_bigendian = int(encoding == 'mono16')
    message.header.frame_id = 'camera'
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.data = array.array('B', rows.tobytes())
    return message


def compressed_message(image: np.ndarray, stamp: int, suffix: str = '.png') -> CompressedImage:
    """Return an image message as image_transport compresses it."""
    name = suffix.lstrip('.')
    message = CompressedImage(format=f'rgb8; {name} compressed bgr8')
    message.header.frame_id = 'camera'
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    message.data = array.array('B', cv2.imencode(suffix, image[:, :, ::-1])[1].tobytes())
    return message
