# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Memory of a node after images: resident and proportional set, by what is mapped, and its threads.

The proportional set depends on what else runs, since pages of libraries count in parts: an empty
subscriber of rclpy runs beside the node. Run it where the package is built and sourced:
``make shell``, then ``python benchmarks/node_memory.py``.
"""

import argparse
from collections import Counter
import json
import os
from pathlib import Path
import re
import sys
import tempfile
from typing import Any

from cost import process, proportional_memory, SUBSCRIBER
from results import parser_of, table
from soak import about, image_message, make_map, memory, publish, texture_route

CASES = (2000, 400), (300, 1000)  # places, images
VIEWS, RATE = 200, 30.0  # different images, and images per second
LARGEST = 7  # of what is mapped, by proportional set
MAPPED = re.compile(r'[0-9a-f]+-[0-9a-f]+ \S+ \S+ \S+ (\d+) *(.*)')


def mapped(pid: int) -> Counter[str]:
    """Return the proportional set of a process by library, heap and other memory, kB."""
    sizes: Counter[str] = Counter()
    name = ''
    for line in Path(f'/proc/{pid}/smaps').read_text().splitlines():
        if match := MAPPED.match(line):
            file = Path(match[2]).name
            name = (file.split('.')[0] if int(match[1]) else match[2]) or 'arenas, arrays, kernels'
        elif line.startswith('Pss:'):
            sizes[name] += int(line.split()[1])
    return sizes


def measure(features: str, places: int, images: int, folder: Path) -> dict[str, Any]:
    """Return the memory of a node on a map of so many places after so many images."""
    from rclpy.qos import qos_profile_sensor_data
    from stavpr_lab.demonstration.live import executable
    from stavpr_ros.ros.process import PROFILES_VARIABLE

    path = folder / f'{features}-{places}.stavpr'
    make_map(path, features, places)
    options = ['--ros-args', '-p', f'map_path:={path}', '--log-level', 'error']
    arguments = argparse.Namespace(rate=RATE, seconds=images / RATE)
    messages = [image_message(image) for image in texture_route(VIEWS)]
    with (
        process([executable('node'), *options], PROFILES_VARIABLE) as node,
        process([sys.executable, '-c', SUBSCRIBER, 'subscriber'], PROFILES_VARIABLE),
    ):
        (figures,), _ = publish(
            ['stavpr'], 'image', qos_profile_sensor_data, messages, arguments, others=1
        )
        return {
            'features': features, 'places': places, 'images': figures['processed'],
            'rss_mb': memory(node), 'pss_mb': proportional_memory(node),
            'threads': len(os.listdir(f'/proc/{node}/task')),
            'mapped_mb': {of: kB / 1024 for of, kB in mapped(node).most_common(LARGEST)},
        }  # fmt: skip


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    kinds = 'gradient', 'hybrid'
    parser.add_argument('--features', nargs='+', choices=kinds, default=kinds)
    parser.add_argument('--output', help='write the figures to this JSON file as well')
    arguments = parser.parse_args()
    from stavpr_lab.demonstration.live import private_domain
    from stavpr_ros.ros.process import prepare_transport

    os.environ.update(private_domain())
    prepare_transport()
    load, rows = os.getloadavg()[0], []
    with tempfile.TemporaryDirectory() as name:
        for features in arguments.features:
            rows += [measure(features, *case, Path(name)) for case in CASES]
    cells = []
    for row in rows:
        *numbers, sizes = row.values()
        text = ', '.join(f'{name} {size:.0f}' for name, size in sizes.items())
        cells.append([*(f'{n:.0f}' if isinstance(n, float) else str(n) for n in numbers), text])
    print('\n'.join(table(list(rows[0]), cells)))
    if arguments.output:
        report = {'rows': rows, **about(load)}
        Path(arguments.output).write_text(json.dumps(report, indent=2) + '\n')


if __name__ == '__main__':
    main()
