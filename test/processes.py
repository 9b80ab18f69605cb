"""The installed executables as processes of their own, and a ROS context beside them."""

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import rclpy
from ament_index_python.packages import get_package_prefix
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image

from stavpr_msgs.msg import PlaceMatch

DOMAIN = 1 + os.getpid() % 100
PATIENCE = 60.0  # seconds until something that should happen counts as not happening


def executable(name: str) -> str:
    return str(Path(get_package_prefix('stavpr_ros')) / 'lib' / 'stavpr_ros' / name)


class Process:
    """One executable, started as `ros2 run` would, its output in a file."""

    def __init__(self, log: Path, name: str, *arguments: str) -> None:
        self.log = log
        environment = os.environ | {
            'ROS_DOMAIN_ID': str(DOMAIN),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        }
        with log.open('w') as output:
            self.popen = subprocess.Popen(
                [executable(name), *arguments], env=environment, stdout=output, stderr=subprocess.STDOUT
            )

    def output(self) -> str:
        return self.log.read_text()

    def wait(self, timeout: float = PATIENCE) -> int:
        return self.popen.wait(timeout)

    def stop(self, number: int = signal.SIGINT) -> int:
        self.popen.send_signal(number)
        return self.wait()

    def end(self) -> None:
        """Make sure that it is gone, gently if that does."""
        if self.popen.poll() is None:
            self.popen.send_signal(signal.SIGINT)
        try:
            self.wait()
        except subprocess.TimeoutExpired:
            self.popen.kill()
            self.popen.wait()


class Bench:
    """A node in the test's own process: publishes images, hears answers, sets parameters."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node('bench', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.publisher = self.node.create_publisher(Image, 'image', qos_profile_sensor_data)
        self.answers: list[PlaceMatch] = []
        self.probes = 0  # answered empty images that only tested the connection
        self.node.create_subscription(
            PlaceMatch, '/stavpr/match', self.answers.append, QoSProfile(depth=1000)
        )
        self.parameters = self.node.create_client(SetParameters, '/stavpr/set_parameters')

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f'waited {PATIENCE:g} s in vain for {what}'
            self.executor.spin_once(timeout_sec=0.05)

    def wait_for_node(self) -> None:
        """
        Wait until the node hears images and its answers are heard.

        A matched publisher does not mean that the other side has matched too, and a best-effort
        subscriber drops what comes before: so empty images are sent until they are answered.
        """
        self.until(lambda: self.publisher.get_subscription_count() > 0, 'the node')
        before, sent = len(self.answers), 0
        probe = Image()
        probe.header.frame_id = 'probe'
        while len(self.answers) == before:
            sent += 1
            assert sent < 2 * PATIENCE
            probe.header.stamp.nanosec = sent
            self.publisher.publish(probe)
            self.executor.spin_once(timeout_sec=0.5)
        # the node hears us now, so the last probe is answered too
        self.until(lambda: self.answers[-1].header.stamp.nanosec == sent, 'the answer to the last probe')
        self.probes = len(self.answers) - before

    def wait_for_nobody(self) -> None:
        """Wait until no node subscribes to the images any more."""
        self.until(lambda: self.publisher.get_subscription_count() == 0, 'the node to be gone')

    def ask(self, image: Image) -> PlaceMatch:
        """Publish one image and return its answer."""
        before = len(self.answers)
        self.publisher.publish(image)
        self.until(lambda: len(self.answers) > before, 'an answer')
        assert len(self.answers) == before + 1
        return self.answers[-1]

    def ask_until_answered(self, image: Image) -> PlaceMatch:
        """Publish one image and return its answer, whatever other answers are on their way."""
        self.publisher.publish(image)
        found: list[PlaceMatch] = []

        def answered() -> bool:
            found[:] = [a for a in self.answers if a.header == image.header]
            return bool(found)

        self.until(answered, 'the answer to this image')
        return found[0]

    def set_parameter(self, name: str, value: object) -> tuple[bool, str]:
        self.until(self.parameters.service_is_ready, 'the parameter service')
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        future = self.parameters.call_async(request)
        self.until(future.done, 'the parameter to be set')
        result = future.result().results[0]
        return result.successful, result.reason

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
