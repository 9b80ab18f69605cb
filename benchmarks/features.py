"""
Gradient features: one frame on one core and on all, batches, every raw encoding; JPEG decoding apart.

``python benchmarks/features.py --output FILE``. The frames are made up and come in turn from more memory
than a cache holds, as a camera's do. The floor of a stage is reading its bytes once; the peer does the same
with OpenCV's area averages and torch's operators, which is what the features were before they had a kernel,
and what they still are on a GPU.
"""

import argparse
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from ceilings import read_bandwidth
from records import Record, machine, save, with_machine
from timing import Timing, measure, timed

SIZES = ((640, 480), (320, 240))
ENCODINGS = {'rgb8': 3, 'bgr8': 3, 'mono8': 1}
FRAMES, BATCH, BATCH_QUICK = 64, 64, 16
JPEG_QUALITY = 90
PEER = 'torch operators'
HEADER = ('stage', 'picture', 'cores', 'n', 'ms a frame', '+-', 'x floor', f'speed-up on {PEER}')


def make_frames(width: int, height: int, count: int = FRAMES) -> list[np.ndarray]:
    """Draw frames of structures of every size, RGB uint8, from a seed."""
    import cv2

    rng = np.random.default_rng(0)
    travel = 8 * count
    picture = np.zeros((height, width + travel, 3), np.float32)
    for octave in range(1, 8):
        coarse = rng.standard_normal((height >> octave, (width + travel) >> octave, 3)).astype(np.float32)
        picture += 2.0**octave / 8 * cv2.resize(coarse, picture.shape[1::-1], interpolation=cv2.INTER_CUBIC)
    whole = np.clip(128 + 4 * picture, 0, 255).astype(np.uint8)
    return [np.ascontiguousarray(whole[:, 8 * i : 8 * i + width]) for i in range(count)]


@contextmanager
def cores(count: int) -> Iterator[None]:
    """Let torch and OpenCV use so many threads; the features' kernels take as many as torch."""
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
    """Describe images with OpenCV's and torch's operators only."""
    import cv2
    import torch

    from stavpr_ros.features.gradient import GradientSettings, feature_maps_by_torch
    from stavpr_ros.features.extractor import cut_strips, normalize

    s = GradientSettings()
    square = partial(cv2.resize, dsize=(s.size, s.size), interpolation=cv2.INTER_AREA)
    gray = np.stack([square(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images])
    return normalize(cut_strips(feature_maps_by_torch(torch.from_numpy(gray), s), 7))


def raw_messages(frames: Sequence[np.ndarray], encoding: str) -> list[np.ndarray]:
    """Return the frames' bytes as a camera sends them."""
    if encoding == 'rgb8':
        return list(frames)
    return [np.ascontiguousarray(f[:, :, ::-1] if encoding == 'bgr8' else f[:, :, 1]) for f in frames]


class FeatureBenchmark:
    """
    The stages for frames of one size.

    :param seconds: how long to run each.
    """

    def __init__(self, width: int, height: int, batch: int, seconds: float) -> None:
        from stavpr_ros.features import FeatureExtractor

        self.width, self.height = width, height
        self.batch, self.seconds = batch, seconds
        self.frames = make_frames(width, height)
        self.extractor = FeatureExtractor()
        self.dim = self.extractor.extract(self.frames[:1]).strips.shape[2]
        self.bandwidth = max(read_bandwidth(256, n, seconds) for n in {1, os.cpu_count() or 1})

    def stages(self, threads: int) -> Iterator[Record]:
        """Measure everything on so many cores."""
        with cores(threads):
            yield self._described(1, threads)
            yield self._described(self.batch, threads)
            for encoding in ENCODINGS:
                yield self._raw(encoding, threads)
            yield self._jpeg(threads)

    def _described(self, n: int, threads: int) -> Record:
        batches = [self.frames[i : i + n] for i in range(0, len(self.frames), n)]
        ours, peers = itertools.cycle(batches), itertools.cycle(batches)
        calls = {'ours': lambda: self.extractor.extract(next(ours)), PEER: lambda: plain(next(peers))}
        took = measure({name: timed(call) for name, call in calls.items()}, self.seconds)
        read = n * self.frames[0].nbytes
        return self._record('features' if n == 1 else 'features_batch', n, threads, took, read)

    def _raw(self, encoding: str, threads: int) -> Record:
        from stavpr_ros.sources.encodings import decode_image

        messages = itertools.cycle(raw_messages(self.frames, encoding))
        step = self.width * ENCODINGS[encoding]

        def call() -> None:
            data = next(messages)
            self.extractor.extract([decode_image(self.height, self.width, encoding, False, step, data)])

        return self._record(f'features_raw_{encoding}', 1, threads, self._alone(call), self.height * step)

    def _jpeg(self, threads: int) -> Record:
        import cv2

        from stavpr_ros.sources.files import decode_compressed

        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        files = [cv2.imencode('.jpg', frame[:, :, ::-1], options)[1] for frame in self.frames]
        turn = itertools.cycle(files)
        took = self._alone(lambda: decode_compressed(next(turn)))
        return self._record('jpeg_decoding', 1, threads, took, dim=0)

    def _alone(self, call: Callable[[], Any]) -> dict[str, Timing]:
        return measure({'ours': timed(call)}, self.seconds)

    def _record(
        self, name: str, n: int, threads: int, took: dict[str, Timing], read: int = 0, dim: int | None = None
    ) -> Record:
        ours, peer = took['ours'], took.get(PEER)
        return Record(
            name,
            n,
            self.dim if dim is None else dim,
            'float32' if dim is None else 'uint8',
            'cpu',
            ours.median_s,
            ours.spread_s,
            ours.runs,
            floor_s=read / self.bandwidth if read else None,
            peer=PEER if peer else None,
            peer_median_s=peer.median_s if peer else None,
            peer_spread_s=peer.spread_s if peer else None,
            extra={'picture': f'{self.width}x{self.height}', 'threads': threads},
        )


def row(record: Record) -> tuple[str, ...]:
    """Return a record as a row of the table."""
    assert record.median_s is not None
    assert record.spread_s is not None
    extra, per_frame = record.extra, 1e3 / record.n
    return (
        record.name,
        extra['picture'],
        str(extra['threads']),
        str(record.n),
        f'{record.median_s * per_frame:.3f}',
        f'{record.spread_s * per_frame:.3f}',
        f'{record.ratio_to_floor:.1f}' if record.ratio_to_floor else '',
        f'{record.speedup:.1f}' if record.speedup else '',
    )


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--quick', action='store_true', help='fewer runs, smaller batches')
    parser.add_argument('--output', type=Path, help='write the records to this JSON file as well')
    arguments = parser.parse_args()
    from stavpr_ros.threads import wait_passively

    wait_passively()
    batch, seconds = (BATCH_QUICK, 0.05) if arguments.quick else (BATCH, 1.0)
    records, layout = [], '{:20} {:8} {:>5} {:>3} {:>10} {:>6} {:>7} {:>27}'
    print(layout.format(*HEADER))
    for width, height in SIZES:
        benchmark = FeatureBenchmark(width, height, batch, seconds)
        for threads in sorted({1, os.cpu_count() or 1}):
            for record in benchmark.stages(threads):
                records.append(record)
                print(layout.format(*row(record)), flush=True)
    if arguments.output:
        save(with_machine(records, machine('cpu')), arguments.output)


if __name__ == '__main__':
    main()
