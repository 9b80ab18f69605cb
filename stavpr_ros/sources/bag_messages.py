# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The messages of any topics of a bag, serialized: what is replayed beside the images."""

from collections.abc import Collection, Iterator
import math
from pathlib import Path
from typing import Any

from rosbags.convert.converter import migrate_bytes
from rosbags.interfaces import Connection, ConnectionExtRosbag1, QosDurability
from rosbags.typesys import get_typestore, Stores
from stavpr_ros.errors import SourceError
from stavpr_ros.sources.bag_file import message_count, message_type, open_bag
from stavpr_ros.sources.frame import MessageRecord, RecordedTopic


def list_topics(path: Path) -> dict[str, RecordedTopic]:
    """
    Return the topics of a bag that have messages, by their names.

    :raises SourceError: the bag cannot be read.
    """
    with open_bag(path) as bag:
        return {
            name: RecordedTopic(
                name, message_type(connections[0]), any(map(_is_latched, connections))
            )
            for name, connections in sorted(bag.topics.items())
            if message_count(connections)
        }


def read_messages(
    path: Path, topics: Collection[str], start: float = 0.0, duration: float = math.inf
) -> Iterator[MessageRecord]:
    """
    Yield the messages of topics, in the order of recording.

    Messages of ROS 1 are converted; of those, the common interfaces are known.

    :param topics: names of :func:`list_topics`, at least one.
    :param start: seconds after the start of the bag.
    :param duration: seconds from there on.
    :raises SourceError: the bag is damaged, or a message cannot be converted.
    """
    with open_bag(path) as bag:
        convert = _Ros1() if bag.is_ros1 else None
        for connection, time_ns, raw in bag.messages(topics, start, duration):
            kind = message_type(connection)
            content = raw if convert is None else convert(kind, raw)
            yield MessageRecord(time_ns, connection.topic, bytes(content))


class _Ros1:
    """Converts serialized messages of ROS 1 to messages of ROS 2."""

    def __init__(self) -> None:
        self._old, self._new = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
        self._cache: dict[str, Any] = {}

    def __call__(self, kind: str, raw: bytes) -> memoryview | bytes:
        if kind not in self._old.fielddefs or kind not in self._new.fielddefs:
            raise SourceError(
                f'{kind} of a ROS 1 bag cannot be converted: expected a type of the common '
                'interfaces; leave its topic out'
            )
        try:
            return migrate_bytes(
                self._old, self._new, kind, kind, self._cache, raw, src_is2=False, dst_is2=True
            )
        except Exception as error:  # garbage raises errors of any type
            raise SourceError(f'{len(raw)} bytes are no {kind}: {error}') from error


def _is_latched(connection: Connection) -> bool:
    extra = connection.ext
    if isinstance(extra, ConnectionExtRosbag1):
        return bool(extra.latching)
    return any(
        profile.durability is QosDurability.TRANSIENT_LOCAL
        for profile in extra.offered_qos_profiles
    )
