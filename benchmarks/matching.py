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
CITY = 200_000  # from here on, a CPU measures mode robust in int8 alone
QUICK_LIMIT = 20_000  # most places of --quick
DIMENSIONS = (224, 512)  # of the gradient features, and of projected ones
GRAPH = ROOT / 'docs' / 'performance.png'
BUSY = 0.5  # load average above which results are not repeatable


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = options_parser(__doc__, f'up to {QUICK_LIMIT:,} places, fewer runs')
    add = parser.add_argument
    add('--device', choices=('cpu', 'cuda'), default='cpu')
    add('--sizes', type=int, nargs='+', default=SIZES, metavar='N', help='places')
    add('--dimensions', type=int, nargs='+', default=DIMENSIONS, metavar='D', help='of a feature')
    add('--precisions', nargs='+', metavar='DTYPE', help='of the map (all)')
    add('--seconds', type=float, help='duration of one measurement (0.5; quick: 0.15)')
    add('--memory', type=float, default=12, help='most GB to use (%(default)s)')
    add('--seed', type=int, default=0)
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
    import torch

    if run.device == 'cpu':
        extraction_stages(run, options.seed)
    for n in options.sizes:
        robust_stages(run, n, options.seed)
    for n in options.sizes:
        if n >= CITY and run.device == 'cpu':
            run.skip('frame', n, 0, 'float32 and mode paper: too large')
            city_stages(run, n, options.dimensions[0], options.seed)
            continue
        for d in options.dimensions:
            problem = memory_problem(n, d, run.device, 1e9 * options.memory)
            try:
                if not problem:
                    feature_stages(run, n, d, options.precisions, options.seed)
            except (MemoryError, torch.cuda.OutOfMemoryError) as error:
                problem = f'out of memory: {str(error).splitlines()[0]}'
            if problem:
                run.skip('frame', n, d, problem)
    for n in options.sizes:
        process_stages(run, n, 'int8' if n >= CITY else 'float32', options.seed)
    for n in (size for size in options.sizes if size < CITY):
        paper_stages(run, n, options.seed)


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    options = parse(arguments)
    from stavpr_ros.devices import choose_device
    from stavpr_ros.errors import StavprError
    from stavpr_ros.threads import wait_passively

    wait_passively()  # as the node does; before torch and numba are imported
    try:
        choose_device(options.device)
    except StavprError as error:
        print(error, file=sys.stderr)
        return 2
    from graphs import draw
    from memory import CASES, measure_memory, TARGET
    from peaks import measure_peaks
    from report import report
    from results import environment, file_name, write_json, write_lines
    from run import Run
    from stavpr_ros.prepare.matcher import PRECISIONS

    options.precisions = tuple(options.precisions or PRECISIONS)
    about = environment(options.device, options.commit)
    began = time.perf_counter()
    if about['machine']['load_before'] > BUSY:
        print(f'busy machine, load {about["machine"]["load_before"]}: do not quote the times')
    with_memory = options.device == 'cpu' and not options.no_memory
    memory = [measure_memory(*case) for case in CASES if with_memory]
    peaks = measure_peaks(options.device, options.seconds)
    run = Run(options.device, peaks, options.seconds)
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
    if importlib.util.find_spec('matplotlib'):
        documented = options.output == RESULTS and not options.quick and options.device == 'cpu'
        draw(run.rows, GRAPH if documented else (options.output / name).with_suffix('.png'))
    first, last = lines.index('## Targets'), lines.index('## All stages')
    print('\n'.join(lines[first:last]))
    print(f'took {time.perf_counter() - began:.0f} s\nwrote {options.output / name} and its .md')
    return 0


if __name__ == '__main__':
    sys.exit(main())
