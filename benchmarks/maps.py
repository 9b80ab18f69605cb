# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Map files: time to the first answer, and memory.

Every start is a process of its own, after imports and a start on a tiny map, which loads compiled
kernels. The times are of ``open_map``, of the recognizer, and of its first match; *cold*:
the file was dropped from the page cache before. The floor is the time to read the bytes that the
matcher keeps, or is made of, from the same file. ``PYTHONPATH=. python benchmarks/maps.py``.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
import os
from pathlib import Path
import tempfile
import time
from typing import Any

import numpy as np
from results import cpu_model, table, write_json
from stavpr_ros.threads import thread_count

TINY = 300  # places
CACHES = ('cold', 'warm')


@dataclass(frozen=True)
class Case:
    """A start: file, and precision of the matcher."""

    file: str
    precision: str


CASES = (
    Case('plain', 'float32'),
    Case('plain', 'int8'),
    Case('statistics', 'float32'),
    Case('statistics', 'int8'),
    Case('codes', 'int8'),
)


def write_files(folder: Path, places: int) -> None:
    """Write maps of simulated places, float16."""
    from city import city
    from data import data_folder
    from stavpr_ros.commands.map import main as map_main
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.mapping import descriptor_map, save_map
    from stavpr_ros.mapping.builder import extract_features
    from stavpr_ros.sources import open_source

    source = open_source(data_folder() / 'gardens_point/day_left')
    features, _ = city(
        extract_features(source, FeatureExtractor('gradient'), progress=False), places, 0
    )
    save_map(descriptor_map(features), folder / 'plain', 'float16')
    for name, options in (('statistics', []), ('codes', ['--codes'])):
        assert map_main(['compact', str(folder / 'plain'), str(folder / name), *options]) == 0


def start(path: Path, precision: str, cache: str) -> dict[str, Any]:
    """Return the times of a start in this process, s, and its memory, MB."""
    from memory import resident_bytes
    from stavpr_ros.mapping import descriptor_map, open_map
    from stavpr_ros.recognition import PlaceRecognizer, RecognizerSettings

    settings = RecognizerSettings(mode='robust')
    tiny = open_map(path).features[:TINY]
    warm = PlaceRecognizer(descriptor_map(tiny), settings, 'cpu', precision)
    for i in range(settings.sequence.length + 1):
        warm.update(tiny[i : i + 1])
    with path.open('rb') as file:
        os.fsync(file.fileno())
        if cache == 'cold':
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        else:
            while file.read(2**24):
                pass
    before = resident_bytes()
    times, used = [time.perf_counter()], time.process_time()
    place_map = open_map(path)
    times.append(time.perf_counter())
    recognizer = PlaceRecognizer(place_map, settings, 'cpu', precision)
    times.append(time.perf_counter())
    recognizer.update(tiny[:1])
    times.append(time.perf_counter())
    used = time.process_time() - used
    growth = resident_bytes() - before
    file = place_map.features.file
    part = file.parts['statistics/codes' if path.name == 'codes' else 'strips']
    content: np.ndarray = np.ones(part.size, np.uint8)  # pages that are in memory
    began = time.perf_counter()
    file.fill(content, part.start)
    read = time.perf_counter() - began
    names = ('open', 'recognizer', 'first')
    return {
        **dict(zip(names, np.diff(times).tolist(), strict=True)),
        'all': times[-1] - times[0],
        'processor': used,
        'read_once': read,
        'megabytes': growth / 1e6,
        'load': os.getloadavg()[0],
    }


def measure(path: Path, case: Case, cache: str, runs: int) -> dict[str, Any]:
    """Return the fastest of several runs, each a process of its own."""
    starts = []
    for _ in range(runs):
        with ProcessPoolExecutor(1, get_context('spawn')) as pool:
            starts.append(pool.submit(start, path, case.precision, cache).result())
    best: dict[str, Any] = min(starts, key=lambda one: one['all'])
    return {'file': case.file, 'precision': case.precision, 'cache': cache, **best}


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table of the starts."""
    head = ('file', 'precision', 'page cache', 'open', 'recognizer', 'first match', 'all')
    cells = [
        [
            row['file'], row['precision'], row['cache'],
            *(f'{row[name]:.2f}' for name in ('open', 'recognizer', 'first', 'all')),
            *(f'{row[name]:.2f}' for name in ('processor', 'read_once')),
            f'{row["megabytes"]:.0f}', f'{row["load"]:.1f}',
        ]
        for row in rows
    ]  # fmt: skip
    return table((*head, 'processor', 'read once', 'MB', 'load'), cells)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--places', type=int, default=100_000)
    parser.add_argument('--runs', type=int, default=3, help='of each start (%(default)s)')
    parser.add_argument('--output', type=Path, help='JSON file')
    arguments = parser.parse_args()
    from stavpr_ros.threads import wait_passively

    wait_passively()  # as the node does; the processes that are timed inherit it
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files(folder, arguments.places)
        sizes = {path.name: path.stat().st_size / 1e6 for path in sorted(folder.iterdir())}
        pairs = product(CASES, CACHES)
        rows = [measure(folder / case.file, case, cache, arguments.runs) for case, cache in pairs]
    print(f'{cpu_model()}, {thread_count()} threads; {arguments.places:,} places')
    print(', '.join(f'{name}: {size:.0f} MB' for name, size in sizes.items()))
    print('\n'.join(lines(rows)))
    if arguments.output:
        document = {'processor': cpu_model(), 'places': arguments.places, 'megabytes': sizes}
        write_json(arguments.output, document | {'starts': rows})


if __name__ == '__main__':
    main()
