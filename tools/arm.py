# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Test kernels, maps and recognition on aarch64 without a board, in QEMU's user mode.

Usage, in ``make shell``: ``python tools/arm.py --root PATH --site PATH [--qemu PATH]``, or ``make
test-arm``. CONTRIBUTING.md, section "ARM without a board", has the steps that make both folders.
Times under emulation say nothing about a board.
"""

import argparse
from collections.abc import Iterator
import os
from pathlib import Path
import shutil
import subprocess
import sys

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
STEPS = 'the steps are in CONTRIBUTING.md, section "ARM without a board"'
OUTPUT = ROOT / 'build' / 'arm'
PYTHON = 'usr/bin/python3.[0-9]*[0-9]'
PRINT = 'from stavpr_ros.alignment.cpu import int8; print(int8.INSTRUCTION)'
# Few: each one compiles kernels, minutes under emulation.
INT8_TESTS = ('test/test_int8.py', '-k', 'strip_distances_equal or extreme')
TESTS = (
    'test/test_int8.py', 'test/test_matcher.py', 'test/test_alignment.py',
    '-k', 'strip_distances_equal or extreme or fused or paths_equal or image_distances_equal',
)  # fmt: skip
# QEMU's name of a processor, the instruction for int8 that it has, tests
PROCESSORS = (('max', 'dotprod', TESTS), ('cortex-a72', 'plain', INT8_TESTS))
# storage of the file, precision of the matcher, mode
CASES = (
    ('float32', 'float32', 'robust'),
    ('float32', 'float32', 'paper'),
    ('float32', 'int8', 'paper'),
    ('float16', 'float32', 'robust'),
    ('float32', 'int8', 'robust'),
)
# Limits by words in a name, the first that fits, for 99 % of the values: of two strips that are
# about equally near, the last digit selects one. All other values have to be equal. OpenCV's
# average of pixels differs by one gray level in few pixels of the query.
LIMITS = {
    'read from': 0.0, 'int8, paper: distances of the map': 0.0, 'distances of the map': 1e-6,
    'distances': 1e-3, 'features': 1e-3, 'probabilities': 1e-2,
}  # fmt: skip


def images_of_camera(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return views of the synthetic route of 384x512 pixels, which extraction reduces."""
    from fixtures import route_images

    return [image.repeat(4, axis=0).repeat(4, axis=1) for image in route_images(count, seed)]


def results(folder: Path, foreign: Path) -> Iterator[tuple[str, np.ndarray]]:
    """
    Yield names and arrays: features, and the recognition of a query on each map.

    :param folder: where the maps are written, one of each storage.
    :param foreign: folder of the maps that the other processor has written.
    """
    from stavpr_ros.features import FeatureExtractor
    from stavpr_ros.mapping import build_map, load_map, save_map
    from stavpr_ros.method import PlaceRecognizer, RecognizerSettings
    from stavpr_ros.sources.frame import Frame

    extractor, rng = FeatureExtractor('gradient'), np.random.default_rng(0)
    frames = [Frame(image, i, f'place {i}') for i, image in enumerate(images_of_camera(60))]
    place_map = build_map(frames, extractor, progress=False)
    yield 'features of the map', place_map.features.strips
    images = np.stack([*images_of_camera(60)[10:50], *images_of_camera(20, seed=1)])
    noise = rng.integers(0, 16, images.shape, np.uint8)
    query = extractor.extract(list(images // 2 + noise))
    yield 'features of the query', query.strips
    for storage in ('float32', 'float16'):
        save_map(place_map, folder / storage, storage, force=True)
        yield f'features read from {storage}', load_map(foreign / storage).features.strips
    for storage, precision, mode in CASES:
        settings = RecognizerSettings(0.1 if mode == 'paper' else None, mode=mode)
        recognizer = PlaceRecognizer(load_map(folder / storage), settings, 'cpu', precision)
        name = f'map in {storage}, {precision}, {mode}'
        yield f'{name}: distances of the query', recognizer.distances(query)
        if mode == 'paper':
            yield f'{name}: distances of the map', recognizer.distances(place_map.features)
        matches = [recognizer.update(query[i : i + 1]) for i in range(len(query))]
        yield f'{name}: paths', np.concatenate([match.path.pairs for match in matches])
        yield f'{name}: places', np.array([match.place for match in matches])
        yield f'{name}: statuses', np.array([match.status for match in matches])
        windows = 'probabilities' if mode == 'robust' else 'distances of windows'
        yield f'{name}: {windows}', np.array([match.distance for match in matches])


def compare(ours: Path, theirs: Path) -> bool:
    """Print the largest differences of the results in two folders; return whether all agree."""
    here, there = (np.load(folder / 'results.npz') for folder in (ours, theirs))
    agree = True
    for name in here:
        a, b = here[name], there[name]
        limit = next((value for words, value in LIMITS.items() if words in name), 0.0)
        fits = a.shape == b.shape and np.array_equal(np.isnan(a), np.isnan(b))
        off = np.abs(np.nan_to_num(a) - np.nan_to_num(b)) if fits else np.full(1, np.inf)
        fits = float(np.quantile(off, 0.99 if limit else 1.0)) <= limit
        agree &= fits
        of = f', {np.sum(off > limit)} of {off.size} above {limit:g}' if limit else ''
        print(f'{"ok    " if fits else "FAILED"} {name}: at most {off.max():.2g}{of}')
        if name.endswith('statuses'):
            print(f'       of {len(a)} images, {np.sum(a == 2)} are matched')
    return agree


def run(root: Path, site: Path, qemu: str) -> bool:
    """Run everything; return whether all results agree and all tests pass."""
    shared = [str(ROOT), str(ROOT / 'test' / 'shared')]
    paths = os.environ.get('PYTHONPATH', '').split(os.pathsep)
    native = os.environ | {'PYTHONPATH': os.pathsep.join(shared + paths)}
    emulated = os.environ | {
        'PYTHONPATH': os.pathsep.join([*shared, str(site.absolute())]),
        'NUMBA_CACHE_DIR': str(OUTPUT / 'kernels'),
    }
    here, there = OUTPUT / 'here', OUTPUT / 'aarch64'
    recording = [str(Path(__file__).resolve()), '--record']
    subprocess.run([sys.executable, *recording, here, here], env=native, check=True)
    python = max(root.glob(PYTHON))
    agree = True
    for processor, instruction, tests in PROCESSORS:
        command = [qemu, '-cpu', processor, '-L', str(root), str(python)]
        output = subprocess.check_output([*command, '-c', PRINT], env=emulated, text=True)
        print(f'{processor}: int8 by {output.strip()}, expected {instruction}', flush=True)
        agree &= output.strip() == instruction
        if processor == 'max':
            subprocess.run([*command, *recording, there, here], env=emulated, check=True)
            agree &= compare(here, there)
        pytest = [*command, '-m', 'pytest', '-p', 'no:cacheprovider', '-m', 'not long', *tests]
        agree &= subprocess.run(pytest, env=emulated, cwd=ROOT, check=False).returncode == 0
    return agree


def main() -> int:
    """Check the arguments and run; return 1 if a result differs or a test fails."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--root', type=Path, help='folder of an arm64 Debian with Python')
    parser.add_argument('--site', type=Path, help='folder of the aarch64 wheels')
    parser.add_argument('--qemu', default='qemu-aarch64-static', help='(%(default)s)')
    parser.add_argument('--record', nargs=2, type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.record:
        args.record[0].mkdir(parents=True, exist_ok=True)
        np.savez(args.record[0] / 'results.npz', **dict(results(*args.record)))
        return 0
    qemu = shutil.which(args.qemu)
    if qemu is None:
        parser.error(f'--qemu {args.qemu}: no such program; {STEPS}')
    if args.root is None or not any(args.root.glob(PYTHON)):
        parser.error(f'--root {args.root}: expected a folder with {PYTHON}; {STEPS}')
    if args.site is None or not (args.site / 'numba').is_dir():
        parser.error(f'--site {args.site}: expected a folder with numba; {STEPS}')
    return 0 if run(args.root, args.site, qemu) else 1


if __name__ == '__main__':
    sys.exit(main())
