# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Gradient features: one image on one core and on all, batches, raw encodings; JPEG decoding apart.

``python benchmarks/features.py --output FILE``. The images are synthetic and, as a camera's, come
in turn from more memory than a cache holds. The lower bound of a stage is reading its bytes once;
the peer computes the same with OpenCV's area averages and torch's operators, the implementation on
a GPU.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
import itertools
import os
from pathlib import Path
from typing import Any

from lower_bounds import Work
import numpy as np
from peaks import read_bandwidth
from results import environment, heading, number_text, Row, seconds_text, table, write
from run import Peer, Run
from timing import timed

SIZES = ((640, 480), (320, 240))
ENCODINGS = {'rgb8': 3, 'bgr8': 3, 'mono8': 1}
IMAGES, BATCH, BATCH_QUICK = 64, 64, 16
JPEG_QUALITY = 90
PEER = 'torch operators'


def make_images(width: int, height: int, count: int = IMAGES) -> list[np.ndarray]:
    """Draw images with structures of every size, RGB uint8, from a seed."""
    import cv2

    rng = np.random.default_rng(0)
    travel = 8 * count
    panorama = np.zeros((height, width + travel, 3), np.float32)
    for octave in range(1, 8):
        coarse = rng.standard_normal((height >> octave, (width + travel) >> octave, 3)).astype(
            np.float32
        )
        size = panorama.shape[1::-1]
        panorama += 2.0**octave / 8 * cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    whole = np.clip(128 + 4 * panorama, 0, 255).astype(np.uint8)
    return [np.ascontiguousarray(whole[:, 8 * i : 8 * i + width]) for i in range(count)]


@contextmanager
def cores(count: int) -> Iterator[None]:
    """Limit torch and OpenCV to so many threads; the feature kernels take as many as torch."""
    import cv2
    import torch

    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def plain(images: Sequence[np.ndarray]) -> Any:
    """Extract features with the operators of OpenCV and torch only."""
    import cv2
    from stavpr_ros.features.extractor import cut_strips, normalize
    from stavpr_ros.features.gradient import feature_maps_by_torch, GradientSettings
    import torch

    s = GradientSettings()
    square = partial(cv2.resize, dsize=(s.size, s.size), interpolation=cv2.INTER_AREA)
    gray = np.stack([square(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images])
    return normalize(cut_strips(feature_maps_by_torch(torch.from_numpy(gray), s), 7))


def encoded(image: np.ndarray, encoding: str) -> np.ndarray:
    """Return the pixels of an image as a camera sends them."""
    if encoding == 'rgb8':
        return image
    return np.ascontiguousarray(image[:, :, ::-1] if encoding == 'bgr8' else image[:, :, 1])


class FeatureBenchmark:
    """The stages for images of one size."""

    def __init__(self, run: Run, width: int, height: int, batch: int) -> None:
        from stavpr_ros.features import FeatureExtractor

        self._run, self._width, self._height, self._batch = run, width, height, batch
        self._images = make_images(width, height)
        self._extractor = FeatureExtractor()
        self._d = self._extractor.extract(self._images[:1]).strips.shape[2]

    def measure(self, threads: int) -> None:
        """Measure every stage on so many cores."""
        with cores(threads):
            self._extract(1, threads)
            self._extract(self._batch, threads)
            for encoding in ENCODINGS:
                self._raw(encoding, threads)
            self._jpeg(threads)

    def _extract(self, n: int, threads: int) -> None:
        batches = [self._images[i : i + n] for i in range(0, len(self._images), n)]
        ours, peers = itertools.cycle(batches), itertools.cycle(batches)
        peer = Peer(PEER, timed(lambda: plain(next(peers))), 'the same features')
        name = 'features' if n == 1 else 'features_batch'
        read = n * self._images[0].nbytes
        self._add(name, n, threads, lambda: self._extractor.extract(next(ours)), read, [peer])

    def _raw(self, encoding: str, threads: int) -> None:
        from stavpr_ros.sources.encodings import decode_image

        messages = itertools.cycle([encoded(image, encoding) for image in self._images])
        height, width, step = self._height, self._width, self._width * ENCODINGS[encoding]

        def call() -> None:
            self._extractor.extract(
                [decode_image(height, width, encoding, False, step, next(messages))]
            )

        self._add(f'features_raw_{encoding}', 1, threads, call, height * step)

    def _jpeg(self, threads: int) -> None:
        import cv2
        from stavpr_ros.sources.encodings import decode_compressed

        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        files = [cv2.imencode('.jpg', image[:, :, ::-1], options)[1] for image in self._images]
        turn = itertools.cycle(files)
        self._add('jpeg_decoding', 1, threads, lambda: decode_compressed(next(turn)), 0)

    def _add(
        self,
        name: str,
        n: int,
        threads: int,
        call: Callable[[], Any],
        read: int,
        peers: Sequence[Peer] = (),
    ) -> None:
        works = [Work(read, 0)] if read else []
        extra = {'image': f'{self._width}x{self._height}', 'threads': threads}
        self._run.measure(name, (n, self._d), call, works, peers, extra=extra)


def report(about: dict[str, Any], rows: Sequence[Row]) -> list[str]:
    """Return the lines of the report."""
    head = ('stage', 'image', 'cores', 'n', 'time per image', 'spread', 'ratio', f'{PEER} / ours')
    lines = [
        [
            row.stage, row.extra['image'], str(row.extra['threads']), str(row.n),
            seconds_text(row.median_s / row.n), seconds_text(row.spread_s / row.n),
            number_text(row.ratio), number_text(row.peers[0].ratio if row.peers else None),
        ]
        for row in rows
    ]  # fmt: skip
    return [*heading('Gradient features', about), *table(head, lines)]


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--quick', action='store_true', help='fewer runs, smaller batches')
    parser.add_argument('--output', type=Path, help='write the results to this JSON file as well')
    arguments = parser.parse_args()
    from lower_bounds import Peaks
    from stavpr_ros.threads import wait_passively

    wait_passively()
    about = environment()
    batch, seconds = (BATCH_QUICK, 0.05) if arguments.quick else (BATCH, 1.0)
    run, threads = Run('cpu', seconds), sorted({1, os.cpu_count() or 1})
    for width, height in SIZES:
        benchmark = FeatureBenchmark(run, width, height, batch)
        for count in threads:
            benchmark.measure(count)
    bandwidth = max(read_bandwidth(256, count, seconds) for count in threads)
    rows, _ = run.finish(Peaks(bandwidth, {'float32': 1.0}))
    lines = report(about, rows)
    print('\n'.join(lines))
    if arguments.output:
        write(arguments.output, about | {'rows': [row.to_json() for row in rows]}, lines)


if __name__ == '__main__':
    main()
