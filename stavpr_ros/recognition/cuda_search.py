# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""LM-DTW on a CUDA device: the window lies there, one small result a match is copied back."""

from typing import Any

from stavpr_ros.alignment.cuda.compilation import runtime
from stavpr_ros.alignment.lm_dtw import SequenceDistances, SequenceMatch
from stavpr_ros.alignment.path import trace_sequence
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.recognition.sequence_search import SequenceBuffer, WindowMatch
from stavpr_ros.recognition.sessions import Sequences
import torch


class CudaLmDtwSearch:
    """
    LM-DTW over a buffer on torch's current CUDA device; only a search waits for the device.

    :param places: number of places n of the map.
    :param settings: l and k.
    :raises UnavailableError: no CUDA device here, or the package numba-cuda is missing.
    """

    def __init__(self, places: int, settings: SequenceSettings) -> None:
        from stavpr_ros.alignment.cuda import lm_dtw, selection

        self._runtime = runtime()
        device, block = self._runtime.torch_device, lm_dtw.BLOCK
        self.buffer = SequenceBuffer(
            settings.length, places, settings.k, lambda n, k: lm_dtw.row_pitch(n, k, block), device
        )
        l, k = self.buffer.length, settings.k
        blocks = -(-places // block)
        self._kernel, self._grid, self._block = lm_dtw.lm_dtw(l, k, block), (blocks, 1), block

        def array(count: int, dtype: torch.dtype) -> Any:
            return self._runtime.array(torch.zeros(max(1, count), dtype=dtype, device=device))

        self._rows = self._runtime.array(self.buffer.memory)
        self._distances = torch.full((max(1, places),), torch.inf, device=device)
        self._lengths = torch.zeros(max(1, places), dtype=torch.int32, device=device)
        self._scratch = (
            self._runtime.array(self._distances),
            self._runtime.array(self._lengths),
            array(blocks, torch.float32),
            array(blocks, torch.int32),
            array(1, torch.int32),
        )
        self._selection = selection.SelectionBuffer(self._runtime, l, k)
        self(0)  # compiles the kernel, so that the first window does not wait for it

    def __call__(self, nms_radius: int) -> WindowMatch:
        """Find the nearest start and its second best on the device; trace the path on the host."""
        places = self.buffer.places
        if places == 0:
            return WindowMatch()
        apart = min(nms_radius, places)  # no two midpoints are farther apart
        self._runtime.launch(
            self._kernel,
            self._grid,
            self._block,
            self._rows,
            self.buffer.oldest,
            apart,
            *self._scratch,
            *self._selection.arguments,
        )
        found = self._selection.fetch()
        if found.start < 0:
            return WindowMatch(sequences=self._sequences)
        path = trace_sequence(found.cells, 0, self.buffer.k)
        path[:, 1] += found.start
        second_best = found.second_best_start >= 0
        middle = (2 * found.second_best_start + found.second_best_length - 1) // 2
        nearest = SequenceMatch(
            first=found.start,
            last=found.start + found.length - 1,
            middle=(2 * found.start + found.length - 1) // 2,
            distance=found.distance,
            second_best_index=middle if second_best else -1,
            second_best_distance=found.second_best_distance if second_best else float('nan'),
        )
        return WindowMatch(nearest, path, self._sequences)

    def _sequences(self) -> Sequences:
        """Copy distances and lengths of all starts to the host."""
        n = self.buffer.places
        found = SequenceDistances(
            self._distances[:n].cpu().numpy(), self._lengths[:n].cpu().numpy()
        )
        return found.distances, found.middles
