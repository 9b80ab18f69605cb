"""
Oriented-gradient features: no weights, no training, the default.

Histograms of gradient orientation on a regular grid of overlapping cells, each normalised by the four
2 x 2 blocks it lies in (after Dalal and Triggs, "Histograms of Oriented Gradients for Human Detection",
CVPR 2005; one channel an orientation, the mean over the four normalisations).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.nn.functional import avg_pool2d, pad

from stavpr_ros.errors import SettingsError
from stavpr_ros.features.backbone import setting
from stavpr_ros.features.resize import check_method, resize_square


@dataclass(frozen=True)
class GradientSettings:
    """Settings of the oriented-gradient features."""

    size: int = setting(224, help='images are resized to size x size pixels first')
    resize: str = setting('area', help='how images are resized: bilinear, or area (averages, no aliasing)')
    cell: int = setting(16, help='side of a cell in pixels; size must be a multiple of it')
    orientations: int = setting(8, help='number of orientation bins')
    signed: bool = setting(True, help='tell dark-to-bright from bright-to-dark')

    def __post_init__(self) -> None:
        check_method(self.resize)
        if self.cell < 2 or self.size < 2 * self.cell or self.size % self.cell:
            raise SettingsError(
                f'size {self.size} and cell {self.cell}: size must be a multiple of cell, at least twice it'
            )
        if self.orientations < 2:
            raise SettingsError(f'orientations = {self.orientations} must be at least 2')


class Gradient:
    """Feature maps of ``orientations`` channels, (size / cell) x (size / cell)."""

    Settings = GradientSettings
    FLOOR = 1e-4  # squared gradient (intensities 0..1) below which a block counts as flat

    def __init__(self, settings: GradientSettings, device: str = 'cpu') -> None:
        self.settings = settings
        self._device = torch.device(device)
        bins = torch.arange(settings.orientations, dtype=torch.float32, device=self._device)
        self._bins = bins[None, :, None, None]

    def feature_maps(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Describe a batch of images.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: shape (n, orientations, size / cell, size / cell), float32, values >= 0.
        """
        grey = torch.from_numpy(np.stack([self._prepare(image) for image in images]))
        return self._normalise(self._histograms(grey.to(self._device)))

    def _prepare(self, image: np.ndarray) -> np.ndarray:
        return resize_square(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), self.settings.size, self.settings.resize
        )

    def _histograms(self, grey: torch.Tensor) -> torch.Tensor:
        """Pool the gradients by orientation over cells that overlap by half, (n, bins, cells, cells)."""
        padded = pad(grey[:, None].float() / 255, (1, 1, 1, 1), mode='replicate')
        dx = padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2]
        dy = padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1]
        period = 2 * math.pi if self.settings.signed else math.pi
        bins = self.settings.orientations
        position = (torch.atan2(dy, dx) * (bins / period)).remainder_(bins)
        offset = (position - self._bins).abs_()
        share = torch.clamp_(1 - torch.minimum(offset, bins - offset), min=0)  # linear between two bins
        cell = self.settings.cell
        return avg_pool2d(share.mul_(torch.hypot(dx, dy)), 2 * cell, stride=cell, padding=cell // 2)

    def _normalise(self, histograms: torch.Tensor) -> torch.Tensor:
        """Multiply each cell by the mean of 1 / norm over the four 2 x 2 blocks that it is part of."""
        energy = pad((histograms**2).sum(dim=1, keepdim=True), (1, 1, 1, 1), mode='replicate')
        scale = torch.rsqrt(4 * avg_pool2d(energy, 2, stride=1) + self.FLOOR)
        return histograms * avg_pool2d(scale, 2, stride=1)
