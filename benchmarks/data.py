# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Data of the benchmarks: the folder of data sets, and synthetic maps, queries and windows."""

import os
from pathlib import Path
import sys

import numpy as np
from stavpr_ros.features import FeatureSettings, LocalFeatures
import torch

SETTINGS = FeatureSettings('synthetic', None)
BLOCK_BYTES = 2**28


def data_folder() -> Path:
    """Return the folder of the data sets: ``STAVPR_DATA``, or ``data`` in the checkout."""
    folder = Path(os.environ.get('STAVPR_DATA') or Path(__file__).resolve().parents[1] / 'data')
    if not folder.is_dir():
        sys.exit(f'no data folder {folder}: set STAVPR_DATA to the folder of the data sets')
    return folder


def make_features(n: int, d: int, W: int, device: str, seed: int) -> LocalFeatures:
    """
    Draw unit-norm Gaussian local features on a device, in blocks.

    :returns: strips (W, n, d) float32, all of equal weight.
    """
    generator = torch.Generator(device).manual_seed(seed)
    strips = torch.empty(W, n, d, device=device)
    rows = strips.view(W * n, d)
    for block in rows.split(max(1, BLOCK_BYTES // (4 * d))):
        block.normal_(generator=generator)
        block.div_(torch.linalg.vector_norm(block, dim=1, keepdim=True))
    weights = torch.full((W, n), W**-0.5, device=device)
    return LocalFeatures(strips, weights, SETTINGS)


def make_window(l: int, n: int, seed: int) -> np.ndarray:
    """Draw a window of image distances, shape (l, n), float32; times depend on the shape only."""
    return np.random.default_rng(seed).uniform(0.3, 1.0, (l, n)).astype(np.float32)


def free_bytes(device: str) -> int:
    """Return the free memory of a device."""
    if device == 'cuda':
        return int(torch.cuda.mem_get_info()[0])
    with open('/proc/meminfo', encoding='ascii') as lines:
        found = dict(line.split(':') for line in lines)
    return int(found['MemAvailable'].split()[0]) * 1024
