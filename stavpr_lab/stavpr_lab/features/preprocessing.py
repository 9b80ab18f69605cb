# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images to the batch of numbers of a network."""

from collections.abc import Sequence

import numpy as np
from stavpr_ros.features.extractor import resize_square
from stavpr_ros.features.registry import IMAGENET_MEAN, IMAGENET_STD
from stavpr_ros.threads import thread_limit
import torch


class BatchMaker:
    """
    Resizes images and standardizes their channels: ``(scale * value - mean) / std``.

    :param size: side of the square, pixels.
    :param resize: method, see :func:`stavpr_ros.features.extractor.resize_square`.
    :param mean, std: mean and deviation of each channel, in the order of the network's input.
    :param dtype: type of the batch, float32 or float16.
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
    ) -> None:
        self._size, self._resize = size, resize
        self._device, self._dtype = device, dtype
        if limit := thread_limit():
            torch.set_num_threads(limit)
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
        return torch.addcmul(self._shift, pixels.float(), self._factor).to(self._dtype)
