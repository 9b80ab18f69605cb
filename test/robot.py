# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node in the test's own process, and a robot beside it that publishes images and odometry."""

from collections.abc import Sequence
import threading
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
import numpy as np
from processes import Bench, DOMAIN, image_message, RELIABLE, SECOND, TAKEN_RELIABLY, TIMEOUT
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_ros.ros.node import PlaceRecognitionNode
from stavpr_ros.ros.rclpy_workarounds import PromptExecutor
from std_msgs.msg import Header

LENGTH = 5
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PARAMETERS = {
    'sequence_length': LENGTH,
    'nms_radius': 5,
    'threads': 1,
    'keyframe_change': 0.0,
    'diagnostics_period': 0.1,
}


def parameters_of(values: dict[str, object]) -> list[Parameter]:
    return [Parameter(name, value=value) for name, value in values.items()]


class NodeThread:
    """
    The node, spun by the executor of its executable on a thread of the test's process.

    :param arguments: of the command line, after ``--ros-args``.
    :param parameters: besides ``PARAMETERS``.
    """

    def __init__(self, arguments: Sequence[str], parameters: dict[str, object]) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, args=['--ros-args', *arguments], domain_id=DOMAIN)
        values = PARAMETERS | TAKEN_RELIABLY | parameters
        self.node = PlaceRecognitionNode(
            context=self._context, parameter_overrides=parameters_of(values)
        )
        self._executor = PromptExecutor(PlaceRecognitionNode.THREADS, context=self._context)
        self._executor.add_node(self.node)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        while not self._end.is_set():
            self._executor.spin_once(0.1)

    def end(self) -> None:
        self._end.set()
        self._thread.join(TIMEOUT)
        self._executor.finish(TIMEOUT)
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)


class Robot(Bench):
    """
    A bench with odometry, whose images have increasing stamps.

    ``log`` holds the lines that the node logs, ``infos`` its ``~/map_info``.
    """

    def __init__(self) -> None:
        super().__init__(RELIABLE)
        self.odometry = self.node.create_publisher(Odometry, 'odom', 100)
        self.infos: list[MapInfo] = self.listen(MapInfo, '/stavpr/map_info', LATCHED)
        self.arrays: list[DiagnosticArray] = self.listen(DiagnosticArray, '/diagnostics')
        self.log: list[str] = []
        self.node.create_subscription(Log, '/rosout', self._on_log, LATCHED)
        self.stamp = 1_700_000_000 * SECOND

    def _on_log(self, line: Log) -> None:
        self.log.append(line.msg)

    def forget(self) -> None:
        """Remove all messages of previous nodes."""
        for received in (self.log, self.infos, self.arrays, self.answers, self.diagnostics):
            received.clear()

    def show(
        self,
        image: np.ndarray | Image | CompressedImage,
        later: int = SECOND,
        publisher: Any = None,
    ) -> PlaceMatch:
        """Publish an image, or a message, stamped later than the last by so many ns."""
        self.stamp += later
        message = image_message(image) if isinstance(image, np.ndarray) else image
        message.header = Header(frame_id='camera', stamp=self.time())
        match = self.ask(message, publisher)
        assert match.header == message.header
        return match

    def time(self) -> Time:
        """Return the stamp of the last image."""
        return Time(sec=self.stamp // SECOND, nanosec=self.stamp % SECOND)

    def drive(self, images: Sequence[np.ndarray], later: int = SECOND) -> list[PlaceMatch]:
        """Return the match of each image."""
        return [self.show(image, later) for image in images]

    def statuses(self, images: Sequence[np.ndarray], later: int = SECOND) -> list[int]:
        """Return the status of each image."""
        return [match.status for match in self.drive(images, later)]

    def show_at(self, x: float, image: np.ndarray, degrees: float = 0.0) -> PlaceMatch:
        """
        Publish the next image with odometry at x, turned about z.

        Both are published again while the node has no pose of that time yet.
        """
        self.stamp += SECOND
        odometry, half = Odometry(header=Header(stamp=self.time())), np.radians(degrees) / 2
        odometry.pose.pose.position.x = float(x)
        orientation = odometry.pose.pose.orientation
        orientation.z, orientation.w = float(np.sin(half)), float(np.cos(half))
        while True:
            self.odometry.publish(odometry)
            match = self.show(image, 0)
            if 'no odometry' not in match.reason:
                return match

    def until_logged(self, words: str) -> None:
        """Wait for a line of the log with these words."""
        self.until(lambda: any(words in line for line in self.log), f'a log line with {words!r}')

    def until_map(self, **fields: object) -> MapInfo:
        """Wait until the last ``~/map_info`` has these fields, and return it."""

        def published() -> bool:
            last = self.infos[-1] if self.infos else None
            return last is not None and all(getattr(last, name) == fields[name] for name in fields)

        self.until(published, f'map_info with {fields}')
        return self.infos[-1]

    def counts(self, part: str) -> dict[str, str]:
        """Return the values of the diagnostics of a part, newer than this call."""
        self.arrays.clear()
        # the first may have been under way when this was called
        self.until(lambda: len(self.arrays) >= 2, 'diagnostics')
        status = next(s for s in self.arrays[-1].status if s.name.endswith(part))
        return {pair.key: pair.value for pair in status.values}

    def does(self, kind: type, name: str, **fields: object) -> Any:
        """Call a service that must succeed."""
        response = self.call(kind, name, **fields)
        assert response.success, response.message
        return response

    def refuses(self, kind: type, name: str, **fields: object) -> str:
        """Call a service that must fail, and return its message."""
        response = self.call(kind, name, **fields)
        assert not response.success
        return str(response.message)

    def set(self, **values: object) -> None:
        """Set parameters of the node."""
        messages = [parameter.to_parameter_msg() for parameter in parameters_of(values)]
        for result in self.call(SetParameters, 'set_parameters', parameters=messages).results:
            assert result.successful, result.reason
