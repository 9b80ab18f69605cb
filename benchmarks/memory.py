# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Resident memory of the pipeline over the bytes of its features, in a process of its own.

The process builds the pipeline as the node does, with a map from a file or with a route of images,
and processes images. It runs a tiny pipeline first, so that compiled kernels, thread pools and
libraries are resident before. The resident set is read after garbage collection and malloc_trim,
both times.
"""

from concurrent.futures import ProcessPoolExecutor
import ctypes
from dataclasses import dataclass
import gc
from multiprocessing import get_context
import os
from pathlib import Path
import sys
import tempfile
from types import SimpleNamespace
from typing import ClassVar, TYPE_CHECKING
from unittest.mock import patch

import numpy as np

if TYPE_CHECKING:
    from stavpr_ros.features.registry import Kind
    from stavpr_ros.pipeline import Pipeline

TARGET = 1.1
STRIPS = 7
SMALL = 100  # places of the tiny pipeline
# places and dimensions: 90 MB of features or more, so that everything else is small beside them
SIZES = {'localization': (20_000, 512), 'loop_closure': (800, 4_096)}
CASES = (
    ('localization', 'robust', 'float32'),
    ('localization', 'robust', 'int8'),
    ('loop_closure', 'robust', 'float32'),
)
IMAGES = 30  # processed in localization: a full window and more


@dataclass(frozen=True)
class Memory:
    """
    One measurement.

    :param feature_bytes: bytes of n places in their precision.
    :param resident_bytes: growth of the resident set.
    """

    operation: str
    mode: str
    precision: str
    n: int
    d: int
    feature_bytes: int
    resident_bytes: int

    @property
    def ratio(self) -> float:
        """Resident bytes over the bytes of the features."""
        return self.resident_bytes / self.feature_bytes


@dataclass(frozen=True)
class SyntheticSettings:
    """Settings of the synthetic features."""

    resize: ClassVar[str] = 'bilinear'
    d: int


class Synthetic:
    """Features drawn at random for each image; a kind of features for the package's registry."""

    Settings = SyntheticSettings

    def __init__(self, settings: SyntheticSettings, device: str) -> None:
        self.settings = settings

    def feature_maps(self, images: list[np.ndarray]) -> 'np.ndarray':
        """Return Gaussian feature maps, shape (n, d, 1, W), seeded by the image's first bytes."""
        generators = [
            np.random.default_rng(int.from_bytes(i.tobytes()[:8], 'little')) for i in images
        ]
        maps = [g.standard_normal((self.settings.d, 1, STRIPS), np.float32) for g in generators]
        return np.stack(maps)


def measure_memory(operation: str, mode: str, precision: str, n: int = 0, d: int = 0) -> Memory:
    """
    Measure one case in a process of its own.

    :param operation: ``localization`` or ``loop_closure``.
    :param n, d: places and dimensions; 0 = as in ``SIZES``.
    """
    from lower_bounds import ITEM_BYTES

    n, d = n or SIZES[operation][0], d or SIZES[operation][1]
    # one thread: thousands of short calls beside other load, and the bytes are the same
    threads = patch.dict(os.environ, OMP_NUM_THREADS='1', NUMBA_NUM_THREADS='1')
    with (
        tempfile.TemporaryDirectory() as name,
        threads,
        ProcessPoolExecutor(1, get_context('spawn')) as pool,
    ):
        folder = Path(name)
        if operation == 'localization':
            for places in (SMALL, n):
                _save_map(folder / f'{places}.stavpr', places, d)
        growth = pool.submit(_growth, operation, mode, precision, n, d, folder).result()
    size = n * d * STRIPS * ITEM_BYTES[precision]
    return Memory(operation, mode, precision, n, d, size, growth)


def _kind() -> 'Kind':
    from stavpr_ros.features.registry import Kind

    return Kind(SyntheticSettings, f'{__name__}:Synthetic')


def _save_map(path: Path, n: int, d: int) -> None:
    """Write a map of synthetic places."""
    from dataclasses import replace

    from data import make_features
    from stavpr_ros.features import FeatureSettings
    from stavpr_ros.mapping import descriptor_map, save_map

    features = make_features(n, d, STRIPS, seed=0)
    features = replace(
        features, settings=FeatureSettings('synthetic', SyntheticSettings(d)), cells=(1, 1)
    )
    with patch.dict('stavpr_ros.features.registry.KINDS', synthetic=_kind()):
        save_map(descriptor_map(features), path)


def resident_bytes() -> int:
    """Return the resident set of this process after everything that can be freed is freed."""
    gc.collect()
    if sys.platform == 'linux':
        ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE')


def run_pipeline(
    operation: str, mode: str, precision: str, n: int, d: int, folder: Path
) -> 'Pipeline':
    """Return a pipeline of n places that has processed images."""
    from stavpr_ros.pipeline import Pipeline, PipelineSettings, read_map

    settings = PipelineSettings(
        threshold=0.5 if mode == 'paper' else None, mode=mode, backend='cpu',
        precision=precision, features='synthetic',
        feature_settings=f'{{"d": {d}}}', max_places=max(n, 1000), thumbnail_width=0,
    )  # fmt: skip
    pipeline = Pipeline(settings, operation)
    if operation == 'localization':
        pipeline.change(loaded=read_map(str(folder / f'{n}.stavpr'), settings))
    for i in range(n if operation == 'loop_closure' else IMAGES):
        pixels = np.frombuffer(i.to_bytes(8, 'little') * 24, np.uint8)
        message = SimpleNamespace(
            height=8, width=8, encoding='rgb8', is_bigendian=False, step=24, data=pixels
        )
        pipeline.operation.process(message, (i + 1) * 10**9)
    return pipeline


def _growth(operation: str, mode: str, precision: str, n: int, d: int, folder: Path) -> int:
    """Return by how many bytes the resident set of this process grows with a pipeline."""
    from stavpr_ros.features import registry
    from stavpr_ros.threads import wait_passively

    wait_passively()
    registry.KINDS['synthetic'] = _kind()
    run_pipeline(operation, mode, precision, SMALL, d, folder)
    before = resident_bytes()
    pipeline = run_pipeline(operation, mode, precision, n, d, folder)
    after = resident_bytes()
    assert pipeline.places is not None
    assert len(pipeline.places) == n
    return after - before
