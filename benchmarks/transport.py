# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Losses and latency of camera images through nodes in processes of their own.

Images of two sizes, raw and compressed, are published reliably and with best effort to one node
and to two. Run it where the package is built and sourced: ``make shell``, then
``python benchmarks/transport.py``.
"""

import array
from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from itertools import product
import json
import os
from pathlib import Path
import signal
import subprocess
import tempfile
from typing import Any

import cv2
from results import parser_of
from soak import about, image_message, make_map, publish, texture_route

SIZES = {'640x480': (640, 480), '1920x1080': (1920, 1080)}
KINDS = ('raw', 'compressed')
RELIABILITIES = ('reliable', 'best effort')
IMAGES = 20  # different ones


def messages(kind: str, size: tuple[int, int]) -> list[Any]:
    """Return images of one size as messages."""
    from sensor_msgs.msg import CompressedImage

    images = [cv2.resize(view, size) for view in texture_route(IMAGES)]
    if kind == 'raw':
        return [image_message(image) for image in images]
    encoded = [cv2.imencode('.jpg', image)[1].tobytes() for image in images]
    return [CompressedImage(format='jpeg', data=array.array('B', data)) for data in encoded]


@contextmanager
def running(names: list[str], kind: str, map_path: Path) -> Iterator[None]:
    """Run nodes of these names while the block runs."""
    from stavpr_lab.demonstration.live import executable

    transport = 'raw' if kind == 'raw' else 'compressed'
    with ExitStack() as stack:
        for name in names:
            options = ['-r', f'__node:={name}', '-p', f'map_path:={map_path}']
            options += ['-p', f'image_transport:={transport}', '--log-level', 'error']
            process = subprocess.Popen([executable('node'), '--ros-args', *options])
            stack.callback(process.wait)
            stack.callback(process.send_signal, signal.SIGINT)
        yield


def row(result: dict[str, Any]) -> str:
    """Return a line of the table: the worse node of each figure."""
    figures = result['nodes']
    losses = max(one['lost_in_transport'] for one in figures)
    dropped = max(one['dropped'] for one in figures)
    p50, p99 = (max(one[f'latency_ms_{p}'] for one in figures) for p in ('p50', 'p99'))
    cells = [result['size'], result['kind'], result['reliability'], str(len(figures))]
    published = figures[0]['images_published']
    cells += [f'{losses} of {published}', str(dropped), f'{p50:.0f}', f'{p99:.0f}']
    return f'| {" | ".join(cells)} |'


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    parser.add_argument('--seconds', type=float, default=8, help='of each case (%(default)s)')
    parser.add_argument('--rate', type=float, default=30, help='images per second (%(default)s)')
    large = 'publish through the Fast DDS profile for large images, as replay does'
    parser.add_argument('--large-segment', action='store_true', help=large)
    parser.add_argument('--output', help='write the figures to this JSON file as well')
    arguments = parser.parse_args()
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from stavpr_lab.demonstration.live import private_domain
    from stavpr_ros.ros.process import prepare_transport

    os.environ.update(private_domain())
    if arguments.large_segment:
        prepare_transport()
    results = []
    print('| size | transport | publisher | nodes | lost | dropped | p50, ms | p99, ms |')
    print('|---|---|---|---|---|---|---|---|')
    with tempfile.TemporaryDirectory() as folder:
        map_path = Path(folder) / 'map.stavpr'
        make_map(map_path)
        for kind, count in product(KINDS, (1, 2)):
            names = [f'stavpr_{number}' for number in range(count)]
            with running(names, kind, map_path):
                for (size, pixels), reliability in product(SIZES.items(), RELIABILITIES):
                    policy = getattr(ReliabilityPolicy, reliability.replace(' ', '_').upper())
                    qos = QoSProfile(depth=5, reliability=policy)
                    topic = 'image' if kind == 'raw' else 'image/compressed'
                    nodes, _ = publish(names, topic, qos, messages(kind, pixels), arguments)
                    results.append(
                        {'size': size, 'kind': kind, 'reliability': reliability, 'nodes': nodes}
                    )
                    print(row(results[-1]), flush=True)
    report = {'results': results, 'rate_hz': arguments.rate, 'seconds': arguments.seconds}
    report |= {'large_segment': arguments.large_segment, **about(os.getloadavg()[0])}
    if arguments.output:
        Path(arguments.output).write_text(json.dumps(report, indent=2) + '\n')


if __name__ == '__main__':
    main()
