# Copyright 2026 The stavpr_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The windows of a query on a CUDA device: twins of those on the CPU, with rows as tensors."""

from typing import Any

import numpy as np
from stavpr_ros.alignment.cuda import lm_dtw, selection
from stavpr_ros.alignment.cuda.compilation import runtime
from stavpr_ros.alignment.lm_dtw import SequenceDistances, SequenceMatch
from stavpr_ros.alignment.path import trace_sequence
from stavpr_ros.alignment.settings import SequenceSettings
from stavpr_ros.filter.columns import ColumnLayout
from stavpr_ros.filter.cuda_filter import CudaPlaceFilter
from stavpr_ros.prepare.normalization import MIN_DEVIATION
from stavpr_ros.recognition.filter_window import FilterWindow
from stavpr_ros.recognition.match import WindowMatch, WindowSequences
from stavpr_ros.recognition.sessions import in_places
from stavpr_ros.recognition.window import QueryWindow, SequenceBuffer
import torch


def z_normalized_on_device(row: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
    """Return a row as :func:`stavpr_ros.prepare.normalization.z_normalized`, without waiting."""
    if not len(row):
        return row
    known = torch.isfinite(row) & counted
    count = known.sum().clamp(min=1)
    values = torch.where(known, row, 0)
    mean = values.sum() / count
    off = torch.where(known, row - mean, 0)
    return (row - mean) / (off.square().sum() / count).sqrt().clamp(min=MIN_DEVIATION)


class DeviceBuffer(SequenceBuffer):
    """
    A :class:`SequenceBuffer` on torch's current CUDA device.

    Rows are not checked: the call would wait for the device.

    :raises UnavailableError: no CUDA device here, or the package numba-cuda is missing.
    """

    def _filled(self, shape: tuple[int, int]) -> torch.Tensor:
        return torch.full(shape, torch.inf, device=runtime().torch_device)

    def push(self, row: torch.Tensor) -> None:  # type: ignore[override]
        """See :meth:`SequenceBuffer.push`; the row is on the device."""
        self._add(row)

    def newest(self) -> np.ndarray:
        """Return the row of the newest image, (n,), copied from the device."""
        row: np.ndarray = self._slots[self.oldest - 1][0].cpu().numpy()
        return row

    def at(self, columns: np.ndarray, images: int | None = None) -> np.ndarray:
        """See :meth:`SequenceBuffer.at`; copied from the device."""
        rows = torch.from_numpy(self._ring(images))
        entries: np.ndarray = self.memory[rows, torch.from_numpy(columns)].cpu().numpy()
        return entries


def device_columns(layout: ColumnLayout) -> torch.Tensor | None:
    """Return the columns of all places on the device; None = each is that of its number."""
    if not len(layout.gaps):
        return None
    return torch.from_numpy(layout.columns_of(np.arange(layout.runs[-1].stop))).to(
        runtime().torch_device
    )


def spread_on_device(row: torch.Tensor, columns: torch.Tensor | None, width: int) -> torch.Tensor:
    """Return distances to places (n,) as those to columns, +inf in gaps; on the device."""
    if columns is None:
        return row
    return torch.full((width,), torch.inf, device=row.device).index_copy_(0, columns, row)


class CudaFilterWindow(FilterWindow):
    """A :class:`FilterWindow` whose rows and filter are on torch's current CUDA device."""

    buffer_class, filter_class = DeviceBuffer, CudaPlaceFilter

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._columns = device_columns(self.layout)

    def _as_columns(self, row: torch.Tensor) -> torch.Tensor:
        if self._normalizes:
            counted = torch.from_numpy(self._counted(len(row))).to(row.device)
            parts = [z_normalized_on_device(row[run], counted[run]) for run in self.layout.runs]
            row = parts[0] if len(parts) == 1 else torch.cat(parts)
        return spread_on_device(row, self._columns, self.buffer.places)


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
        layout = layout or ColumnLayout()
        n, l, k = layout.width(places), sequence.length, sequence.k
        self._runtime = runtime()
        device, block = self._runtime.torch_device, lm_dtw.BLOCK
        super().__init__(DeviceBuffer(l, n, k, lambda n, k: lm_dtw.row_pitch(n, k, block)), layout)
        blocks = -(-n // block)
        self._kernel, self._grid, self._block = lm_dtw.lm_dtw(l, k, block), (blocks, 1), block
        self._rows = self._runtime.array(self.buffer.memory)
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
        self._columns = device_columns(layout)
        self.match(0)  # compiles the kernel, so that the first window does not wait for it

    def _as_columns(self, row: torch.Tensor) -> torch.Tensor:
        return spread_on_device(row, self._columns, self.buffer.places)

    def match(self, nms_radius: int) -> WindowMatch:
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
        return in_places(WindowMatch(nearest, path, self._sequences), self.layout, nms_radius)

    def _sequences(self) -> WindowSequences:
        """Copy distances and lengths of all starts to the host."""
        n = self.buffer.places
        found = SequenceDistances(
            self._distances[:n].cpu().numpy(), self._lengths[:n].cpu().numpy()
        )
        return WindowSequences(found.distances, found.middles)
