# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of any messages, ROS 1 or ROS 2, as other programs write them."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import get_typestore, Stores
from stavpr_ros.sources.bag import ODOMETRY, RAW

SECOND = 10**9
TEXT = 'std_msgs/msg/String'


class Bag:
    """A bag that is written; topics appear with their first ``write``."""

    def __init__(self, writer, ros1: bool) -> None:
        self._writer, self._topics, self._ros1 = writer, {}, ros1
        self._store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)

    def make(self, kind: str, *fields: object, **named: object):
        """Return a message, its fields in the order of their definition."""
        return self._store.types[kind](*fields, **named)

    def header(self, stamp: int, frame_id: str = 'camera'):
        time = self.make('builtin_interfaces/msg/Time', *divmod(stamp, SECOND))
        extra = {'seq': 0} if self._ros1 else {}
        return self.make('std_msgs/msg/Header', stamp=time, frame_id=frame_id, **extra)

    def topic(self, name: str, kind: str):
        if name not in self._topics:
            self._topics[name] = self._writer.add_connection(name, kind, typestore=self._store)
        return self._topics[name]

    def write(self, name: str, kind: str, time: int, *fields: object) -> None:
        """Write a message, recorded at a time [ns]."""
        message = self.make(kind, *fields)
        serialize = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        self.write_bytes(name, kind, time, serialize(message, kind))

    def write_bytes(self, name: str, kind: str, time: int, content: bytes) -> None:
        self._writer.write(self.topic(name, kind), time, content)


@contextmanager
def writing(path, ros1: bool = False) -> Iterator[Bag]:
    """Open a new bag."""
    with Ros1Writer(path) if ros1 else Ros2Writer(path, version=9) as writer:
        yield Bag(writer, ros1)


def write_odometry(path, stamps, ros1=False, images=()):
    """Write a bag with a pose at x = i for each stamp (ns), recorded at 100 s + i, and images."""
    with writing(path, ros1) as bag:
        bag.topic('/odom', ODOMETRY)
        bag.write('/text', TEXT, 99 * SECOND, 'x')
        still = bag.make('geometry_msgs/msg/Vector3', 0.0, 0.0, 0.0)
        twist = bag.make('geometry_msgs/msg/Twist', still, still)
        twist = bag.make('geometry_msgs/msg/TwistWithCovariance', twist, np.zeros(36))
        turned = bag.make('geometry_msgs/msg/Quaternion', 0.0, 0.0, 0.6, 0.8)
        for i, stamp in enumerate(stamps):
            point = bag.make('geometry_msgs/msg/Point', float(i), 2.0, 3.0)
            pose = bag.make('geometry_msgs/msg/Pose', point, turned)
            pose = bag.make('geometry_msgs/msg/PoseWithCovariance', pose, np.zeros(36))
            fields = bag.header(stamp, 'odom'), 'base_link', pose, twist
            bag.write('/odom', ODOMETRY, (100 + i) * SECOND, *fields)
        for image in images:
            fields = bag.header(image.stamp_ns), image.height, image.width, image.encoding
            bag.write('/image', RAW, image.time_ns, *fields, 0, image.step, image.data)
    return path
