# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of matching: every stage and whole frames beside lower bounds and peers, and memory.

``make bench``, ``make bench-quick``; without building, ``PYTHONPATH=. python
benchmarks/matching.py``. Method and tables: benchmarks/README.md.
"""

import argparse
from dataclasses import asdict
import importlib.util
import sys
import time
from typing import TYPE_CHECKING

from results import options_parser, RESULTS, ROOT

if TYPE_CHECKING:
    from run import Run

SIZES = (2_000, 20_000, 100_000, 1_000_000)
CITY = 200_000  # from here on, mode robust is measured in int8 alone
QUICK_LIMIT = 20_000  # most places of --quick
DIMENSIONS = (224, 512)  # gradient features, and projected ones
GRAPH = ROOT / 'docs' / 'performance.png'
BUSY = 0.5  # load average above which results are not repeatable


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = options_parser(__doc__, f'up to {QUICK_LIMIT:,} places, fewer runs')
    add = parser.add_argument
    add('--sizes', type=int, nargs='+', default=SIZES, metavar='N', help='places')
    add('--dimensions', type=int, nargs='+', default=DIMENSIONS, metavar='D', help='of a feature')
    add('--seconds', type=float, help='duration of one measurement (0.5; quick: 0.15)')
    add('--no-memory', action='store_true', help='without the memory of the pipeline')
    options = parser.parse_args(arguments)
    if options.quick:
        options.sizes = [n for n in options.sizes if n <= QUICK_LIMIT]
    options.seconds = options.seconds or (0.15 if options.quick else 0.5)
    return options


def measure_stages(run: 'Run', options: argparse.Namespace) -> None:
    """Measure all stages of all sizes."""
    from extraction import extraction_stages
    from stages import (
        city_stages,
        feature_stages,
        memory_problem,
        paper_stages,
        process_stages,
        robust_stages,
    )

    extraction_stages(run)
    for n in options.sizes:
        robust_stages(run, n)
    for n in options.sizes:
        if n >= CITY:
            run.skip('frame', n, 0, 'float32 and mode paper: too large')
            city_stages(run, n, options.dimensions[0])
            continue
        for d in options.dimensions:
            problem = memory_problem(n, d)
            try:
                if not problem:
                    feature_stages(run, n, d)
            except MemoryError as error:
                problem = f'out of memory: {str(error).splitlines()[0]}'
            if problem:
                run.skip('frame', n, d, problem)
    for n in options.sizes:
        process_stages(run, n, 'int8' if n >= CITY else 'float32')
    for n in (size for size in options.sizes if size < CITY):
        paper_stages(run, n)


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = parse(arguments)
    from stavpr_ros.threads import wait_passively

    wait_passively()  # as the node does; before torch and numba are imported
    from memory import CASES, measure_memory, TARGET
    from peaks import measure_peaks
    from report import report
    from results import environment, file_name, write_json, write_lines
    from run import Run

    about = environment(options.commit)
    began = time.perf_counter()
    if about['machine']['load_before'] > BUSY:
        print(f'busy machine, load {about["machine"]["load_before"]}: do not quote the times')
    memory = [measure_memory(*case) for case in CASES if not options.no_memory]
    peaks = measure_peaks(options.seconds)
    run = Run(peaks, options.seconds)
    measure_stages(run, options)
    name = f'matching-{file_name(about["machine"])}{"-quick" if options.quick else ""}.json'
    document = about | {
        'peaks': asdict(peaks),
        'rows': [asdict(row) | {'ratio_to_lower_bound': row.ratio} for row in run.rows],
        'memory': [asdict(one) | {'ratio': one.ratio, 'wanted': TARGET} for one in memory],
        'skipped': run.skipped,
    }
    write_json(options.output / name, document)
    lines = report(about, run, memory)
    write_lines((options.output / name).with_suffix('.md'), lines)
    if all(map(importlib.util.find_spec, ('matplotlib', 'stavpr_lab'))):
        from graphs import draw

        documented = options.output == RESULTS and not options.quick
        draw(run.rows, GRAPH if documented else (options.output / name).with_suffix('.png'))
    first, last = lines.index('## Targets'), lines.index('## All stages')
    print('\n'.join(lines[first:last]))
    print(f'took {time.perf_counter() - began:.0f} s\nwrote {options.output / name} and its .md')
    return 0


if __name__ == '__main__':
    sys.exit(main())
