# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The images of one topic of a ROS 1 or ROS 2 bag as a sequence, and its odometry."""

from collections.abc import Callable, Iterator
import math
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from stavpr_ros.errors import ImageError, SourceError
from stavpr_ros.sources.bag_file import message_count, message_type, open_bag, OpenBag
from stavpr_ros.sources.encodings import decode_message
from stavpr_ros.sources.files import ToBytes
from stavpr_ros.sources.frame import Frame, ImageRecord
from stavpr_ros.sources.notes import note_once
from stavpr_ros.sources.oddities import RECENT, source_of, speed_oddity, StreamWatch
from stavpr_ros.sources.video_topic import FFMPEG, FOXGLOVE, is_packet, VideoStream
from stavpr_ros.units import SECOND, WRAP

RAW = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
PIXEL_FIELDS = 'height', 'width', 'encoding', 'is_bigendian', 'step', 'data'
VIDEO = {FFMPEG, FOXGLOVE}
ODOMETRY = 'nav_msgs/msg/Odometry'
MAX_DISORDER = SECOND // 2  # of messages; more is a clock that jumped back
MIN_MESSAGE = 16  # bytes of a message in a bag, with its entry in the index
Item = TypeVar('Item')


class BagSource:
    """
    The images of one topic, raw, compressed or video, in the order of recording.

    Iterating yields :class:`Frame` with the header's stamp (the time of recording where that is 0)
    and ``topic#i`` as identifier, i counting the topic's messages from 0. Every iteration opens
    the bag again. ``to_bytes`` and ``min_size`` are as of a
    :class:`stavpr_ros.sources.folder.FolderSource`.

    :param path: a ROS 1 .bag file; a ROS 2 bag: its folder, or its .db3 or .mcap file.
    :param topic: the image topic; may be left out if there is only one.
    :param on_error: called with the :class:`ImageError` of an image that cannot be decoded, which
        is then skipped; without it the error is raised.
    :raises SourceError: the bag cannot be read, the topic is missing or ambiguous.
    """

    def __init__(
        self,
        path: str | Path,
        topic: str | None = None,
        on_error: Callable[[ImageError], None] | None = None,
    ) -> None:
        self.path = Path(path)
        self.on_error = on_error
        self.to_bytes: ToBytes | None = None
        self.min_size: tuple[int, int] | None = None
        self._notes: dict[str, str] = {}  # oddities, by their first words
        with open_bag(self.path) as bag:
            topics = _topics(bag)
        self.topic = _choose_topic(self.path, topics, topic)
        self.message_type, self._count = topics[self.topic]
        files = self.path.iterdir() if self.path.is_dir() else [self.path]
        self._max_count = sum(file.stat().st_size for file in files) // MIN_MESSAGE

    def __len__(self) -> int:
        """
        Return the number of the topic's messages, decodable or not, as stated by the bag.

        At most as many as its files have room for: list() reserves memory for so many.
        """
        return min(max(self._count, 0), self._max_count)

    def __iter__(self) -> Iterator[Frame]:
        """Decode one image after the other."""
        return self._read(self._frame)

    def records(self, start: float = 0.0, duration: float = math.inf) -> Iterator[ImageRecord]:
        """
        Yield the messages as recorded; compressed images decoded to ``rgb8``.

        :param start: seconds after the start of the bag.
        :param duration: seconds from there on.
        :raises SourceError: the bag is damaged further on.
        """
        return self._read(self._record, start, duration)

    def _frame(self, index: int, time_ns: int, message: Any) -> Frame:
        image = decode_message(message, self.min_size, self.to_bytes)
        return Frame(image, _stamp(message) or time_ns, f'{self.topic}#{index}')

    def _record(self, _: int, time_ns: int, message: Any) -> ImageRecord:
        stamp_ns, frame_id = _stamp(message), message.header.frame_id
        if self.message_type != RAW:
            image = decode_message(message, to_bytes=np.asarray)  # the map decides the range
            return ImageRecord.of_image(image, time_ns, stamp_ns, frame_id)
        return ImageRecord(
            time_ns, stamp_ns, frame_id, *(getattr(message, name) for name in PIXEL_FIELDS)
        )

    def _read(
        self,
        finish: Callable[[int, int, Any], Item],
        start: float = 0.0,
        duration: float = math.inf,
    ) -> Iterator[Item]:
        stream, watch = None, StreamWatch()
        with open_bag(self.path) as bag:
            index = -1
            messages = bag.messages({self.topic}, start, duration)
            for index, (_, time_ns, raw) in enumerate(messages):
                try:
                    message = self._message(bag, raw)
                    if self.message_type in VIDEO or is_packet(message):
                        stream = stream or VideoStream()
                        message = stream.read(message)
                    watch.add(_stamp(message), time_ns, source_of(message))
                    item = finish(index, time_ns, message)
                    if (index + 1) % RECENT == 0:
                        self._note(watch)
                except ImageError as error:
                    image_error = ImageError(
                        f'{self.path}, {self.topic}#{index}: {error}', kind=error.kind
                    )
                    if self.on_error is None:
                        raise image_error from error
                    self.on_error(image_error)
                    continue
                yield item
            self._note(watch)
            if (start, duration) == (0, math.inf) and index + 1 < self._count:
                note_once(
                    f'{self.path} ends early: {index + 1} of the {self._count} messages of '
                    f'{self.topic} that it states are present'
                )

    def _note(self, watch: StreamWatch) -> None:
        for text in watch.oddities():
            first = self._notes.setdefault(text.split()[0], text)  # later ones have other numbers
            note_once(f'{self.path}, {self.topic}: {first}')

    def _message(self, bag: OpenBag, raw: bytes) -> Any:
        try:
            return bag.deserialize(raw, self.message_type)
        except Exception as error:  # garbage raises errors of any type
            raise ImageError(
                f'{len(raw)} bytes are no {self.message_type}: {error}', kind='damaged'
            ) from error


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) % WRAP * SECOND + int(stamp.nanosec)


def _topics(bag: OpenBag) -> dict[str, tuple[str, int]]:
    """Topic to (type, messages); the publishers of one topic added up."""
    return {
        name: (
            ' and '.join(sorted(set(map(message_type, connections)))),
            message_count(connections),
        )
        for name, connections in sorted(bag.topics.items())
    }


def _choose_topic(path: Path, topics: dict[str, tuple[str, int]], topic: str | None) -> str:
    """Return the requested image topic, or the only one; an error lists the topics."""
    kinds = {RAW, COMPRESSED, *VIDEO}
    images = {name: info for name, info in topics.items() if info[0] in kinds}
    if topic is not None:
        return _find_topic(path, topics, topic, kinds)
    nonempty = {name: info for name, info in images.items() if info[1]}
    if len(nonempty) == 1:
        return next(iter(nonempty))
    if nonempty:
        raise SourceError(
            f'{path} has {len(nonempty)} image topics, choose one (--topic): {_describe(nonempty)}'
        )
    expected = ', '.join([RAW, COMPRESSED, *sorted(VIDEO)])
    text = f'{path} has no images (expected {expected}): there are {_describe(topics)}'
    if any('Packet' in kind or 'Compressed' in kind for kind, _ in topics.values()):
        text += '; `ros2 run image_transport republish TRANSPORT raw` converts it while played'
    raise SourceError(text)


def _find_topic(
    path: Path, topics: dict[str, tuple[str, int]], topic: str, kinds: set[str]
) -> str:
    """Return the topic of this name, with or without a slash, if it is of these kinds."""
    suitable = {name: info for name, info in topics.items() if info[0] in kinds}
    name = next((name for name in topics if name.strip('/') == topic.strip('/')), None)
    if name in suitable and topics[name][1]:
        return name
    where = 'is not in' if name is None else f'is of type {topics[name][0]} in'
    where = 'has no messages in' if name in suitable else where
    raise SourceError(
        f'topic {topic!r} {where} {path}: expected one of {_describe(suitable or topics)}'
    )


def _describe(topics: dict[str, tuple[str, int]]) -> str:
    rows = [f'{name} ({kind}, {count} messages)' for name, (kind, count) in topics.items()]
    return ', '.join(rows) or 'no topics at all'


def read_odometry(path: str | Path, topic: str) -> tuple[np.ndarray, np.ndarray]:
    """
    Read the poses of one topic of ``nav_msgs/Odometry``.

    :param path: a ROS 1 .bag file; a ROS 2 bag: its folder, or its .db3 or .mcap file.
    :param topic: with or without the leading slash.
    :returns: stamps of the headers (times of recording where they are 0), ns, shape (m,), int64,
        in order; x y z (meters) and quaternion x y z w, shape (m, 7), float64, as recorded; a row
        of NaN for a message that is damaged or has a stamp of another time.
    :raises SourceError: the bag cannot be read, the topic is missing, or time jumps back in it.
    """
    path = Path(path)
    stamps: list[int] = []
    poses = []
    with open_bag(path) as bag:
        name = _find_topic(path, _topics(bag), topic, {ODOMETRY})
        for _, time_ns, raw in bag.messages({name}):
            try:
                message = bag.deserialize(raw, ODOMETRY)
            except Exception:  # garbage raises errors of any type
                stamps.append(stamps[-1] if stamps else 0)
                poses.append((math.nan,) * 7)
                continue
            stamps.append(_stamp(message) or time_ns)
            p, q = message.pose.pose.position, message.pose.pose.orientation
            poses.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    if not stamps:
        raise SourceError(f'odometry {topic!r} of {path} has none of the messages that it states')
    when, where = np.array(stamps, np.int64), np.array(poses, np.float64)
    before, after = when[:-2], when[2:]  # a single stamp of another time is invalid
    is_alone = (when[1:-1] < before - MAX_DISORDER) | (when[1:-1] > after + MAX_DISORDER)
    alone = 1 + np.flatnonzero(is_alone & (after >= before - MAX_DISORDER))
    when[alone], where[alone] = when[alone - 1], np.nan
    if text := speed_oddity(when, where):
        note_once(f'{path}, {topic}: {text}')
    back = np.maximum.accumulate(when) - when
    if back.max() > MAX_DISORDER:
        i = int(np.argmax(back > MAX_DISORDER))
        raise SourceError(
            f'odometry {topic!r} of {path} goes back by {back[i] / SECOND:.1f} s at message {i}: '
            'expected one run, cut the bag'
        )
    order = np.argsort(when, kind='stable')
    return when[order], where[order]
