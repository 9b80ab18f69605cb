# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Oriented-gradient features: no weights, no training, the default.

Histograms of gradient orientation on a regular grid of overlapping cells, each normalized by the
four 2 x 2 blocks around it (after Dalal and Triggs, "Histograms of Oriented Gradients for Human
Detection", CVPR 2005; one channel an orientation, the mean over the four normalizations). On a CPU
a compiled kernel computes them image by image, elsewhere torch for the whole batch.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
import math

import cv2
import numpy as np
from stavpr_ros.features.gradient_kernel import gradient_maps
from stavpr_ros.features.preprocessing import resize_square
from stavpr_ros.features.registry import GradientSettings
import torch
from torch.nn.functional import avg_pool2d, pad

FLOOR = 1e-4  # squared gradient (intensities 0..1) below which a block counts as flat
PER_THREAD = 8  # images at least: starting a thread costs as much as one or two images


class Gradient:
    """Feature maps of ``orientations`` channels, ``cells`` x ``cells``."""

    def __init__(self, settings: GradientSettings, device: str = 'cpu') -> None:
        self.settings = settings
        self._device = torch.device(device)

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Compute the feature maps of a batch of images, on a CPU on as many threads as torch's.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: shape (n, orientations, cells, cells), float32, values >= 0.
        """
        if self._device.type != 'cpu':
            return self._by_torch(images)
        s = self.settings
        maps = np.empty((len(images), s.orientations, s.cells, s.cells), np.float32)

        def extract(i: int) -> None:
            gradient_maps(self._prepare(images[i]), s.cell, s.signed, FLOOR, maps[i])

        _on_threads(extract, len(images))
        return torch.from_numpy(maps)

    def _by_torch(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        gray = np.empty((len(images), self.settings.size, self.settings.size), np.uint8)

        def prepare(i: int) -> None:
            gray[i] = self._prepare(images[i])

        _on_threads(prepare, len(images))
        return feature_maps_by_torch(torch.from_numpy(gray).to(self._device), self.settings)

    def _prepare(self, image: np.ndarray) -> np.ndarray:
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return resize_square(gray, self.settings.size, self.settings.resize)


def _on_threads(work: Callable[[int], None], count: int) -> None:
    """Call work(0) .. work(count - 1), which rarely holds the GIL, on as many threads as torch."""
    threads = min(torch.get_num_threads(), count // PER_THREAD)
    if threads < 2:
        for i in range(count):
            work(i)
        return

    def part(first: int) -> None:
        for i in range(first, count, threads):
            work(i)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(part, range(threads)))  # the list re-raises errors of the threads


def feature_maps_by_torch(gray: torch.Tensor, settings: GradientSettings) -> torch.Tensor:
    """
    Compute the feature maps of square images with torch's operators, on their device.

    :param gray: shape (n, size, size), uint8.
    :returns: shape (n, orientations, cells, cells), float32.
    """
    return _normalize(_histograms(gray, settings))


def _histograms(gray: torch.Tensor, settings: GradientSettings) -> torch.Tensor:
    """Pool the gradients over cells that overlap by half, (n, bins, cells, cells)."""
    padded = pad(gray[:, None].float() / 255, (1, 1, 1, 1), mode='replicate')
    dx = padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2]
    dy = padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1]
    period = 2 * math.pi if settings.signed else math.pi
    bins = settings.orientations
    position = (torch.atan2(dy, dx) * (bins / period)).remainder_(bins)
    centers = torch.arange(bins, dtype=torch.float32, device=gray.device)
    offset = (position - centers[None, :, None, None]).abs_()
    share = torch.clamp_(
        1 - torch.minimum(offset, bins - offset), min=0
    )  # linear between two bins
    cell = settings.cell
    return avg_pool2d(share.mul_(torch.hypot(dx, dy)), 2 * cell, stride=cell, padding=cell // 2)


def _normalize(histograms: torch.Tensor) -> torch.Tensor:
    """Multiply each cell by the mean of 1 / norm over the four 2 x 2 blocks around it."""
    energy = pad((histograms**2).sum(dim=1, keepdim=True), (1, 1, 1, 1), mode='replicate')
    scale = torch.rsqrt(4 * avg_pool2d(energy, 2, stride=1) + FLOOR)
    return histograms * avg_pool2d(scale, 2, stride=1)
