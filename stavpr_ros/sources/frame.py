# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The items of sources: a decoded image, or a message as recorded."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from stavpr_ros.checks import require_type, rgb_image

MAX_PIXELS = 64_000_000
"""Largest decoded image: the header of a small file may claim one that exhausts the memory."""


@dataclass(frozen=True, eq=False)
class Frame:
    """
    One image of a sequence.

    :param image: RGB, shape (height, width, 3), C-contiguous; uint8, or uint16 of a source that
        leaves its range of values open.
    :param stamp: when it was taken, nanoseconds; 0 = unknown.
    :param identifier: a file name, or topic and number.
    :raises InputError: another image, a stamp that is no whole number, or an
        identifier that is no text.
    """

    image: np.ndarray
    stamp: int
    identifier: str

    def __post_init__(self) -> None:
        image = rgb_image(self.image, 'image of the frame', 'uint8', 'uint16')
        object.__setattr__(self, 'image', image)
        whole = 'whole nanoseconds, as time.time_ns(); 0 = unknown'
        require_type('stamp', self.stamp, (int, np.integer), whole)
        require_type('identifier', self.identifier, str, 'a text, such as the name of the file')


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """
    One recorded ``sensor_msgs/Image``, field by field, not decoded.

    :param time_ns: when it was recorded, nanoseconds: the pace of a replay.
    :param stamp_ns: header stamp, nanoseconds; may be 0 or repeat.
    :param encoding: as in ``sensor_msgs/image_encodings``.
    :param is_bigendian: byte order of 16 bit values.
    :param step: bytes from one row to the next.
    :param data: the bytes: anything with the buffer protocol.
    """

    time_ns: int
    stamp_ns: int
    frame_id: str
    height: int
    width: int
    encoding: str
    is_bigendian: bool
    step: int
    data: Any

    @classmethod
    def of_image(
        cls, image: np.ndarray, time_ns: int, stamp_ns: int | None = None, frame_id: str = ''
    ) -> Self:
        """
        Make a record of an RGB image.

        :param image: RGB, uint8 or uint16, shape (height, width, 3).
        :param time_ns: when it was recorded, nanoseconds.
        :param stamp_ns: header stamp, nanoseconds; the time of recording if not given.
        :raises InputError: another image.
        """
        image = rgb_image(image, 'image', 'uint8', 'uint16')
        height, width = image.shape[:2]
        stamp = time_ns if stamp_ns is None else stamp_ns
        data = np.ascontiguousarray(image, f'<u{image.itemsize}').reshape(-1).view(np.uint8)
        layout = f'rgb{8 * image.itemsize}', False, width * 3 * image.itemsize
        return cls(time_ns, stamp, frame_id, height, width, *layout, data)


@dataclass(frozen=True)
class RecordedTopic:
    """
    One topic of a bag.

    :param message_type: such as ``nav_msgs/msg/Odometry``.
    :param latched: whether a publisher kept its messages for late subscribers.
    """

    name: str
    message_type: str
    latched: bool


@dataclass(frozen=True)
class MessageRecord:
    """
    One recorded message of any type.

    :param time_ns: when it was recorded, nanoseconds.
    :param topic: its name.
    :param content: the message, serialized as CDR.
    """

    time_ns: int
    topic: str
    content: bytes
