# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Damaged files for every reader: read, or rejected by our own error.

Each within a second, and within ``ROOM`` and three times its size in memory. It is run as a
process of its own, since decoders may end it: ``python3 reader_fuzz.py FILES SEED [READER ...]``,
with test/shared on PYTHONPATH.
"""

from collections.abc import Callable, Iterator
import json
from pathlib import Path
import random
import resource
import shutil
import sys
import tempfile
import time

from bags import write_odometry
import cv2
from map_examples import example_files
from map_fuzz import hand_made, mutate, use_file
import numpy as np
from stavpr_lab.evaluation.ground_truth import GroundTruth
from stavpr_ros.errors import StavprError
from stavpr_ros.features.registry import settings_class
from stavpr_ros.sources.bag import BagSource, read_odometry
from stavpr_ros.sources.folder import FolderSource
from stavpr_ros.sources.frame import ImageRecord
from stavpr_ros.sources.pose_file import read_poses
from stavpr_slam.colmap import read_closures

ROOM = 64 * 2**20  # bytes
SECONDS = 1.0  # processor time of one file
SECOND = 10**9


def _truth(path: Path) -> None:
    GroundTruth.from_file(path, 20, 30)


def _images(path: Path) -> None:
    for _ in FolderSource(path.parent):
        pass


def _bag(path: Path) -> None:
    for _ in BagSource(path, '/image', on_error=lambda error: None):
        pass


def _odometry(path: Path) -> None:
    read_odometry(path, '/odom')


def _onnx(path: Path) -> None:
    from stavpr_ros.features.onnx import Onnx

    settings = settings_class('onnx')(model=str(path), layer='relu', size=32)
    Onnx(settings).feature_maps([np.zeros((32, 32, 3), np.uint8)])


READERS: dict[str, Callable[[Path], object]] = {
    'truth': _truth,
    'poses': read_poses,
    'closures': lambda path: read_closures(str(path)),
    'images': _images,
    'bag': _bag,
    'odometry': _odometry,
    'onnx': _onnx,
    'map': use_file,
    'hand-made map': use_file,
}


def originals(reader: str, folder: Path) -> Iterator[Path]:
    """Yield valid files of a reader."""
    if reader == 'truth':
        pairs = np.stack([np.arange(20), np.arange(20) + 3], axis=1)
        np.savetxt(folder / 'truth.csv', pairs, '%d', ',', header='query,place', comments='')
        np.save(folder / 'truth.npy', pairs)
        np.savez_compressed(folder / 'truth.npz', truth=pairs)
        cv2.imwrite(str(folder / 'truth.png'), np.eye(20, 30, dtype=np.uint8) * 255)
    elif reader == 'poses':
        poses = np.eye(20, 7) * [1, 1, 1, 0, 0, 0, 0] + [0, 0, 0, 0, 0, 0, 1]
        np.savetxt(folder / 'poses.csv', poses, delimiter=',')
    elif reader == 'closures':
        rows = [json.dumps({'query_stamp': i, 'place_stamp': i + 9}) for i in range(20)]
        (folder / 'closures.jsonl').write_text('\n'.join(rows))
    elif reader == 'images':
        noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
        for suffix in ('png', 'jpg', 'bmp', 'webp', 'tiff', 'ppm'):
            cv2.imwrite(str(folder / f'image.{suffix}'), noise)
    elif reader in ('bag', 'odometry'):
        stamps = [(i + 1) * SECOND for i in range(20)]
        write_odometry(folder / 'odometry.bag', stamps, ros1=True, images=images_of(stamps))
        made = write_odometry(folder / 'made', stamps, images=images_of(stamps))
        shutil.move(next(made.glob('*.db3')), folder / 'odometry.db3')
    elif 'map' in reader:
        example_files(folder)
    else:
        onnx_model(folder / 'network.onnx')
    yield from sorted(path for path in folder.iterdir() if path.is_file())


def images_of(stamps: list[int]) -> list:
    """Return small raw images for a bag."""
    return [ImageRecord.of_image(np.zeros((8, 8, 3), np.uint8), stamp) for stamp in stamps]


def onnx_model(path: Path) -> None:
    """Write a network of one convolution and a ReLU."""
    import onnx
    from onnx import helper, numpy_helper

    weights = np.random.default_rng(0).normal(size=(4, 3, 3, 3)).astype(np.float32)
    nodes = [
        helper.make_node('Conv', ['image', 'weights'], ['conv'], strides=[4, 4]),
        helper.make_node('Relu', ['conv'], ['relu']),
    ]
    image = helper.make_tensor_value_info('image', 1, ['batch', 3, 32, 32])
    output = helper.make_tensor_value_info('relu', 1, ['batch', 4, 8, 8])
    initializer = [numpy_helper.from_array(weights, 'weights')]
    graph = helper.make_graph(nodes, 'network', [image], [output], initializer)
    opset = [helper.make_opsetid('', 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=9), path)


def attack(reader: str, files: int, seed: int) -> None:
    """Read many damaged files; the first that fails is kept in the working directory."""
    rng, read = random.Random(seed), READERS[reader]
    change = hand_made if reader == 'hand-made map' else mutate
    with tempfile.TemporaryDirectory() as temporary:
        made, tried = Path(temporary, 'made'), Path(temporary, 'tried')
        made.mkdir()
        tried.mkdir()
        contents = [(path.suffix, path.read_bytes()) for path in originals(reader, made)]
        for suffix, content in contents:  # imports and allocates all; valid files are read
            path = tried / f'file{suffix}'
            path.write_bytes(content)
            read(path)
            path.unlink()
        before = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
        refused, slowest = 0, 0.0
        for i in range(files):
            suffix, content = contents[i % len(contents)]
            path = tried / f'file{suffix}'
            path.write_bytes(change(content, rng))
            limit = before + ROOM + 3 * path.stat().st_size
            resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
            began = time.process_time()
            try:
                read(path)
            except StavprError:
                refused += 1
            except BaseException:
                shutil.copy(path, f'{reader}-{seed}-{i}{suffix}')
                raise
            slowest = max(slowest, time.process_time() - began)
            if slowest > SECONDS:
                shutil.copy(path, f'{reader}-{seed}-{i}{suffix}')
                raise TimeoutError(f'file {i} of {reader} took {slowest:.1f} s')
            path.unlink()
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    print(f'{reader}: {files} files, {refused} refused, slowest {slowest:.3f} s', flush=True)


if __name__ == '__main__':
    for reader in sys.argv[3:] or READERS:
        attack(reader, int(sys.argv[1]), int(sys.argv[2]))
