"""A node that watches one camera of a test: how it is started, and images with the answers to them."""

import time
from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from image_messages import image_message
from processes import Bench, Process
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from stavpr_msgs.msg import PlaceMatch

LENGTH = 5
SECOND = 10**9


def start_node(folder: Path, *options: str) -> Process:
    """
    Start a node with more options of its command line; all are called the same, so one at a time.

    :param folder: holds ``route.stavpr``, the map; the log goes there.
    """
    values = {'map_path': folder / 'route.stavpr', 'threshold': 0.2, 'mode': 'paper', 'nms_radius': 5}
    values |= {'sequence_length': LENGTH, 'diagnostics_period': 0.2}
    words = [word for name, value in values.items() for word in ('-p', f'{name}:={value}')]
    return Process(folder / 'node.log', 'node', '--ros-args', *words, *options)


def nanoseconds(stamp: Time) -> int:
    return stamp.sec * SECOND + stamp.nanosec


class Camera:
    """
    Publishes images, each later than the one before, and returns the answer to each.

    :param kind: type of the publisher's messages.
    """

    def __init__(self, bench: Bench, publisher: Publisher, kind: type = Image) -> None:
        self.bench, self.publisher, self.kind = bench, publisher, kind
        self.stamp = 1_700_000_000 * SECOND
        self.diagnostics = bench.listen(DiagnosticArray, '/diagnostics')

    def connect(self) -> None:
        """Publish empty images until they are answered, as the bench does for its own publisher."""
        self.bench.until(lambda: self.publisher.get_subscription_count() > 0, 'the node')
        before, sent = len(self.bench.answers), 0
        while len(self.bench.answers) == before:
            sent += 1
            assert sent < 100
            self.publisher.publish(self.kind(header=Header(stamp=Time(nanosec=sent))))
            self.bench.executor.spin_once(timeout_sec=0.5)
        self.bench.until(lambda: self.bench.answers[-1].header.stamp.nanosec == sent, 'the last answer')

    def show(self, image: np.ndarray | Image | CompressedImage, later: int = SECOND) -> PlaceMatch:
        """Publish an image, or a message, stamped so much later than the last one [ns]."""
        self.stamp += later
        message = image_message(image, 0) if isinstance(image, np.ndarray) else image
        message.header = Header(frame_id='camera')
        message.header.stamp = Time(sec=self.stamp // SECOND, nanosec=self.stamp % SECOND)
        count = len(self.bench.answers)
        self.publisher.publish(message)
        self.bench.until(lambda: len(self.bench.answers) > count, 'an answer')
        assert len(self.bench.answers) == count + 1
        assert self.bench.answers[-1].header == message.header
        return self.bench.answers[-1]

    def statuses(self, images: list, later: int = SECOND) -> list[int]:
        """Show several."""
        return [self.show(image, later).status for image in images]

    def counts(self, part: str) -> dict[str, str]:
        """Return the values of the diagnostics of a part as they are now, by the clock of the machine."""
        now, arrays = time.time_ns(), self.diagnostics
        self.bench.until(lambda: bool(arrays) and nanoseconds(arrays[-1].header.stamp) > now, 'diagnostics')
        found = [status for status in arrays[-1].status if status.name.endswith(part)]
        return {pair.key: pair.value for pair in found[0].values}

    def reset(self) -> None:
        assert self.bench.call(Trigger, 'reset').success

    def set(self, **values: object) -> None:
        """Set parameters of the node."""
        for name, value in values.items():
            assert self.bench.set_parameter(name, value) == (True, '')
