# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the kernel chose, in one small buffer: written on the device, copied to the host once."""

from typing import Any, NamedTuple

import numpy as np
from stavpr_ros.alignment.cuda.compilation import Runtime
import torch

WORDS = 6  # four places and two distances, in front of the window's cells


class Selection(NamedTuple):
    """
    The nearest start and its second best.

    :param start, length: the nearest start s and its m; -1 and undefined where no path is finite.
    :param second_best_start, second_best_length: the same of the second best; -1 for none.
    :param distance, second_best_distance: q_m of both.
    :param cells: the cells of the nearest start, shape (l, k), float32, +inf past the
        map's end; valid until the next fetch.
    """

    start: int
    length: int
    second_best_start: int
    second_best_length: int
    distance: float
    second_best_distance: float
    cells: np.ndarray


class SelectionBuffer:
    """
    The buffer on the device, its twin on the host, and views of both.

    :param runtime: what kernels run on.
    :param l, k: rows of the window, columns that one start searches.
    """

    def __init__(self, runtime: Runtime, l: int, k: int) -> None:
        size = 4 * (WORDS + l * k)
        self._runtime, self._shape = runtime, (l, k)
        self._device = torch.zeros(size, dtype=torch.uint8, device=runtime.torch_device)
        self._host = runtime.host_buffer(size)
        places, answer = self._device[:16].view(torch.int32), self._device[16:].view(torch.float32)
        self.arguments: tuple[Any, Any] = (runtime.array(places), runtime.array(answer))
        self._places = self._host[:16].view(torch.int32).numpy()
        self._answer = self._host[16:].view(torch.float32).numpy()

    def fetch(self) -> Selection:
        """Copy the answer to the host and wait for it."""
        self._runtime.fetch(self._device, self._host)
        cells = self._answer[2:].reshape(self._shape)
        return Selection._make([*self._places.tolist(), *self._answer[:2].tolist(), cells])
