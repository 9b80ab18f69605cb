# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The packets of a video topic as images, with PyAV: one image for each packet."""

from collections.abc import Callable
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
from stavpr_ros.errors import ImageError, UnavailableError
from stavpr_ros.sources import files
from stavpr_ros.sources.video_decoder import NO_PYAV, REASONS, rgb_of

FFMPEG = 'ffmpeg_image_transport_msgs/msg/FFMPEGPacket'
FOXGLOVE = 'foxglove_msgs/msg/CompressedVideo'
DEFINITIONS = {
    FFMPEG: 'std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n'
    'uint8 flags\nbool is_bigendian\nuint8[] data\n',
    # newer ones have more fields behind these
    FOXGLOVE: 'builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n',
}
"""The published definitions of the messages, as of 2026."""
ROS1_FFMPEG = (
    'std_msgs/Header header\nuint8[] data\nint32 img_width\nint32 img_height\nstring encoding\n'
    'uint64 pts\nuint8 flags\n'
)
CODECS = {'h264': re.compile('[hx]264|avc'), 'hevc': re.compile('[hx]265|hevc')}
"""Decoders of FFmpeg, and what the names of their encoders contain, such as libx264."""
VIDEO = re.compile(r'[hx]26[45]|avc|hevc|av1|vp[89]|theora')  # formats of CompressedImage
UNIT = re.compile(rb'\x00\x00\x01(.)', re.DOTALL)  # Annex B: start code, type of the unit
KEY_FRAME = 1  # flag of FFmpeg
MAX_GAP = 1000  # packets; a larger step of pts is another stream, or a time
NO_KEY_FRAME = 'no key frame'  # kind of an error


def is_packet(message: Any) -> bool:
    """Return whether the ``format`` of a ``CompressedImage`` is a video, not an image."""
    return bool(VIDEO.search(str(getattr(message, 'format', '')).lower()))


class VideoImage:
    """
    The image of a packet, as a message: ``header``, and pixels that are converted when needed.

    :param frame: a frame of PyAV, or why there is none.
    :param convert: returns the RGB image of a frame.
    """

    def __init__(self, header: Any, frame: Any, convert: Callable[[Any], np.ndarray]) -> None:
        self.header, self._frame, self._convert = header, frame, convert

    def decode(self) -> np.ndarray:
        """
        Return the image: RGB, uint8, shape (height, width, 3), C-contiguous.

        :raises ImageError: the packet has no image, or one that cannot be decoded.
        """
        if isinstance(self._frame, ImageError):
            raise self._frame
        return self._convert(self._frame)


class VideoStream:
    """
    Decodes the packets of one topic, in the order of sending: H.264 and H.265 without B frames.

    After a lost or damaged packet, the next images would be wrong: packets have no image until a
    key frame, where a new decoder starts.

    :raises UnavailableError: PyAV is not installed.

    ``lost`` is the number of missing packets, where the publisher counts them (``pts``).
    """

    def __init__(self) -> None:
        try:
            from av.video.reformatter import VideoReformatter
        except ImportError as error:
            raise UnavailableError(f'a video topic {REASONS[NO_PYAV]}') from error
        self.lost = 0
        self._reformatter = VideoReformatter()
        self._context: Any = None  # None until a key frame
        self._codec = ''
        self._number = 0  # number of the packet
        self._pts: int | None = None  # stated by the last packet
        self._counts = False  # pts counts packets; other publishers state a time

    def interrupt(self) -> None:
        """Wait for a key frame: packets were lost."""
        self._context = None

    def read(self, message: Any, make_header: Callable[..., Any] = SimpleNamespace) -> VideoImage:
        """
        Decode a packet; one that gives no image becomes an error of the image.

        :param message: ``FFMPEGPacket``, ``CompressedVideo`` or ``CompressedImage``, or any object
            with its fields.
        :param make_header: makes a header of ``stamp`` and ``frame_id``, if the message has none.
        """
        header = getattr(message, 'header', None)
        if header is None:
            header = make_header(stamp=message.timestamp, frame_id=message.frame_id)
        try:
            frame = self._decode(message)
        except ImageError as error:
            frame = error
            self.interrupt()
        return VideoImage(header, frame, lambda image: rgb_of(image, self._reformatter))

    def _decode(self, message: Any) -> Any:
        import av

        is_ffmpeg = hasattr(message, 'pts')
        named = message.encoding if is_ffmpeg else message.format
        codec = _codec(named)
        data = files.flat_bytes(message.data).tobytes()
        is_key = message.flags & KEY_FRAME if is_ffmpeg else _has_key_frame(data, codec)
        if is_ffmpeg:
            self._count(int(message.pts))
            width = getattr(message, 'width', 0) or getattr(message, 'img_width', 0)
            height = getattr(message, 'height', 0) or getattr(message, 'img_height', 0)
            if width * height > files.MAX_PIXELS:
                raise files.too_large(width, height)
        if codec != self._codec:
            self._codec, self._context = codec, None
        if self._context is None:
            if not is_key:
                raise ImageError(
                    f'packet of {named!r} before a key frame: the first ones, or behind lost or '
                    'damaged packets; more key frames (gop_size) make this shorter',
                    kind=NO_KEY_FRAME,
                )
            self._context = av.CodecContext.create(codec, 'r')
            self._context.thread_count = 1  # more of them delay images
            self._context.options = {'max_pixels': str(files.MAX_PIXELS)}
        self._number += 1
        reason = ''
        try:
            packet = av.Packet(data)
            packet.pts = self._number
            frames = self._context.decode(packet)
        except Exception as error:  # damage raises errors of several types
            frames, reason = [], f': {error}'
        if len(frames) != 1 or frames[0].pts != self._number or frames[0].is_corrupt:
            raise ImageError(
                f'packet of {len(data)} bytes of {named!r} gives no image of its own: damaged, '
                f'too large, or with B frames (max_b_frames: 0 prevents them){reason}',
                kind='damaged',
            )
        return frames[0]

    def _count(self, pts: int) -> None:
        """Count missing packets, and wait for a key frame behind them."""
        step = 0 if self._pts is None else pts - self._pts
        self._pts = pts
        self._counts = self._counts or step == 1
        if self._counts and 1 < step <= MAX_GAP:
            self.lost += step - 1
            self.interrupt()


def _codec(name: str) -> str:
    """Return the decoder of ``codec;pixels;...``, or of the name of an encoder or format."""
    for codec, pattern in CODECS.items():
        if pattern.search(name.lower()):
            return codec
    raise ImageError(
        f'video of {name!r} is not decoded: expected H.264 or H.265; choose another encoder',
        kind='encoding',
    )


def _has_key_frame(data: bytes, codec: str) -> bool:
    """Return whether a packet has a key frame, or the parameters before one."""
    kinds = (unit[1][0] for unit in UNIT.finditer(data))
    if codec == 'h264':
        return any(kind & 31 in (5, 7) for kind in kinds)
    return any(16 <= kind >> 1 & 63 <= 23 for kind in kinds)
