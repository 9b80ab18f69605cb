# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Processor time of an image: stages of the library, and a node beside empty subscribers.

The node and two subscribers of rclpy receive the same images at the same time: one does nothing,
one converts them to gray and publishes a match of the same size. Run it where the package is built
and sourced: ``make shell``, then ``python benchmarks/cost.py``. With ``--sessions``, only the
recognition of an image on maps of so many sessions of Nordland, summer and winter in turn with
noise, with one thread.
"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, ExitStack, nullcontext
import json
import os
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from results import parser_of, table
from soak import about, HEIGHT, image_message, make_map, memory, publish, texture_route, WIDTH

WARM, IMAGES, VIEWS = 60, 400, 200  # images of a stage's median, after the first; different ones
TURN, SETTLED_TURNS = 50, 4  # images of each map in turn, and turns before times count
DRIVE, NEAR, DIMENSIONS = 700, 3, 128  # images on sessions, places from the right one, dimensions
PACE = 30  # images per second of stages that find their caches cold
SETTLED = 5.0  # seconds after the first image, before times count
SUBSCRIBER = """
import sys
import cv2, numpy as np, rclpy
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import Image
from stavpr_msgs.msg import AlignedPair, PlaceMatch

def publish(message):
    image = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
    cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    match = PlaceMatch(header=message.header, status=PlaceMatch.MATCH)
    match.path = [AlignedPair(query_index=i, place_index=i) for i in range(20)]
    match.path_probabilities = [1.0] * 20
    publisher.publish(match)

rclpy.init()
cv2.setNumThreads(1)
node = rclpy.create_node(sys.argv[1])
publisher = node.create_publisher(PlaceMatch, '~/match', QoSProfile(depth=50))
work = publish if sys.argv[1] == 'publisher' else lambda message: None
node.create_subscription(Image, 'image', work, qos_profile_sensor_data)
try:
    rclpy.spin(node)
except rclpy.executors.ExternalShutdownException:
    pass
"""
PROCESSES = 'node', 'publisher', 'subscriber'
# owner and name of the function of each stage
STAGES = {
    'decoding': ('operations', 'decode_message'),
    'keyframes': ('operation._keyframes', 'accept'),
    'extraction': ('operation.extractor', 'extract'),
    'centering': ('recognizer._centering', 'next_query'),
    'image distances': ('recognizer._matcher', 'distances'),
    'window and filter': ('recognizer._window', 'push'),
    'match': ('recognizer', '_match'),
}


def seconds_of(pid: int) -> float:
    """Return the processor time of a process and of its ended ones, with the system's."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf('SC_CLK_TCK')


def proportional_memory(pid: int) -> float:
    """Return the proportional set of a process, MB: pages that processes share count in parts."""
    lines = Path(f'/proc/{pid}/smaps_rollup').read_text().splitlines()
    return int(next(line for line in lines if line.startswith('Pss:')).split()[1]) / 1024


# ------------------------------------------------ stages


def measure_stages(path: str, precision: str, threads: int, rate: int) -> dict[str, float]:
    """
    Return the median processor time of each stage of an image, and of all, microseconds.

    :param rate: images per second, 0 = one after the other.
    """
    import numpy as np
    from peaks import reader
    from stavpr_ros.pipeline import operations, Pipeline, PipelineSettings, read_map
    from stavpr_ros.threads import limit_threads

    limit_threads(threads)
    settings = PipelineSettings(backend='cpu', precision=precision)
    pipeline = Pipeline(settings)
    pipeline.change(loaded=read_map(path, settings))
    operation = pipeline.operation
    recognizer = operation.recognizer
    owners = {'operations': operations, 'operation': operation, 'recognizer': recognizer}
    times: dict[str, list[float]] = {}

    def time_calls(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            began = time.process_time()
            result = function(*arguments, **options)
            times.setdefault(name, []).append(time.process_time() - began)
            return result

        return call

    messages = [image_message(image) for image in texture_route(VIEWS)]
    process = time_calls('all', operation.process)
    for number in range(WARM + 2 * IMAGES):
        if number == WARM + IMAGES:  # the whole is measured without the timers of the stages
            for stage, (owner, name) in STAGES.items():
                first, *rest = owner.split('.')
                target = owners[first]
                for part in rest:
                    target = getattr(target, part)
                setattr(target, name, time_calls(stage, getattr(target, name)))
        if number in (WARM, WARM + IMAGES):
            total = times.get('all', [])[-IMAGES:]
        time.sleep(1 / rate if rate else 0)
        process(messages[number % VIEWS], (number + 1) * 10**8, list_candidates=False)
    assert operation.places is not None
    size = len(operation.places) * 7 * 224 * (1 if precision == 'int8' else 4) // 4
    content, read = np.ones(size, np.float32), reader(threads)
    call = time_calls('reading the map', lambda: read(content))
    for _ in range(50):
        call()
    medians = {name: statistics.median(values[-IMAGES:]) for name, values in times.items()}
    medians['all'] = statistics.median(total)
    medians['rest'] = medians['all'] - sum(medians[name] for name in STAGES)
    return {name: round(1e6 * value) for name, value in medians.items()}


def stages(path: str, *case: Any) -> dict[str, float]:
    """Measure the stages in a process of its own: precision, threads, rate."""
    environment = {
        **os.environ,
        'NUMBA_NUM_THREADS': str(case[1]),
        'OMP_NUM_THREADS': str(case[1]),
    }
    command = [sys.executable, __file__, '--map', path, '--stages', *map(str, case)]
    output = subprocess.check_output(command, env=environment, text=True)
    result: dict[str, float] = json.loads(output.splitlines()[-1])
    return result


def measure_sessions(counts: list[int]) -> list[str]:
    """Return a table of the time of an image, and of the features, of Nordland so many times."""
    from dataclasses import replace

    from data import data_folder
    from lower_bounds import ITEM_BYTES
    import numpy as np
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.mapping import build_map, merge_maps
    from stavpr_ros.mapping.reduction import with_principal_components
    from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
    from stavpr_ros.prepare.centering import normalize
    from stavpr_ros.sources import open_source
    from stavpr_ros.threads import limit_threads

    limit_threads(1)
    seasons = [
        build_map(
            open_source(data_folder() / 'nordland_64x32' / season), FeatureExtractor('gradient')
        )
        for season in ('summer', 'winter')
    ]
    places = len(seasons[0])

    def drive(seed: int) -> Any:
        route = seasons[seed % 2]
        strips = route.features.strips
        noise = np.random.default_rng(seed).standard_normal(strips.shape, np.float32)
        strips = strips + 0.5 * noise / np.linalg.norm(noise, axis=2, keepdims=True)
        strips /= np.linalg.norm(strips, axis=2, keepdims=True)
        return replace(route, features=replace(route.features, strips=strips))

    raw, rows = drive(1000).features, []
    one_session: tuple[float, int] | None = None
    for precision, dimension in (('float32', 0), ('int8', 0), ('int8', DIMENSIONS)):
        recognizers, queries, sizes, medians = [], [], [], []
        for count in counts:
            one = merge_maps([drive(seed) for seed in range(count)], list(map(str, range(count))))
            same_as = np.tile(np.arange(places, dtype=np.int32), count)
            one = replace(one, same_as=same_as) if count > 1 else one
            query = raw
            if dimension:
                one = with_principal_components(one, dimension)
                assert one.projection is not None
                query = replace(raw, strips=raw.strips @ one.projection.matrix, cells=None)
                normalize(query.strips)
                query = replace(query, settings=one.features.settings)
            recognizers.append(PlaceRecognizer(one, RecognizerSettings(), precision=precision))
            queries.append(query)
            sizes.append(len(one) * one.settings.strips * one.dimension * ITEM_BYTES[precision])
        right = [0] * len(counts)
        for first in range(0, DRIVE, TURN):
            times: list[list[float]] = [[] for _ in counts]
            for number, recognizer in enumerate(recognizers):
                for i in range(first, first + TURN):
                    image = queries[number][i : i + 1]
                    began = time.thread_time()
                    match = recognizer.update(image)
                    times[number].append(time.thread_time() - began)
                    if match.accepted:
                        true_place = i - len(match.window_stamps) + 1 + match.position
                        right[number] += abs(match.place % places - true_place) <= NEAR
            medians.append([1e3 * statistics.median(own) for own in times])
        costs = [statistics.median(turns) for turns in zip(*medians[SETTLED_TURNS:], strict=True)]
        one_session = one_session or (costs[0], sizes[0])
        rows.append(
            [
                f'{precision}, {dimension} dimensions' if dimension else precision,
                *(
                    f'{ms:.2f} ms ({ms / one_session[0]:.2f}), {size / 1e6:.1f} MB '
                    f'({size / one_session[1]:.2f}), {count / DRIVE:.3f}'
                    for ms, size, count in zip(costs, sizes, right, strict=True)
                ),
            ]
        )
    return table(['(times the first), share right', *map(str, counts)], rows)


# ------------------------------------------------ node and subscriber


@contextmanager
def process(command: list[str], *without: str) -> Iterator[int]:
    """Run a process while the block runs, without these variables; yield its number."""
    environment = {name: value for name, value in os.environ.items() if name not in without}
    one = subprocess.Popen(command, env=environment)
    try:
        yield one.pid
    finally:
        one.terminate()
        try:
            one.wait(10)
        except subprocess.TimeoutExpired:  # rclpy's signal handlers lose one at times
            one.kill()


def node_cost(path: str, rate: float, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the percent of a core that the node and the subscribers take."""
    from rclpy.qos import qos_profile_sensor_data
    from stavpr_lab.demonstration.live import executable
    from stavpr_ros.ros.process import PROFILES_VARIABLE

    options = ['--ros-args', '-p', f'map_path:={path}', '--log-level', 'error']
    arguments.rate, marks = rate, []
    images = [image_message(image) for image in texture_route(VIEWS)]
    peers = [[sys.executable, '-c', SUBSCRIBER, name] for name in PROCESSES[1:]]
    with ExitStack() as stack:
        # the large segment of prepare_transport is for the publisher
        node, *others = (
            stack.enter_context(process(command, PROFILES_VARIABLE))
            for command in ([executable('node'), *options], *peers)
        )

        def mark() -> None:
            marks.append([time.monotonic(), *map(seconds_of, [node, *others])])

        (figures, floor), _ = publish(
            ['stavpr', PROCESSES[1]], 'image', qos_profile_sensor_data, images, arguments,
            after=(SETTLED, mark), others=1,
        )  # fmt: skip
        mark()
        figures['pss_mb'], figures['rss_mb'] = proportional_memory(node), memory(node)
    wall, *used = (last - first for first, last in zip(*marks, strict=True))
    figures |= {name: 100 * own / wall for name, own in zip(PROCESSES, used, strict=True)}
    return figures | {'rate': rate, 'publisher_latency_ms_p50': floor['latency_ms_p50']}


def lines_of(report: dict[str, Any]) -> list[str]:
    """Return the tables of a report."""
    names = [*STAGES, 'rest', 'all', 'reading the map']
    rates = {0: '', PACE: f', {PACE} images/s'}
    head = ['stage, us', *(f'{p}, {t} threads{rates[r]}' for p, t, r in report['cases'])]
    rows = [[n, *(f'{one.get(n, 0):.0f}' for one in report['stages'])] for n in names]
    lines = table(head, rows) if report['cases'] else []
    head = ['images/s', *(f'{name}, %' for name in reversed(PROCESSES))]
    head += ['node / subscriber', 'node / publisher', 'p50 / p99, ms', 'PSS, MB']
    rows = [
        [
            f'{one["rate"]:g}', *(f'{one[name]:.1f}' for name in reversed(PROCESSES)),
            *(f'{one["node"] / one[name]:.2f}' for name in reversed(PROCESSES[1:])),
            f'{one["latency_ms_p50"]:.1f} / {one["latency_ms_p99"]:.1f}', f'{one["pss_mb"]:.0f}',
        ]
        for one in report['nodes']
    ]  # fmt: skip
    return [*lines, *(table(head, rows) if rows else [])]


def main() -> None:
    """Run the command."""
    parser = parser_of(__doc__)
    parser.add_argument('--rates', type=float, nargs='*', default=[10, 30], help='images/s')
    parser.add_argument('--seconds', type=float, default=25, help='of each rate (%(default)s)')
    parser.add_argument('--map', help='instead of one of 2000 synthetic places')
    parser.add_argument('--threads', type=int, nargs='*', default=[1, 2], help='of the stages')
    parser.add_argument('--sessions', type=int, nargs='*', help='on maps of so many sessions only')
    parser.add_argument('--stages', nargs=3, help=argparse.SUPPRESS)
    parser.add_argument('--output', help='write the figures to this JSON file as well')
    arguments = parser.parse_args()
    if arguments.seconds <= SETTLED:
        parser.error(
            f'--seconds {arguments.seconds:g} must exceed {SETTLED:g}, which do not count'
        )
    from stavpr_ros.threads import wait_passively

    wait_passively()
    if arguments.stages:
        precision, *numbers = arguments.stages
        print(json.dumps(measure_stages(arguments.map, precision, *map(int, numbers))))
        return
    if arguments.sessions:
        print('\n'.join(measure_sessions(arguments.sessions)))
        return
    from stavpr_lab.demonstration.live import private_domain
    from stavpr_ros.ros.process import prepare_transport

    os.environ.update(private_domain())
    prepare_transport()
    load = os.getloadavg()[0]
    counts = [(t, r) for t in arguments.threads for r in ((0, PACE) if t == 1 else (0,))]
    cases = [(p, t, r) for t, r in counts for p in ('float32', 'int8')]
    folder: Any = nullcontext('') if arguments.map else tempfile.TemporaryDirectory()
    with folder as name:
        path = str(Path(arguments.map or Path(name) / 'map.stavpr').resolve())
        if not arguments.map:
            make_map(Path(path))
        report = {
            'size': f'{WIDTH}x{HEIGHT}',
            'cases': cases,
            'stages': [stages(path, *case) for case in cases],
            'nodes': [node_cost(path, rate, arguments) for rate in arguments.rates],
            **about(load),
        }
    print('\n'.join(lines_of(report)))
    print({name: report[name] for name in ('cpu', 'cores', 'commit', 'load_before')})
    if arguments.output:
        Path(arguments.output).write_text(json.dumps(report, indent=2) + '\n')


if __name__ == '__main__':
    main()
