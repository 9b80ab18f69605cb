# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Time, kernels and bytes of an image on a device of torch, beside the answers of the CPU.

    python benchmarks/device.py                  # on the CUDA device: time and kernels
    python benchmarks/device.py --device cpu     # without a GPU: operations and bytes

Features are random, 7 strips of 224 dimensions. An image is ``recognizer.update()``, the result on
the host. Times are of the wall clock, in ms: quartiles over 60 images. Kernels and their time are
from torch's profiler. Operations and their bytes are counted as torch dispatches them: what
each reads and writes, as if nothing stayed in a cache.
"""

from itertools import cycle
import json
from pathlib import Path
import platform
import sys
import time
from typing import Any
from unittest.mock import patch

import numpy as np
from results import commit, parser_of
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.mapping import descriptor_map
from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
from stavpr_ros.prepare.blocks import convert_features
from stavpr_ros.prepare.centering import MeanCentering
from stavpr_ros.prepare.prepared_map import PreparedMap
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

STRIPS, DIMENSION = 7, 224
DISTINCT = 100_000  # places of the map that are not copies
WARM, IMAGES, PROFILED = 25, 60, 5
CASES = (('robust', 'float32'), ('paper', 'float32'), ('robust', 'int8'))


class Counter(TorchDispatchMode):
    """Counts operations, views aside, and the bytes that they read and write."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if not func.is_view and 'empty' not in str(func):
            self.operations += 1
            moved = (args, result)  # an argument ``out`` is the result
            if any(name in str(func) for name in ('index', 'take', 'gather')):
                # of the first argument only what is copied from it or to it
                copied = args[-1] if func._schema.name.endswith('_') else result
                moved = (args[1:], copied)
            self.bytes += sum(map(_bytes, _tensors(moved)))
        return result


def _tensors(arguments: Any) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, torch.Tensor)]


def _bytes(tensor: torch.Tensor) -> int:
    """Return the bytes of a tensor; elements that are one in memory count once."""
    sizes = list(zip(tensor.shape, tensor.stride(), strict=True))
    distinct = int(np.prod([size for size, stride in sizes if stride]))
    span = sum((size - 1) * stride for size, stride in sizes)
    return min(distinct, span + 1) * tensor.element_size() if tensor.numel() else 0


def drive(n: int) -> tuple[LocalFeatures, LocalFeatures]:
    """Return the features of a map of n places, and of a drive along them."""
    rng, few = np.random.default_rng(n), min(n, DISTINCT)
    strips = rng.standard_normal((STRIPS, few, DIMENSION), np.float32)
    driven = strips[:, few // 2 : few // 2 + 400]
    driven = driven + rng.standard_normal(driven.shape, np.float32)
    settings = FeatureSettings('gradient', None, STRIPS)

    def features(x: np.ndarray, count: int) -> LocalFeatures:
        unit = x / np.linalg.norm(x, axis=2, keepdims=True)
        unit = np.tile(unit, (1, -(-count // unit.shape[1]), 1))[:, :count]
        weights = np.full(unit.shape[:2], STRIPS**-0.5, np.float32)
        return LocalFeatures(np.ascontiguousarray(unit), weights, settings)

    return features(strips, n), features(driven, 400)


def recognizer_of(
    places: LocalFeatures, mode: str, precision: str, backend: Any
) -> PlaceRecognizer:
    """Return a recognizer that uses the features as they are: their centering takes minutes."""

    def prepare(*_: Any) -> PreparedMap:
        used = convert_features(places, rounds=True) if precision == 'int8' else places
        few = places[: min(len(places), 2000)]
        centering = MeanCentering(few, True, True) if mode == 'robust' else None
        return PreparedMap(used, centering, np.ones((5, len(places)), np.float32))

    settings = RecognizerSettings(0.9 if mode == 'paper' else None, mode=mode)
    with patch('stavpr_ros.method.localizer.prepare_map', prepare):
        return PlaceRecognizer(descriptor_map(places), settings, backend, precision)


def measure(
    places: LocalFeatures, driven: LocalFeatures, mode: str, precision: str, backend: Any
) -> dict[str, Any]:
    """Measure images of one recognizer; see the module."""
    one = recognizer_of(places, mode, precision, backend)
    images = cycle([driven[i : i + 1] for i in range(len(driven))])
    row: dict[str, Any] = {'mode': mode, 'precision': precision, 'places': len(places)}
    answers, seconds = [], []
    for _ in range(WARM + IMAGES):
        image = next(images)
        began = time.perf_counter()
        match = one.update(image)
        seconds.append(time.perf_counter() - began)
        middle = match.path.place
        answers.append((match.status.name, middle, match.distance))
    quartiles = np.percentile(1e3 * np.array(seconds[WARM:]), [50, 25, 75])
    row['ms'] = [round(float(ms), 4) for ms in quartiles]
    row['matched'] = sum(status == 'MATCH' for status, *_ in answers[WARM:])
    if str(backend).startswith('cuda'):
        from torch.profiler import profile, ProfilerActivity

        with profile(activities=[ProfilerActivity.CUDA, ProfilerActivity.CPU]) as profiled:
            for _ in range(PROFILED):
                one.update(next(images))
            torch.cuda.synchronize()
        on_device = [
            event for event in profiled.events() if str(event.device_type).endswith('CUDA')
        ]
        kernels = [event for event in on_device if not event.name.startswith('Mem')]
        called = [event.name for event in profiled.events() if 'aunch' in event.name]
        microseconds = sum(event.time_range.elapsed_us() for event in on_device)
        by_name: dict[str, float] = {}
        for event in on_device:
            by_name[event.name] = by_name.get(event.name, 0) + event.time_range.elapsed_us()
        row |= {
            'kernels': len(kernels) / PROFILED,
            'launches': len(called) / PROFILED,
            'copies': (len(on_device) - len(kernels)) / PROFILED,
            'kernel_ms': round(1e-3 * microseconds / PROFILED, 4),
            'longest': {
                name[:90]: round(1e-3 * us / PROFILED, 4)
                for name, us in sorted(by_name.items(), key=lambda pair: -pair[1])[:8]
            },
            'memory_gb': round(torch.cuda.max_memory_allocated() / 1e9, 2),
        }
    else:
        with Counter() as counter:
            one.update(next(images))
        row |= {
            'operations': counter.operations,
            'bytes_per_place': round(counter.bytes / len(places)),
        }
    if len(places) <= DISTINCT:
        row |= compare_answers(answers, recognizer_of(places, mode, precision, 'cpu'), driven)
    return row


def compare_answers(
    answers: list[tuple[str, int, float]], cpu: PlaceRecognizer, driven: LocalFeatures
) -> dict[str, Any]:
    """Compare with the answers of the CPU to the same images."""
    different, difference = 0, 0.0
    for i, (status, middle, distance) in enumerate(answers):
        match = cpu.update(driven[i : i + 1])
        same = status == match.status.name and (not match.accepted or match.path.place == middle)
        different += not same
        if match.path.place >= 0:
            difference = max(difference, abs(distance - match.distance))
    return {'different_answers': different, 'largest_difference': difference}


def main() -> int:
    """Measure all cases."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add('--device', default='cuda', help='of torch (%(default)s)')
    add('--places', type=int, nargs='+', default=[2_000, 100_000, 1_000_000])
    add('--out', type=Path, help='write the JSON to this file as well')
    options = parser.parse_args()
    is_cuda = options.device.startswith('cuda')
    backend = options.device if is_cuda else torch.device(options.device)
    result: dict[str, Any] = {
        'device': torch.cuda.get_device_name() if is_cuda else platform.processor(),
        'torch': torch.__version__,
        'commit': commit(),
        'command': 'python benchmarks/device.py ' + ' '.join(sys.argv[1:]),
        'images': IMAGES,
        'cases': [],
    }
    for n in options.places:
        places, driven = drive(n)
        for mode, precision in CASES:
            began = time.perf_counter()
            try:
                row = measure(places, driven, mode, precision, backend)
            except Exception as error:  # one case of a device that fails must not hide the others
                row = {'mode': mode, 'precision': precision, 'places': n, 'error': repr(error)}
            row['took_s'] = round(time.perf_counter() - began, 1)
            result['cases'].append(row)
            print(json.dumps(row), flush=True)
            if options.out:
                options.out.write_text(json.dumps(result, indent=1) + '\n')
            if is_cuda:
                torch.cuda.empty_cache()
                torch.cuda.reset_peak_memory_stats()
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
