# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start of the node by its causes: imports, kernels to compile, and what is left.

Cold: the folder of kernels is empty. Built: ``stavpr warm`` has filled it, as in ``colcon build``.
Warm: a second start. Run it where the package is built and sourced: ``make shell``, then
``python benchmarks/start.py``.
"""

from collections import Counter
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
import time
from typing import Any

from cost import process, seconds_of
from results import parser_of, table
from soak import about, image_message, make_map, memory, texture_route

RATE, IMAGES = 10.0, 30  # images per second, and how many after the node has subscribed
PACKAGES = 5  # packages of the table of imports
LINE = re.compile(r'import time:\s*(\d+) \|\s*\d+ \|\s*(\w+)')
MESSAGES = re.compile(r'rclpy|rosidl|rpyutils|ament|launch|\w+_(msgs|srvs|interfaces)')


def imports() -> dict[str, float]:
    """Return the milliseconds that the modules of each package take when the node imports them."""
    command = [sys.executable, '-X', 'importtime', '-c', 'import stavpr_ros.ros.node']
    subprocess.run(command, check=True, capture_output=True)  # writes the bytecode
    log = subprocess.run(command, check=True, capture_output=True, text=True).stderr
    times: Counter[str] = Counter()
    for microseconds, package in LINE.findall(log):
        times['rclpy, messages' if MESSAGES.fullmatch(package) else package] += int(microseconds)
    largest = dict(times.most_common(PACKAGES)) | {'stavpr_ros': times['stavpr_ros']}
    largest |= {'all': times.total()}
    return {name: value / 1e3 for name, value in largest.items()}


def start(path: str, kernels: str) -> dict[str, Any]:
    """
    Start the node, and show it images.

    :param kernels: folder of compiled kernels.
    :returns: wall and processor time, with that of its processes, until it has subscribed, s; the
        kernels that were compiled until then, and later; processor time of an image, ms; resident
        memory at the end, MB.
    """
    import rclpy
    from sensor_msgs.msg import Image
    from stavpr_lab.demonstration.live import executable
    from stavpr_ros.ros.process import PROFILES_VARIABLE, ros_node

    def count_kernels() -> int:
        return len(list(Path(kernels).rglob('*.nbc')))

    os.environ['NUMBA_CACHE_DIR'] = kernels
    options = ['--ros-args', '-p', f'map_path:={path}', '--log-level', 'error']
    messages = [image_message(image) for image in texture_route(IMAGES)]
    counts = [count_kernels()]
    with ros_node(lambda: rclpy.create_node('camera'), []) as camera:
        publisher = camera.create_publisher(Image, 'image', IMAGES)
        began = time.monotonic()
        with process([executable('node'), *options], PROFILES_VARIABLE) as node:
            while not publisher.get_subscription_count():
                time.sleep(0.01)
            wall, used = time.monotonic() - began, seconds_of(node)
            counts.append(count_kernels())
            for message in messages:
                now = time.time_ns()
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
                publisher.publish(message)
                time.sleep(1 / RATE)
            later = 1e3 * (seconds_of(node) - used) / IMAGES
            resident = memory(node)
    counts.append(count_kernels())
    return {
        'wall_s': wall, 'processor_s': used, 'kernels': counts[1] - counts[0],
        'kernels_later': counts[2] - counts[1], 'image_ms': later, 'resident_mb': resident,
    }  # fmt: skip


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    parser.add_argument('--output', help='write the figures to this JSON file as well')
    arguments = parser.parse_args()
    from stavpr_lab.demonstration.live import executable, private_domain
    from stavpr_ros.ros.process import prepare_transport

    os.environ.update(private_domain())
    prepare_transport()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
        os.environ['PYTHONPYCACHEPREFIX'] = name  # as where a package manager has compiled it
        by_package = imports()
        path, cold, built = (str(Path(name) / file) for file in ('map.stavpr', 'cold', 'built'))
        make_map(Path(path))
        starts = {'cold': start(path, cold), 'warm': start(path, cold)}
        environment = {**os.environ, 'NUMBA_CACHE_DIR': built}
        subprocess.run([executable('warm')], check=True, env=environment)
        starts |= {'built': start(path, built)}
    report = {'imports_ms': by_package, 'starts': starts, **about(load)}
    head = list(by_package)
    rows = [[f'{value:.0f}' for value in by_package.values()]]
    print('\n'.join(table([f'{name}, ms' for name in head], rows)))
    head = ['start', *next(iter(starts.values()))]
    rows = [[name, *(f'{value:.3g}' for value in one.values())] for name, one in starts.items()]
    print('\n'.join(table(head, rows)))
    print({name: report[name] for name in ('cpu', 'cores', 'commit', 'load_before')})
    if arguments.output:
        Path(arguments.output).write_text(json.dumps(report, indent=2) + '\n')


if __name__ == '__main__':
    main()
