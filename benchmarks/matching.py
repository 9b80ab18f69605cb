"""
Benchmark of the matching: every stage and the whole, beside its floor and beside what others would use.

``make bench``, ``make bench-quick``; or, without building, ``PYTHONPATH=. python benchmarks/matching.py``.
What is measured and how: benchmarks/README.md.
"""

import argparse
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from peer_process import Peers
    from run import Run
    from stages import Plan

RESULTS = Path(__file__).resolve().parent / 'results'
SIZES = (1_000, 2_000, 20_000, 100_000, 1_000_000)
QUICK_LIMIT = RAW_LIMIT = 20_000
DIMENSIONS = (512, 10_416)
BUSY = 0.5  # load average from which a run is worth little
QUICK_RAW_LIMIT = 2_000
QUICK_OPERATIONS = 3e10  # of a distance matrix


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--device', choices=('cpu', 'cuda'), default='cpu')
    parser.add_argument(
        '--quick',
        action='store_true',
        help=f'up to {QUICK_LIMIT:,} places, raw features up to {QUICK_RAW_LIMIT:,}',
    )
    parser.add_argument('--sizes', type=int, nargs='+', default=SIZES, metavar='N', help='places')
    parser.add_argument(
        '--dimensions', type=int, nargs='+', default=DIMENSIONS, metavar='D',
        help=f'of a local feature; above 512 up to {RAW_LIMIT:,} places',
    )  # fmt: skip
    parser.add_argument('--precisions', nargs='+', metavar='DTYPE', help='of the map (all)')
    parser.add_argument('--seconds', type=float, help='spent on one stage (0.5; quick: 0.2)')
    parser.add_argument('--memory', type=float, help='GB to use at most (12; on a GPU: what is free)')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--no-peers', action='store_true', help='without librosa and tslearn (.venv-peers)')
    parser.add_argument('--commit', default='', help='what is measured, where git does not tell')
    parser.add_argument('--output', type=Path, default=RESULTS, help='folder of the results (%(default)s)')
    options = parser.parse_args(arguments)
    if options.quick:
        options.sizes = [n for n in options.sizes if n <= QUICK_LIMIT]
    options.seconds = options.seconds or (0.2 if options.quick else 0.5)
    options.memory = 1e9 * (options.memory or (12 if options.device == 'cpu' else 1e6))
    return options


def open_peers(stack: ExitStack, refused: bool) -> tuple['Peers | None', str]:
    """Start the peers; None, and why, where that cannot be."""
    from peer_process import Peers, PeersMissingError

    if refused:
        return None, 'left out: --no-peers'
    try:
        return stack.enter_context(Peers()), ''
    except PeersMissingError as error:
        return None, f'no environment for the peers: {error}'


def bands_of(dimension: int) -> tuple[int | None, ...]:
    """Return xi: projected features with and without restriction, raw ones without."""
    return (None, 3) if dimension <= 512 else (None,)


def cases_of(options: argparse.Namespace) -> list[tuple[int, int]]:
    """Return the sizes (n, d) of the maps: raw features of fewer places than projected ones."""
    raw = QUICK_RAW_LIMIT if options.quick else RAW_LIMIT
    return [(n, d) for d in options.dimensions for n in options.sizes if d <= 512 or n <= raw]


def count_steps(options: argparse.Namespace, cases: list[tuple[int, int]]) -> int:
    """Return how many stages there will be, for the progress bar."""
    precisions = len(options.precisions)
    products = len({*options.precisions, 'bfloat16'})
    featured = sum(products + precisions * 3 * len(bands_of(d)) for _, d in cases)
    return featured + (4 if options.device == 'cpu' else 1) * len(options.sizes)


def measure_all(run: 'Run', plan: 'Plan', options: argparse.Namespace, cases: list[tuple[int, int]]) -> None:
    """Measure all stages of all sizes."""
    from stages import feature_stages, memory_problem, sequence_stages

    with ExitStack() as stack:
        processes, reason = open_peers(stack, options.no_peers)
        for n in options.sizes:
            sequence_stages(run, plan, n, processes, reason)
    for n, d in cases:
        problem = memory_problem(plan, run, n, d)
        if problem:
            for precision in options.precisions:
                run.skip('online_frame', n, d, precision, problem)
            continue
        with run.otherwise_skip('online_frame', n, d, options.precisions[0]):
            feature_stages(run, plan, n, d, bands_of(d))


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
    from ceilings import SIDE, measure_ceilings
    from marks import with_marks
    from records import machine, save, slug, with_machine
    from report import marks_section, write
    from run import Run
    from stages import Plan

    from stavpr_ros.alignment import SequenceSettings
    from stavpr_ros.recognition.matcher import PRECISIONS

    most = QUICK_OPERATIONS if options.quick else float('inf')
    options.precisions = tuple(options.precisions or PRECISIONS)
    plan = Plan(options.precisions, 7, SequenceSettings(), options.memory, options.seed, most)
    cases = cases_of(options)
    about = machine(options.device, options.commit)
    began = time.perf_counter()
    if about['machine']['load_before'] > BUSY:
        print(f'The machine is busy (load {about["machine"]["load_before"]}): the figures will not repeat.')
    before = measure_ceilings(options.device, options.seconds)
    run = Run(options.device, options.seconds, count_steps(options, cases))
    measure_all(run, plan, options, cases)
    run.close()
    ceilings = before.best(measure_ceilings(options.device, options.seconds, SIDE // 2))
    records = with_machine(with_marks(run.finished(ceilings)), about)
    quick = '-quick' if options.quick else ''
    path = options.output / f'matching-{slug(about["machine"])}{quick}.json'
    save(records, path)
    table = write(path)
    print('\n'.join(marks_section(records)))
    print(f'took {time.perf_counter() - began:.0f} s\nwrote {path}\nwrote {table}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
