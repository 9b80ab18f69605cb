# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Windows whose nearest sequence is found by LM-DTW (section 4 of the paper)."""

from dataclasses import replace

from stavpr_ros.alignment.lm_dtw import (
    best_match,
    match_padded,
    padded_width,
    SequenceDistances,
    SequenceMatch,
)
from stavpr_ros.alignment.path import trace_sequence
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.recognition.match import WindowMatch, WindowSequences
from stavpr_ros.recognition.window import ColumnLayout, QueryWindow, SequenceBuffer
import torch


class LmDtwWindow(QueryWindow):
    """
    LM-DTW on the CPU.

    :param sequence: l and k.
    :param places: number of places n.
    :param layout: of the places.
    :param normalizes, around: see :class:`stavpr_ros.recognition.window.QueryWindow`.
    """

    def __init__(
        self,
        sequence: SequenceSettings,
        places: int,
        layout: ColumnLayout | None = None,
        normalizes: bool = False,
        around: int = 0,
    ) -> None:
        layout = layout or ColumnLayout()
        buffer = SequenceBuffer(sequence.length, layout.width(places), sequence.k)
        super().__init__(buffer, layout, normalizes, around)

    def _match(self, nms_radius: int) -> WindowMatch:
        buffer = self.buffer
        n, k, first = buffer.known, buffer.k, buffer.first
        # columns behind the known ones are +inf, as the padding that the kernel needs
        window = buffer.rows()[:, : padded_width(n, k)].contiguous().numpy()
        matches = match_padded(window, n, k)
        nearest = best_match(matches, nms_radius)
        if nearest is None:
            return WindowMatch()
        path = trace_sequence(window[:, :n], nearest.first, k)
        path[:, 1] += first  # counted from the first place ever, evicted ones included
        second_best = nearest.second_best_index
        nearest = replace(
            nearest,
            first=nearest.first + first,
            last=nearest.last + first,
            middle=nearest.middle + first,
            second_best_index=second_best + first if second_best >= 0 else -1,
        )
        return WindowMatch(
            nearest, path, lambda: WindowSequences(matches.distances, matches.middles + first)
        )


class CudaLmDtwWindow(QueryWindow):
    """
    LM-DTW on torch's current CUDA device; only a match waits for the device.

    :param sequence: l and k.
    :param places: number of places n.
    :param layout: of the places.
    :raises UnavailableError: no CUDA device here, or the package numba-cuda is missing.
    """

    def __init__(
        self, sequence: SequenceSettings, places: int, layout: ColumnLayout | None = None
    ) -> None:
        from stavpr_ros.alignment.cuda import lm_dtw, selection
        from stavpr_ros.alignment.cuda.compilation import runtime

        layout = layout or ColumnLayout()
        n, l, k = layout.width(places), sequence.length, sequence.k
        self._runtime = runtime()
        device, block = self._runtime.torch_device, lm_dtw.BLOCK
        buffer = SequenceBuffer(l, n, k, lambda n, k: lm_dtw.row_pitch(n, k, block), device)
        super().__init__(buffer, layout)
        blocks = -(-n // block)
        self._kernel, self._grid, self._block = lm_dtw.lm_dtw(l, k, block), (blocks, 1), block
        self._rows = self._runtime.array(buffer.memory)
        self._distances = torch.full((max(1, n),), torch.inf, device=device)
        self._lengths = torch.zeros(max(1, n), dtype=torch.int32, device=device)
        scratch = (
            torch.zeros(max(1, blocks), device=device),
            torch.zeros(max(1, blocks), dtype=torch.int32, device=device),
            torch.zeros(1, dtype=torch.int32, device=device),
        )
        self._arrays = [
            self._runtime.array(array) for array in (self._distances, self._lengths, *scratch)
        ]
        self._selection = selection.SelectionBuffer(self._runtime, l, k)
        self._match(0)  # compiles the kernel, so that the first window does not wait for it

    def _match(self, nms_radius: int) -> WindowMatch:
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
            *self._arrays,
            *self._selection.arguments,
        )
        found = self._selection.fetch()
        if found.start < 0:
            return WindowMatch()
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

    def _sequences(self) -> WindowSequences:
        """Copy distances and lengths of all starts to the host."""
        n = self.buffer.places
        found = SequenceDistances(
            self._distances[:n].cpu().numpy(), self._lengths[:n].cpu().numpy()
        )
        return WindowSequences(found.distances, found.middles)
