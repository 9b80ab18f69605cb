# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Soak test: images at a steady rate to a node in a process of its own: losses, latency, memory.

Run it where the package is built and sourced: ``make shell``, then ``python benchmarks/soak.py``.
"""

import argparse
import array
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import count, cycle, islice
import json
import os
from pathlib import Path
import signal
import subprocess
import tempfile
import time
from typing import Any

import numpy as np
from results import commit, cpu_model, parser_of, versions

PLACES, WIDTH, HEIGHT = 2000, 640, 480
STEP = 41  # pixels from one view to the next
IMAGES = 30  # different ones
SETTLED = 3.0  # seconds for the last images


def texture_route(count: int) -> Iterator[np.ndarray]:
    """Yield views along one random texture, RGB uint8."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (HEIGHT // 16, 4096 // 16, 3), np.uint8)
    texture = np.kron(coarse, np.ones((16, 16, 1), np.uint8))
    starts = [(i * STEP) % (texture.shape[1] - WIDTH) for i in range(count)]
    return (np.ascontiguousarray(texture[:, s : s + WIDTH]) for s in starts)


def make_map(path: Path, features: str = 'gradient', places: int = PLACES) -> None:
    """Save a map of synthetic images."""
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.mapping import build_map, save_map
    from stavpr_ros.sources.frame import Frame

    frames = (Frame(image, 0, '') for image in texture_route(places))
    save_map(build_map(frames, FeatureExtractor(features), thumbnails=False), path)


def memory(pid: int) -> float:
    """Return the resident memory of a process, MB."""
    for line in Path(f'/proc/{pid}/status').read_text().splitlines():
        if line.startswith('VmRSS'):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f'no VmRSS of process {pid}')


class Latencies:
    """Status and latency of every match that the node publishes."""

    def __init__(self) -> None:
        self.sent: dict[int, float] = {}
        self.latencies: list[float] = []
        self.statuses: Counter[int] = Counter()

    def on_match(self, match: Any) -> None:
        """Record one match."""
        stamp = match.header.stamp.sec * 10**9 + match.header.stamp.nanosec
        if stamp not in self.sent:
            return
        self.statuses[match.status] += 1
        if match.status != match.DROPPED:
            self.latencies.append(time.monotonic() - self.sent[stamp])

    def figures(self, published: int, dropped_status: int) -> dict[str, Any]:
        """Return the counts and latencies of so many published images."""
        milliseconds = np.array(self.latencies) * 1e3
        return {
            'statuses': dict(self.statuses),
            'images_published': published,
            'processed': len(self.latencies),
            'dropped': self.statuses[dropped_status],
            'lost_in_transport': published - self.statuses.total(),
            'latency_ms_p50': float(np.percentile(milliseconds, 50)),
            'latency_ms_p99': float(np.percentile(milliseconds, 99)),
            'latency_ms_max': float(milliseconds.max()),
        }


def image_message(image: np.ndarray) -> Any:
    """Return an image as a message."""
    from sensor_msgs.msg import Image

    height, width = image.shape[:2]
    message = Image(height=height, width=width, encoding='rgb8', step=3 * width)
    message.data = array.array('B', image.tobytes())
    return message


def publish(
    names: list[str],
    topic: str,
    qos: Any,
    images: list[Any],
    arguments: argparse.Namespace,
    each_minute: Callable[[], None] = lambda: None,
    after: tuple[float, Callable[[], None]] | None = None,
    others: int = 0,
) -> tuple[list[dict[str, Any]], float]:
    """
    Publish images at ``arguments.rate`` for ``arguments.seconds``.

    :param names: names of the nodes that subscribe.
    :param others: number of subscribers that publish nothing.
    :param after: called once, so many seconds after the first image.
    :returns: figures of each node; images per second.
    """
    import rclpy
    from rclpy.qos import QoSProfile
    from stavpr_msgs.msg import PlaceMatch
    from stavpr_ros.ros.process import Discovery, ros_node, spin_until

    nodes = [Latencies() for _ in names]
    total = round(arguments.seconds * arguments.rate)
    with ros_node(lambda: rclpy.create_node('camera'), []) as node:
        for name, one in zip(names, nodes, strict=True):
            node.create_subscription(
                PlaceMatch, f'/{name}/match', one.on_match, QoSProfile(depth=1000)
            )
        publisher = node.create_publisher(type(images[0]), topic, qos)
        spin_until(node, lambda: publisher.get_subscription_count() == len(names) + others)
        discovery = Discovery(node, lambda: node.get_subscriptions_info_by_topic(f'/{topic}'))
        spin_until(node, discovery.done)
        began = time.monotonic()
        each_minute()
        node.create_timer(60.0, each_minute)
        if getattr(arguments, 'changes', False):
            node.create_timer(1.0, changes(node, names[0]))
        if after is not None:
            seconds, call = after

            def call_once() -> None:
                node.destroy_timer(waiting)
                call()

            waiting = node.create_timer(seconds, call_once)

        def publish_next() -> None:
            message, now = next(messages), time.time_ns()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
            for one in nodes:
                one.sent[now] = time.monotonic()
            publisher.publish(message)

        messages = islice(cycle(images), total)
        timer = node.create_timer(1 / arguments.rate, publish_next)
        spin_until(node, lambda: len(nodes[0].sent) == total)
        rate = total / (time.monotonic() - began)
        node.destroy_timer(timer)
        end = time.monotonic() + SETTLED
        spin_until(
            node,
            lambda: all(one.statuses.total() == total for one in nodes) or time.monotonic() > end,
        )
        return [one.figures(total, PlaceMatch.DROPPED) for one in nodes], rate


def changes(node: Any, name: str) -> Callable[[], None]:
    """Return what changes a parameter of a node, and every 20th time resets it."""
    from rcl_interfaces.msg import Parameter
    from rcl_interfaces.srv import SetParameters
    from std_srvs.srv import Trigger

    set_parameters = node.create_client(SetParameters, f'/{name}/set_parameters')
    reset = node.create_client(Trigger, f'/{name}/reset')
    numbers = count()

    def change() -> None:
        number = next(numbers)
        parameter = Parameter(name='max_error')
        parameter.value.type, parameter.value.double_value = 3, (0.05, 0.1)[number % 2]
        set_parameters.call_async(SetParameters.Request(parameters=[parameter]))
        if number % 20 == 0:
            reset.call_async(Trigger.Request())

    return change


def about(load: float) -> dict[str, Any]:
    """Return machine and versions of a run."""
    machine = {'load_before': load, 'cpu': cpu_model(), 'cores': os.cpu_count()}
    return machine | {'commit': commit(), **versions()}


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    parser.add_argument('--seconds', type=float, default=300)
    parser.add_argument('--rate', type=float, default=30, help='images per second (%(default)s)')
    parser.add_argument('--map', help=f'instead of one of {PLACES} synthetic places')
    text = 'change a parameter each second, and reset the node every 20 seconds'
    parser.add_argument('--changes', action='store_true', help=text)
    parser.add_argument('--output', help='write the figures to this JSON file as well')
    arguments = parser.parse_args()
    from rclpy.qos import qos_profile_sensor_data
    from stavpr_lab.demonstration.live import executable, private_domain
    from stavpr_ros.ros.process import prepare_transport

    environment, load = private_domain(), os.getloadavg()[0]
    os.environ.update(environment)
    prepare_transport()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(arguments.map or Path(folder) / 'map.stavpr').resolve()
        if not arguments.map:
            make_map(path)
        command = [executable('node'), '--ros-args', '-p', f'map_path:={path}']
        node = subprocess.Popen(command, env=environment)
        resident: list[float] = []
        images = [image_message(image) for image in texture_route(IMAGES)]
        try:
            (figures,), rate = publish(
                ['stavpr'], 'image', qos_profile_sensor_data, images, arguments,
                lambda: resident.append(round(memory(node.pid), 1)),
            )  # fmt: skip
            figures |= {'rate_hz': rate, 'memory_mb_start': resident[0]}
            figures['memory_mb_end'] = memory(node.pid)
        finally:
            node.send_signal(signal.SIGINT)
            node.wait()
    name = Path(arguments.map).name if arguments.map else f'{PLACES} places'
    figures |= {'memory_mb_by_minute': resident, 'map': name, **about(load)}
    text = json.dumps(figures, indent=2)
    print(text)
    if arguments.output:
        Path(arguments.output).write_text(text + '\n')


if __name__ == '__main__':
    main()
