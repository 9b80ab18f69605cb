# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Time of an image in mode robust, beside the time to move its bytes; for a machine with a GPU.

    python benchmarks/cuda_robust.py [--places N ...] [--precision ...] [--backend cpu]
    python benchmarks/cuda_robust.py --places --loop-closure 20000

The table of bytes is that of docs/performance.md, "On a GPU".
"""

import argparse
import time

from data import make_features
import numpy as np
from peaks import device_read_bandwidth, read_bandwidth
from stavpr_ros.devices import choose_backend
from stavpr_ros.mapping import descriptor_map
from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings
from stavpr_ros.recognition.loop_closer import LoopCloser
import torch

W, DIMENSIONS = 7, 224
STRIPS = W * DIMENSIONS
MAP_BYTES = {'float32': 4 * STRIPS, 'int8': STRIPS + 8 * STRIPS}
OTHER_BYTES = 396 + 60 + 243 + 286 + 60  # of a place: products, row, place filter
BACKGROUND_BYTES = 40  # of a place, in loop closure
WARM_UP = 25


def frame_times(recognizer: PlaceRecognizer, images: int) -> np.ndarray:
    """Return the milliseconds of images, each with its answer on the CPU."""
    queries = make_features(images + WARM_UP, DIMENSIONS, W, 'cpu', 1)
    times = []
    for i in range(images + WARM_UP):
        began = time.perf_counter()
        recognizer.update(queries[i : i + 1])
        times.append((time.perf_counter() - began) * 1e3)
    return np.array(times[WARM_UP:])


def line(
    name: str, places: int, precision: str, times: np.ndarray, bandwidth: float, more: int = 0
) -> str:
    """Return the row of the table; ``more`` bytes a place are moved."""
    least = 1e3 * places * (MAP_BYTES[precision] + OTHER_BYTES + more) / bandwidth
    middle, high = np.median(times), np.percentile(times, 99)
    numbers = ' | '.join(f'{value:.2f}' for value in (middle, high, least))
    return f'| {name} | {precision} | {numbers} | {middle / least:.1f} |'


def route_times(places: int, precision: str, device: str, images: int) -> np.ndarray:
    """Return the milliseconds of the last images of a route of so many places."""
    features = make_features(places, DIMENSIONS, W, 'cpu', 0)
    settings = RecognizerSettings(mode='robust')
    closer = LoopCloser(settings, 50, features.settings, backend=device, precision=precision)
    times = []
    for i in range(places):
        began = time.perf_counter()
        closer.update(features[i : i + 1])
        times.append((time.perf_counter() - began) * 1e3)
    return np.array(times[-images:])


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--places', type=int, nargs='*', default=[20_000, 100_000, 1_000_000])
    parser.add_argument('--loop-closure', type=int, nargs='*', default=[], metavar='N')
    parser.add_argument('--precision', nargs='+', default=list(MAP_BYTES), choices=MAP_BYTES)
    parser.add_argument('--backend', default='cuda', choices=('cuda', 'cpu'))
    parser.add_argument('--images', type=int, default=200)
    arguments = parser.parse_args()
    device = choose_backend(arguments.backend)
    bandwidth = device_read_bandwidth(1024, 1) if device == 'cuda' else read_bandwidth(256, 1, 1)
    print(f'read bandwidth {bandwidth / 1e9:.0f} GB/s')
    print('| places | precision | ms, p50 | p99 | ms of the bytes of a GPU | ratio |')
    print('|---|---|---|---|---|---|')
    for places in arguments.places:
        place_map = descriptor_map(make_features(places, DIMENSIONS, W, 'cpu', 0))
        for precision in arguments.precision:
            settings = RecognizerSettings(mode='robust')
            recognizer = PlaceRecognizer(place_map, settings, device, precision)
            times = frame_times(recognizer, arguments.images)
            del recognizer
            print(line(f'{places:,}', places, precision, times, bandwidth), flush=True)
            if device == 'cuda':
                torch.cuda.empty_cache()
    for places in arguments.loop_closure:
        for precision in arguments.precision:
            times = route_times(places, precision, device, arguments.images)
            name = f'{places:,}, loop closure'
            print(line(name, places, precision, times, bandwidth, BACKGROUND_BYTES), flush=True)


if __name__ == '__main__':
    main()
