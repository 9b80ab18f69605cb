# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images to the square size of a backbone, and to the batch of numbers of a network."""

from collections.abc import Sequence

import cv2
import numpy as np
from stavpr_ros.features.registry import IMAGENET_MEAN, IMAGENET_STD
import torch


def resize_square(image: np.ndarray, size: int, method: str) -> np.ndarray:
    """
    Resize without keeping the aspect and without cropping.

    :param image: shape (h, w) or (h, w, 3), uint8.
    :param method: ``bilinear``, as for the paper's networks; ``area`` averages where it shrinks,
        so that fine texture does not alias.
    :returns: shape (size, size) or (size, size, 3), uint8.
    """
    shrinks = image.shape[0] >= size and image.shape[1] >= size
    averages = method == 'area' and shrinks
    interpolation = cv2.INTER_AREA if averages else cv2.INTER_LINEAR
    return cv2.resize(image, (size, size), interpolation=interpolation)


class BatchMaker:
    """
    Resizes images and standardizes their channels: ``(scale * value - mean) / std``.

    :param size: side of the square, pixels.
    :param resize: method, see :func:`resize_square`.
    :param mean: of each channel, in the order of the network's input.
    :param std: likewise.
    :param bgr: the network's input is blue, green, red.
    :param dtype: of the batch, float32 or float16.
    """

    def __init__(
        self,
        size: int,
        resize: str,
        device: torch.device,
        dtype: torch.dtype = torch.float32,
        scale: float = 1 / 255,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        bgr: bool = False,
    ) -> None:
        self._size, self._resize, self._bgr = size, resize, bgr
        self._device, self._dtype = device, dtype
        deviation = torch.tensor(std, dtype=torch.float64)
        factor, shift = scale / deviation, -torch.tensor(mean, dtype=torch.float64) / deviation
        self._factor = factor.float().view(3, 1, 1).to(device)
        self._shift = shift.float().view(3, 1, 1).to(device)

    def __call__(self, images: Sequence[np.ndarray]) -> torch.Tensor:
        """
        Make a batch.

        :param images: RGB, each (h, w, 3) uint8, of any size.
        :returns: shape (n, 3, size, size), channels last in memory.
        """
        squares = np.stack([resize_square(image, self._size, self._resize) for image in images])
        # one byte a value is copied to the device
        pixels = torch.from_numpy(squares).to(self._device).permute(0, 3, 1, 2)
        if self._bgr:
            pixels = pixels.flip(1)
        return torch.addcmul(self._shift, pixels.float(), self._factor).to(self._dtype)
