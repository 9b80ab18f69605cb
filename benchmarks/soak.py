"""
Soak: images at a steady rate into a node of its own process, for minutes: losses, latency, memory.

Run it where the package is built and sourced: ``make shell``, then ``python benchmarks/soak.py --help``.
"""

import argparse
import array
import json
import os
import platform
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np


def texture_route(count: int, height: int, width: int, step: int = 40) -> list[np.ndarray]:
    """Views along one random texture, RGB uint8: images of the right size, no two alike."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (height // 16, 4096 // 16, 3), np.uint8)
    texture = np.kron(coarse, np.ones((16, 16, 1), np.uint8))
    starts = [(i * step) % (texture.shape[1] - width) for i in range(count)]
    return [np.ascontiguousarray(texture[:, s : s + width]) for s in starts]


def make_map(path: Path, places: int, height: int, width: int) -> None:
    """Save a map with so many places of made-up images."""
    from stavpr_ros.features import Describer
    from stavpr_ros.mapping import build_map, save_map
    from stavpr_ros.sources.frame import Frame

    frames = (Frame(image, 0, '') for image in texture_route(places, height, width))
    save_map(build_map(frames, Describer(), thumbnails=False), path)


def memory(pid: int) -> float:
    """Resident memory of a process, MB."""
    for line in Path(f'/proc/{pid}/status').read_text().splitlines():
        if line.startswith('VmRSS'):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f'no VmRSS of process {pid}')


def soak(arguments: argparse.Namespace, node: subprocess.Popen) -> dict:
    """Publish, listen, and return the figures."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, qos_profile_sensor_data
    from sensor_msgs.msg import Image

    from stavpr_msgs.msg import PlaceMatch

    rclpy.init()
    bench = rclpy.create_node('soak')
    publisher = bench.create_publisher(Image, 'image', qos_profile_sensor_data)
    sent: dict[int, float] = {}
    latencies: list[float] = []
    verdicts: dict[int, int] = {}

    def on_match(match: PlaceMatch) -> None:
        stamp = match.header.stamp.sec * 10**9 + match.header.stamp.nanosec
        verdicts[match.verdict] = verdicts.get(match.verdict, 0) + 1
        if match.verdict != PlaceMatch.DROPPED and stamp in sent:
            latencies.append(time.monotonic() - sent[stamp])

    bench.create_subscription(PlaceMatch, '/stavpr/match', on_match, QoSProfile(depth=1000))
    executor = SingleThreadedExecutor()
    executor.add_node(bench)
    messages = []
    for image in texture_route(30, arguments.height, arguments.width):
        message = Image(height=image.shape[0], width=image.shape[1], encoding='rgb8', step=image.shape[1] * 3)
        message.data = array.array('B', image.tobytes())
        messages.append(message)
    while not verdicts:  # until the node hears and is heard
        publisher.publish(messages[0])
        executor.spin_once(timeout_sec=0.5)
    verdicts.clear()
    executor.spin_once(timeout_sec=1.0)
    verdicts.clear()
    memory_start = memory(node.pid)
    began = time.monotonic()
    total = round(arguments.seconds * arguments.rate)
    for index in range(total):
        due = began + index / arguments.rate
        while (left := due - time.monotonic()) > 0:
            executor.spin_once(timeout_sec=left)
        message = messages[index % len(messages)]
        stamp = 10**9 + index * 1000
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        sent[stamp] = time.monotonic()
        publisher.publish(message)
    took = time.monotonic() - began
    end = time.monotonic() + 2
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    milliseconds = np.array(latencies) * 1e3
    bench.destroy_node()
    rclpy.shutdown()
    return {
        'images_published': total,
        'rate_hz': total / took,
        'answers': sum(verdicts.values()),
        'processed': len(latencies),
        'dropped': verdicts.get(PlaceMatch.DROPPED, 0),
        'lost_in_transport': total - sum(verdicts.values()),
        'latency_ms_p50': float(np.percentile(milliseconds, 50)),
        'latency_ms_p99': float(np.percentile(milliseconds, 99)),
        'latency_ms_max': float(milliseconds.max()),
        'memory_mb_start': memory_start,
        'memory_mb_end': memory(node.pid),
    }


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--seconds', type=float, default=300)
    parser.add_argument('--rate', type=float, default=30, help='images per second (%(default)s)')
    parser.add_argument('--places', type=int, default=2000)
    parser.add_argument('--width', type=int, default=640)
    parser.add_argument('--height', type=int, default=480)
    parser.add_argument('--output', help='write the figures to this JSON file as well')
    arguments = parser.parse_args()
    from stavpr_ros import __version__
    from stavpr_ros.ros.live import executable, private_domain
    from stavpr_ros.ros.transport import prepare_transport

    environment = private_domain()
    os.environ.update(environment)
    prepare_transport()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'map.stavpr'
        make_map(path, arguments.places, arguments.height, arguments.width)
        command = [executable('node'), '--ros-args', '-p', f'map_path:={path}', '-p', 'threshold:=0.2']
        node = subprocess.Popen(command, env=environment)
        try:
            figures = soak(arguments, node)
        finally:
            node.send_signal(signal.SIGINT)
            node.wait()
    figures |= {'places': arguments.places, 'machine': platform.processor() or platform.machine()}
    figures |= {'cores': os.cpu_count(), 'python': platform.python_version(), 'stavpr_ros': __version__}
    text = json.dumps(figures, indent=2)
    print(text)
    if arguments.output:
        Path(arguments.output).write_text(text + '\n')


if __name__ == '__main__':
    main()
