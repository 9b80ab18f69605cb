# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writes image records into a new ROS 2 bag."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from stavpr_ros.checks import require_choice
from stavpr_ros.output_file import atomic_folder
from stavpr_ros.sources.bag import RAW
from stavpr_ros.sources.frame import ImageRecord, MessageRecord
from stavpr_ros.units import SECOND

STORAGES = {'sqlite3': StoragePlugin.SQLITE3, 'mcap': StoragePlugin.MCAP}
VERSION: int = 9
"""Version of the bag's metadata, as of ROS 2 Jazzy."""


def write_bag(
    path: str | Path,
    topic: str,
    records: Iterable[ImageRecord | MessageRecord],
    storage: str = 'sqlite3',
    others: Mapping[str, str] | None = None,
) -> int:
    """
    Write a bag with raw images and other messages, all of it or nothing.

    :param path: the bag's folder, which must not exist yet.
    :param topic: topic of the images.
    :param records: images and other messages, in the order of their times of recording.
    :param storage: ``sqlite3`` or ``mcap``.
    :param others: the topics of other messages: name to type.
    :returns: number of images written.
    :raises OutputError: the folder exists, or cannot be written.
    """
    require_choice('storage', storage, STORAGES)
    plugin = STORAGES[storage]
    typestore = get_typestore(Stores.ROS2_JAZZY)
    types = typestore.types
    count = 0
    with (
        atomic_folder(path) as folder,
        Writer(folder, version=VERSION, storage_plugin=plugin) as writer,  # type: ignore[arg-type]
    ):
        connection = writer.add_connection(topic, RAW, typestore=typestore)
        connections = {
            name: writer.add_connection(name, kind, typestore=typestore)
            for name, kind in (others or {}).items()
        }
        for record in records:
            if isinstance(record, MessageRecord):
                writer.write(connections[record.topic], record.time_ns, record.content)
                continue
            seconds, nanoseconds = divmod(record.stamp_ns, SECOND)
            stamp = types['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
            message = types[RAW](
                header=types['std_msgs/msg/Header'](stamp=stamp, frame_id=record.frame_id),
                height=record.height,
                width=record.width,
                encoding=record.encoding,
                is_bigendian=int(record.is_bigendian),
                step=record.step,
                data=np.frombuffer(record.data, np.uint8),
            )
            writer.write(connection, record.time_ns, typestore.serialize_cdr(message, RAW))
            count += 1
    return count
