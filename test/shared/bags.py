# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of any messages, ROS 1 or ROS 2, as other programs write them."""

from collections.abc import Iterator
from contextlib import contextmanager
import json
import shutil

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from stavpr_ros.sources.bag import COMPRESSED, ODOMETRY, RAW
from stavpr_ros.sources.bag_writer import write_bag
from stavpr_ros.sources.frame import ImageRecord

SECOND = 10**9
TEXT = 'std_msgs/msg/String'
T0 = 1_700_000_000_000_000_000


class Bag:
    """A bag that is written; topics appear with their first ``write``."""

    def __init__(self, writer, ros1: bool) -> None:
        self._writer, self._topics, self._ros1 = writer, {}, ros1
        self._store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)

    def make(self, kind: str, *fields: object, **named: object):
        """Return a message, its fields in the order of their definition."""
        return self._store.types[kind](*fields, **named)

    def define(self, name: str, text: str) -> None:
        """Add a type of message."""
        self._store.register(get_types_from_msg(text, name))

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


def records(count=5, stamped=True):
    """Yield images of noise, 6 x 8 pixels, 0.1 s apart."""
    rng = np.random.default_rng(0)
    for i in range(count):
        image = rng.integers(0, 256, (6, 8, 3), np.uint8)
        time_ns = T0 + i * 100_000_000
        yield ImageRecord.of_image(image, time_ns, time_ns - 7 if stamped else 0, 'camera')


def pixels(record):
    return record.data.reshape(record.height, record.width, 3)


def write_images(bag, images):
    """Write records on /raw, with a text beside each."""
    for image in images:
        header = bag.header(image.stamp_ns, image.frame_id)
        bag.write('/raw', RAW, image.time_ns, header, 6, 8, 'rgb8', 0, 24, image.data)
        bag.write('/text', TEXT, image.time_ns, 'hello')


def write_mixed(path, ros1=False, bad=()):
    """Write a bag with /raw, /small (PNG, those in `bad` damaged) and /text; /silent is empty."""
    with writing(path, ros1) as bag:
        bag.topic('/silent', RAW)
        write_images(bag, records())
        for i, record in enumerate(records()):
            png = cv2.imencode('.png', pixels(record)[..., ::-1].copy())[1].ravel()
            png = png[:40] if i in bad else png
            header = bag.header(record.stamp_ns)
            bag.write('/small', COMPRESSED, record.time_ns, header, 'png', png)
    return path


def write_split(folder, suffix):
    """Write a bag of three parts, of three images each, with names of ``ros2 bag record``."""
    folder.mkdir()
    names, whole, part = [], list(records(9)), folder.with_name('part')
    for i in range(3):
        storage = 'mcap' if suffix == 'mcap' else 'sqlite3'
        write_bag(part, '/raw', whole[3 * i : 3 * i + 3], storage)
        names.append(f'drive_{i}.{suffix}')
        (part / f'part.{suffix}').rename(folder / names[-1])
        shutil.rmtree(part)
    topics = [{'topic_metadata': {'name': '/raw'}, 'message_count': 9}]
    stated = {'relative_file_paths': names, 'topics_with_message_count': topics}
    (folder / 'metadata.yaml').write_text(json.dumps({'rosbag2_bagfile_information': stated}))
    return folder


def file_of(bag):
    """Return the file of the folder of a bag."""
    return next(file for file in bag.iterdir() if file.suffix in {'.db3', '.mcap'})
