# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The installed executables as processes of their own, and a ROS context beside them."""

import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import time
from typing import Any

from ament_index_python.packages import get_package_prefix
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
import rclpy
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import Image
from stavpr_msgs.msg import PlaceMatch
from std_msgs.msg import Header

DOMAIN = 1 + os.getpid() % 100
TIMEOUT = 60.0  # seconds until an expected event counts as missing
SECOND = 10**9
RESEND = 20  # attempts to receive a response until a probe is sent again
RELIABLE = QoSProfile(depth=1000)
TAKEN_RELIABLY = {
    'qos_overrides./image.subscription.reliability': 'reliable',
    'qos_overrides./image.subscription.depth': 1000,
}


def executable(name: str) -> str:
    return str(Path(get_package_prefix('stavpr_ros')) / 'lib' / 'stavpr_ros' / name)


def environment() -> dict[str, str]:
    """Return the environment of a process that shares the domain of the tests."""
    return os.environ | {
        'ROS_DOMAIN_ID': str(DOMAIN),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }


class Process:
    """One executable, started as `ros2 run` would, its output in a file."""

    def __init__(self, log: Path, name: str, *arguments: str) -> None:
        self.log = log
        with log.open('w') as output:
            self.popen = subprocess.Popen(
                [executable(name), *arguments],
                env=environment(),
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def output(self) -> str:
        return self.log.read_text()

    def wait(self, timeout: float = TIMEOUT) -> int:
        return self.popen.wait(timeout)

    def stop(self, number: int = signal.SIGINT) -> int:
        self.popen.send_signal(number)
        return self.wait()

    def end(self) -> None:
        """End the process, by force if an interrupt does not suffice."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGINT)
        try:
            self.wait()
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()
        print(self.output())  # which pytest shows when the test has failed


def node_process(log: Path, *options: str, **parameters: object) -> Process:
    """Start the node with options of ROS and parameters."""
    values = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    return Process(log, 'node', '--ros-args', *options, *values)


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


class Bench:
    """
    A node in the test's own process: publishes images, receives matches, calls services.

    :param images: QoS of the images; RELIABLE loses none if the node subscribes so too.
    """

    def __init__(self, images: QoSProfile = qos_profile_sensor_data) -> None:
        self.images = images
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('bench', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publisher = self.node.create_publisher(Image, 'image', images)
        self.answers: list[PlaceMatch] = []
        self.node.create_subscription(
            PlaceMatch, '/stavpr/match', self.answers.append, QoSProfile(depth=1000)
        )
        self.diagnostics: dict[str, DiagnosticStatus] = {}  # the latest, by part: input, map ...
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

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

        :param publisher: another one than that of the bench, of messages of a kind.
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

    def publish_anew(self) -> None:
        """Replace the publisher of images."""
        self.node.destroy_publisher(self.publisher)
        self.publisher = self.node.create_publisher(Image, 'image', self.images)

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
        be lost, so it is repeated: the service may be that of a previous node.
        """
        probe = self.node.create_client(GetState, '/stavpr/get_state')
        responses: list[Any] = []
        attempts = 0

        def responded() -> bool:
            nonlocal attempts
            if attempts % RESEND == 0 and probe.service_is_ready():
                responses.append(probe.call_async(GetState.Request()))
            attempts += bool(responses)
            return any(response.done() for response in responses)

        try:
            self.until(responded, 'a response of the node')
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

        def reported() -> bool:
            status = self.diagnostics.get(part)
            return status is not None and status.level == level and words in status.message

        self.diagnostics.pop(part, None)
        self.until(reported, f'diagnostics of {part} at level {level!r} with {words!r}')
        return self.diagnostics[part]

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name.partition(': ')[2]] = status

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
