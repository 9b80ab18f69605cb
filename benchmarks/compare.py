# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Speed of two checkouts, the same frames in turn, A B A B, and the ratio pair by pair; or answers.

``python benchmarks/compare.py CHECKOUT --answers`` compares every bit of the golden streams that
each checkout has, test/shared/golden.py.

``python benchmarks/compare.py CHECKOUT`` times this checkout (A) and another one (B). Each runs
in a process of its own that imports the package from its checkout and sleeps while the other is
timed.
"""

import argparse
from collections.abc import Iterator
from itertools import cycle, product
import json
import os
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np
from results import parser_of, ROOT

STRIPS, LENGTH, QUERIES = 7, 20, 1000
DIMENSIONS = 224  # of features whose cells are compared
MAX_LINES = 5  # differences of a stream


def make_frame(strips: np.ndarray, weights: np.ndarray, mode: str, precision: str) -> Any:
    """
    Return a call that updates a recognizer with one image, strips (W, 1, d) and weights (W, 1).

    :param strips, weights: of the map, shapes (W, n, d) and (W, n), float32.
    """
    from stavpr_ros.features import FeatureSettings, LocalFeatures
    from stavpr_ros.mapping import descriptor_map
    from stavpr_ros.method import PlaceRecognizer, RecognizerSettings

    def features(strips: np.ndarray, weights: np.ndarray) -> LocalFeatures:
        return LocalFeatures(strips, weights, settings)

    settings = FeatureSettings('gradient', None)
    place_map = descriptor_map(features(strips, weights))
    limit: dict[str, Any] = {'threshold': 1.0} if mode == 'paper' else {'min_probability': 1e-9}
    recognizer = PlaceRecognizer(
        place_map, RecognizerSettings(mode=mode, **limit), 'cpu', precision
    )

    return lambda strips, weights: recognizer.update(features(strips, weights))


def random_strips(n: int, seed: int, mean: float | np.ndarray = 0.0) -> np.ndarray:
    """Draw unit-norm features, shape (W, n, d), float32, half of them ``mean``."""
    strips = np.random.default_rng(seed).standard_normal((STRIPS, n, DIMENSIONS), np.float32)
    strips = strips * np.float32(DIMENSIONS**-0.5) + mean
    strips /= np.linalg.norm(strips, axis=2, keepdims=True)
    return strips


def serve() -> None:
    """Serve one checkout: read requests, one JSON line each; write the seconds of the frames."""
    from stavpr_ros.threads import wait_passively

    wait_passively()
    for line in sys.stdin:
        request = json.loads(line)
        if 'frames' not in request:
            n = request['n']
            weights = np.full((STRIPS, n), STRIPS**-0.5, np.float32)
            strips, count = random_strips(n, 0), min(n, QUERIES)
            drive = random_strips(count, 1, strips[:, :count])  # along the map
            call = make_frame(strips, weights, request['mode'], request['precision'])
            following = cycle(np.split(drive, count, axis=1))
            request['frames'] = LENGTH
        seconds = []
        for _ in range(request['frames']):
            strips = next(following).copy()
            began = time.perf_counter()
            call(strips, weights[:, :1].copy())
            seconds.append(time.perf_counter() - began)
        print(json.dumps({'seconds': seconds}), flush=True)


class Checkout:
    """The process of one checkout."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, __file__, str(folder), '--serve']
        environment = os.environ | {'PYTHONPATH': str(folder)}
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, **request: Any) -> dict[str, Any]:
        """Send a request and return its reply."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(request) + '\n')
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(
                f'compare: the process of a checkout exited with status {self._process.wait()}'
            )
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait()


def compare(
    this: Checkout, other: Checkout, case: dict[str, Any], rounds: int, frames: int
) -> dict[str, Any]:
    """
    Time frames of both checkouts in turn.

    :returns: medians in seconds, median and quartiles of the pairs' ratios (this over other).
    """
    for checkout in (this, other):
        checkout.run(**case)
    ours, theirs = list[float](), list[float]()
    for _ in range(rounds):
        # the first frame after the other process ran refills the caches: it does not count
        replies = [checkout.run(frames=frames + 1) for checkout in (this, other)]
        for medians, reply in zip((ours, theirs), replies, strict=True):
            medians.append(statistics.median(reply['seconds'][1:]))
    ratios = [one / twin for one, twin in zip(ours, theirs, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4, method='inclusive')
    return case | {
        'this_s': statistics.median(ours),
        'other_s': statistics.median(theirs),
        'ratio': middle,
        'ratio_quartiles': [low, high],
    }


def answers(checkout: Path) -> dict[str, list[Any]]:
    """Return every answer of a checkout to its golden streams."""
    folders = [checkout, checkout / 'test' / 'shared', os.environ.get('PYTHONPATH', '')]
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(map(str, folders))}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, 'answers.json')
        command = [sys.executable, str(checkout / 'test/shared/golden.py'), '--all', str(file)]
        subprocess.run(command, env=environment, check=True)
        return json.loads(file.read_text())


def differences(ours: Any, theirs: Any, name: str = '') -> Iterator[str]:
    """Yield a line for each value that differs, by its name; NaN equals NaN."""
    if isinstance(ours, dict | list) and type(ours) is type(theirs) and len(ours) == len(theirs):
        for key in ours if isinstance(ours, dict) else range(len(ours)):
            if isinstance(ours, dict) and key not in theirs:
                yield f'{name}/{key}: only here'
            else:
                yield from differences(ours[key], theirs[key], f'{name}/{key}')
    elif json.dumps(ours) != json.dumps(theirs):
        yield f'{name}: {str(ours)[:60]} here, {str(theirs)[:60]} there'


def compare_answers(other: Path) -> int:
    """Compare the golden streams; 1 if a value differs."""
    ours, theirs = answers(ROOT), answers(other)
    for name in ours.keys() & theirs.keys():
        lines = list(differences(ours[name], theirs[name]))
        count = f'{len(lines):,} values DIFFER' if lines else 'equal'
        print(f'{name}, {len(ours[name])} images: {count}', *lines[:MAX_LINES], sep='\n  ')
    for name in sorted(ours.keys() ^ theirs.keys()):
        print(f'{name}: in one checkout only')
    same = (json.dumps(ours[name]) == json.dumps(theirs[name]) for name in ours.keys() & theirs)
    return 0 if all(same) else 1


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 1 if this checkout is slower than allowed, or answers differ."""
    parser = parser_of(__doc__)
    parser.add_argument('checkout', type=Path, help='folder of the other checkout')
    parser.add_argument('--answers', action='store_true', help='compare these, and no times')
    parser.add_argument(
        '--sizes', type=int, nargs='+', default=[2_000, 20_000], metavar='N', help='places'
    )
    parser.add_argument('--precisions', nargs='+', default=['float32', 'int8'], metavar='DTYPE')
    parser.add_argument('--rounds', type=int, default=15, help='pairs of runs (%(default)s)')
    parser.add_argument('--frames', type=int, default=20, help='frames of each run (%(default)s)')
    parser.add_argument('--allowed', type=float, default=1.05, help='largest ratio (%(default)s)')
    parser.add_argument('--serve', action='store_true', help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.serve:
        serve()
        return 0
    if options.answers:
        return compare_answers(options.checkout.resolve())
    this, other = Checkout(ROOT), Checkout(options.checkout.resolve())
    results = []
    head = ('mode', 'n', 'precision', 'this ms', 'other ms', 'ratio')
    print('{:8}{:>9} {:10}{:>9}{:>10}{:>7}  quartiles'.format(*head))
    for mode, n, precision in product(('robust', 'paper'), options.sizes, options.precisions):
        case = {'mode': mode, 'n': n, 'precision': precision}
        result = compare(this, other, case, options.rounds, options.frames)
        low, high = result['ratio_quartiles']
        print(
            f'{mode:8}{n:>9,} {precision:10}{1e3 * result["this_s"]:>9.2f}'
            f'{1e3 * result["other_s"]:>10.2f}{result["ratio"]:>7.3f}  {low:.3f} {high:.3f}',
            flush=True,
        )
        results.append(result)
    this.close()
    other.close()
    return 1 if any(result['ratio'] > options.allowed for result in results) else 0


if __name__ == '__main__':
    sys.exit(main())
