# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node and one camera: how the node is started, and images with their matches."""

from pathlib import Path
import time

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from image_messages import image_message
import numpy as np
from processes import Bench, Process
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, Image
from stavpr_msgs.msg import PlaceMatch
from std_msgs.msg import Header
from std_srvs.srv import Trigger

LENGTH = 5
SECOND = 10**9


def start_node(folder: Path, *options: str) -> Process:
    """
    Start a node with further command-line options; one at a time, since all have one name.

    :param folder: holds ``route.stavpr``, the map; the log goes there.
    """
    values = {
        'map_path': folder / 'route.stavpr',
        'threshold': 0.2,
        'mode': 'paper',
        'nms_radius': 5,
    }
    values |= {'sequence_length': LENGTH, 'diagnostics_period': 0.2}
    words = [word for name, value in values.items() for word in ('-p', f'{name}:={value}')]
    return Process(folder / 'node.log', 'node', '--ros-args', *words, *options)


def nanoseconds(stamp: Time) -> int:
    return stamp.sec * SECOND + stamp.nanosec


class Camera:
    """
    Publishes images with increasing stamps, and returns the match of each.

    :param kind: type of the publisher's messages.
    """

    def __init__(self, bench: Bench, publisher: Publisher, kind: type = Image) -> None:
        self.bench, self.publisher, self.kind = bench, publisher, kind
        self.stamp = 1_700_000_000 * SECOND
        self.diagnostics = bench.listen(DiagnosticArray, '/diagnostics')

    def connect(self) -> None:
        """Publish empty images until a match is received, as the bench does."""
        self.bench.until(lambda: self.publisher.get_subscription_count() > 0, 'the node')
        before, sent = len(self.bench.answers), 0
        while len(self.bench.answers) == before:
            sent += 1
            assert sent < 100
            self.publisher.publish(self.kind(header=Header(stamp=Time(nanosec=sent))))
            self.bench.executor.spin_once(timeout_sec=0.5)
        self.bench.until(
            lambda: self.bench.answers[-1].header.stamp.nanosec == sent, 'the last match'
        )

    def show(self, image: np.ndarray | Image | CompressedImage, later: int = SECOND) -> PlaceMatch:
        """Publish an image, or a message, stamped later than the last one by so many ns."""
        self.stamp += later
        message = image_message(image, 0) if isinstance(image, np.ndarray) else image
        message.header = Header(frame_id='camera')
        message.header.stamp = Time(sec=self.stamp // SECOND, nanosec=self.stamp % SECOND)
        count = len(self.bench.answers)
        self.publisher.publish(message)
        self.bench.until(lambda: len(self.bench.answers) > count, 'a match')
        assert len(self.bench.answers) == count + 1
        assert self.bench.answers[-1].header == message.header
        return self.bench.answers[-1]

    def statuses(self, images: list, later: int = SECOND) -> list[int]:
        """Return the status of each of several images."""
        return [self.show(image, later).status for image in images]

    def counts(self, part: str) -> dict[str, str]:
        """Return the values of the diagnostics of a part, newer than this call."""
        now, arrays = time.time_ns(), self.diagnostics
        self.bench.until(
            lambda: bool(arrays) and nanoseconds(arrays[-1].header.stamp) > now, 'diagnostics'
        )
        found = [status for status in arrays[-1].status if status.name.endswith(part)]
        return {pair.key: pair.value for pair in found[0].values}

    def reset(self) -> None:
        assert self.bench.call(Trigger, 'reset').success

    def set(self, **values: object) -> None:
        """Set parameters of the node."""
        for name, value in values.items():
            assert self.bench.set_parameter(name, value) == (True, '')
