"""Images to the batch of numbers that a network takes."""

from collections.abc import Sequence

import numpy as np
import torch

from stavpr_ros.features.preprocessing import resize_square

IMAGENET_MEAN = (0.485, 0.456, 0.406)  # of R, G, B in 0..1, which torchvision's networks are trained with
IMAGENET_STD = (0.229, 0.224, 0.225)


class BatchMaker:
    """
    Resizes images and standardizes their channels: ``(scale * value - mean) / std``.

    :param size: side of the square, pixels.
    :param resize: method, see :func:`resize_square`.
    :param mean: of each channel, in the order that the network takes them.
    :param std: likewise.
    :param bgr: the network takes blue first.
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
        pixels = torch.from_numpy(squares).to(self._device).permute(0, 3, 1, 2)  # a byte a value to copy
        if self._bgr:
            pixels = pixels.flip(1)
        return torch.addcmul(self._shift, pixels.float(), self._factor).to(self._dtype)
