# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node in the test's own process, and a robot beside it: images, odometry, services."""

import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
import numpy as np
from processes import DOMAIN, SECOND, TIMEOUT
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from stavpr_msgs.msg import MapInfo, PlaceMatch
from stavpr_ros.ros.node import PlaceRecognitionNode
from stavpr_ros.ros.rclpy_workarounds import PromptExecutor
from std_msgs.msg import Header

LENGTH = 5
RESEND = 20  # attempts to receive a response until a probe is sent again
RELIABLE = QoSProfile(depth=1000)
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PARAMETERS = {
    'sequence_length': LENGTH,
    'nms_radius': 5,
    'min_probability': 0.05,  # windows as short as these are certain of nothing
    'threads': 1,
    'keyframe_change': 0.0,
    'features': 'gradient',
    'diagnostics_period': 0.1,
    'qos_overrides./image.subscription.depth': 1000,
}


def parameters_of(values: dict[str, object]) -> list[Parameter]:
    return [Parameter(name, value=value) for name, value in values.items()]


class NodeThread:
    """
    The node, spun by the executor of its executable on a thread of the test's process.

    :param context: the robot's. With one of its own, the node would be another participant
        of the same process: on a busy machine, Fast DDS 2.14 sent one in 50 of those nothing of
        the endpoints that were there before it, however long it waited.
    :param arguments: of the command line, after ``--ros-args``.
    :param parameters: besides ``PARAMETERS``.
    """

    def __init__(
        self, context: rclpy.Context, arguments: Sequence[str], parameters: dict[str, object]
    ) -> None:
        self.node = PlaceRecognitionNode(
            context=context,
            cli_args=['--ros-args', *arguments],
            parameter_overrides=parameters_of(PARAMETERS | parameters),
        )
        self._executor = PromptExecutor(PlaceRecognitionNode.THREADS, context=context)
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


def image_message(image: np.ndarray, stamp: int = 0, encoding: str = 'rgb8') -> Image:
    """Return an image, rgb8 or bgr8, as a message with padded rows."""
    height, width, _ = image.shape
    message = Image(height=height, width=width, encoding=encoding, step=3 * width + 5)
    rows = np.pad(image[..., ::-1] if encoding == 'bgr8' else image, ((0, 0), (0, 2), (0, 0)))
    message.data = array.array('B', rows.reshape(height, -1)[:, : message.step].tobytes())
    message.header = Header(
        frame_id='camera', stamp=Time(sec=stamp // SECOND, nanosec=stamp % SECOND)
    )
    return message


class Robot:
    """
    A node beside the tested one: publishes images with increasing stamps, and odometry.

    ``answers`` holds the matches, ``log`` the lines that the node logs, ``infos`` its
    ``~/map_info``, ``arrays`` the diagnostics and ``diagnostics`` the last of each part.
    """

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('robot', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publisher = self.node.create_publisher(Image, 'image', RELIABLE)
        self.odometry = self.node.create_publisher(Odometry, 'odom', 100)
        self.answers: list[PlaceMatch] = self.listen(PlaceMatch, '/stavpr/match', RELIABLE)
        self.infos: list[MapInfo] = self.listen(MapInfo, '/stavpr/map_info', LATCHED)
        self.arrays: list[DiagnosticArray] = []
        self._array_times: list[int] = []  # when they were published, ns
        self.diagnostics: dict[str, DiagnosticStatus] = {}
        self.log: list[str] = []
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.node.create_subscription(
            Log, '/rosout', lambda line: self.log.append(line.msg), LATCHED
        )
        self.stamp = 1_700_000_000 * SECOND

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def _on_diagnostics(self, message: DiagnosticArray, info: dict[str, int]) -> None:
        self.arrays.append(message)
        self._array_times.append(info['source_timestamp'])
        for status in message.status:
            self.diagnostics[status.name.partition(': ')[2]] = status

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
        header, half = Header(frame_id='wheels', stamp=self.time()), np.radians(degrees) / 2
        odometry = Odometry(header=header, child_frame_id='base')
        odometry.pose.pose.position.x = float(x)
        orientation = odometry.pose.pose.orientation
        orientation.z, orientation.w = float(np.sin(half)), float(np.cos(half))
        end = time.monotonic() + TIMEOUT
        while time.monotonic() < end:
            self.odometry.publish(odometry)
            match = self.show(image, 0)
            if 'no odometry' not in match.reason:
                return match
        raise AssertionError('the node received no odometry')

    def until_logged(self, words: str) -> None:
        """Wait for a line of the log with these words."""
        self.until(lambda: any(words in line for line in self.log), f'a log line with {words!r}')

    def until_map(self, **fields: object) -> MapInfo:
        """Wait until the last ``~/map_info`` has these fields, and return it."""

        def is_published() -> bool:
            last = self.infos[-1] if self.infos else None
            return last is not None and all(getattr(last, name) == fields[name] for name in fields)

        self.until(is_published, f'map_info with {fields}')
        return self.infos[-1]

    def counts(self, part: str) -> dict[str, str]:
        """Return the values of the diagnostics of a part, newer than this call."""
        called = time.time_ns()
        self._array_times.clear()
        # the first may have been made before this was called
        self.until(lambda: sum(t > called for t in self._array_times) >= 2, 'diagnostics')
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

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, f'{what}: not within {TIMEOUT:g} s'
            self.executor.spin_once(timeout_sec=0.05)

    def wait_for_node(self, publisher: Publisher | None = None, kind: type = Image) -> None:
        """
        Wait until the node receives images and its matches arrive.

        A matched publisher does not imply a matched subscriber on the other side, and a
        best-effort one loses earlier images: so empty images are sent until one has a match.

        :param publisher: of messages of a kind, in place of the publisher of the robot.
        """
        publisher = publisher or self.publisher
        self.until(lambda: publisher.get_subscription_count() > 0, 'the node')
        before, sent = len(self.answers), 0
        probe = kind()
        probe.header.frame_id = 'probe'
        while len(self.answers) == before:
            sent += 1
            assert sent < 2 * TIMEOUT
            probe.header.stamp.nanosec = sent
            publisher.publish(probe)
            self.executor.spin_once(timeout_sec=0.5)
        self.until(
            lambda: self.answers[-1].header.stamp.nanosec == sent, 'the match of the last probe'
        )

    def wait_for_nobody(self) -> None:
        """Wait until no node subscribes to the images."""
        self.until(lambda: self.publisher.get_subscription_count() == 0, 'the node to be gone')

    def ask(self, image: Any, publisher: Publisher | None = None) -> PlaceMatch:
        """Publish one image and return its match."""
        before = len(self.answers)
        (publisher or self.publisher).publish(image)
        self.until(lambda: len(self.answers) > before, 'a match')
        assert len(self.answers) == before + 1
        return self.answers[-1]

    def call(self, kind: type, name: str, **fields: object) -> Any:
        """Call a service of the node, such as ``reset``, and return its response."""
        futures: list[Any] = []

        def done() -> bool:
            return bool(futures[0].done())

        with self.request(futures, kind, name, done, **fields):
            return futures[0].result()

    @contextmanager
    def request(
        self,
        futures: list[Any],
        kind: type,
        name: str,
        effect: Callable[[], bool],
        **fields: object,
    ) -> Iterator[Client]:
        """
        Send a request to a service of the node and wait for an effect.

        The client lives in the block.

        :param futures: receives the future of the response.
        """
        client = self.node.create_client(kind, f'/stavpr/{name}')
        try:
            self._wait_for_discovery()
            self.until(client.service_is_ready, f'the service {name}')
            futures.append(client.call_async(kind.Request(**fields)))
            self.until(effect, f'an effect of {name}')
            yield client
        finally:
            self.node.destroy_client(client)

    def _wait_for_discovery(self) -> None:
        """
        Wait until the node has discovered the endpoints made so far.

        It has when it responds to a client that was made after them. A request of that client may
        be lost, so it is repeated: a previous node may have the service.
        """
        probe = self.node.create_client(GetState, '/stavpr/get_state')
        responses: list[Any] = []
        attempts = 0

        def has_responded() -> bool:
            nonlocal attempts
            if attempts % RESEND == 0 and probe.service_is_ready():
                responses.append(probe.call_async(GetState.Request()))
            attempts += bool(responses)
            return any(response.done() for response in responses)

        try:
            self.until(has_responded, 'a response of the node')
        finally:
            self.node.destroy_client(probe)

    def state(self) -> str:
        """Label of the node's life-cycle state."""
        return str(self.call(GetState, 'get_state').current_state.label)

    def until_state(self, label: str) -> None:
        """Wait until the node is in a state; the transition may still be under way."""
        self.until(lambda: self.state() == label, f'state {label}')

    def transition(self, label: str) -> bool:
        """Request a transition: configure, activate, deactivate, cleanup, shutdown."""
        return bool(
            self.call(ChangeState, 'change_state', transition=Transition(label=label)).success
        )

    def listen(self, kind: type, topic: str, qos: object = 50) -> list[Any]:
        """Return a list that fills with the messages of a topic; see ``until``."""
        received: list[Any] = []
        self.node.create_subscription(kind, topic, received.append, qos)
        return received

    def until_diagnosed(self, part: str, level: bytes, words: str = '') -> DiagnosticStatus:
        """Wait for a level and words of a part: input, map, recognition, processing."""

        def is_reported() -> bool:
            status = self.diagnostics.get(part)
            return status is not None and status.level == level and words in status.message

        self.diagnostics.pop(part, None)
        self.until(is_reported, f'diagnostics of {part} at level {level!r} with {words!r}')
        return self.diagnostics[part]
