# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Data of the benchmarks: the folder of data sets, and synthetic maps, queries and windows."""

from dataclasses import replace
import os
from pathlib import Path
import sys

import numpy as np
from stavpr_ros.features import FeatureSettings, LocalFeatures
from stavpr_ros.memory import aligned_empty
from stavpr_ros.prepare.centering import normalize

GRADIENT = 224  # dimensions of features whose cells are compared


def data_folder() -> Path:
    """Return the folder of the data sets: ``STAVPR_DATA``, or ``data`` in the checkout."""
    folder = Path(os.environ.get('STAVPR_DATA') or Path(__file__).resolve().parents[1] / 'data')
    if not folder.is_dir():
        sys.exit(f'no data folder {folder}: set STAVPR_DATA to the folder of the data sets')
    return folder


def make_features(n: int, d: int, W: int, seed: int) -> LocalFeatures:
    """
    Draw unit-norm Gaussian local features.

    :returns: strips (W, n, d) float32, all of equal weight.
    """
    strips, rng = aligned_empty((W, n, d)), np.random.default_rng(seed)
    for strip in strips:
        rng.standard_normal(out=strip, dtype=np.float32)
        normalize(strip)
    settings = FeatureSettings('gradient' if d == GRADIENT else 'synthetic', None)
    return LocalFeatures(strips, np.full((W, n), W**-0.5, np.float32), settings)


def along(places: LocalFeatures, images: int) -> LocalFeatures:
    """Return the features of a drive: the first places, and as much noise."""
    strips = places.strips[:, :images].copy()
    rng, d = np.random.default_rng(0), places.dimension
    strips += rng.standard_normal(strips.shape, np.float32) * np.float32(d**-0.5)
    normalize(strips)
    return replace(places, strips=strips, weights=places.weights[:, :images])


def make_window(l: int, n: int) -> np.ndarray:
    """Draw a window of image distances, shape (l, n), float32; times depend on the shape only."""
    return np.random.default_rng(0).uniform(0.3, 1.0, (l, n)).astype(np.float32)


def free_bytes() -> int:
    """Return the free memory."""
    with open('/proc/meminfo', encoding='ascii') as lines:
        sizes = dict(line.split(':') for line in lines)
    return int(sizes['MemAvailable'].split()[0]) * 1024
